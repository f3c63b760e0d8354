"""Particles: runs of grid points that share an outcome so far (see ``systematic.py``, which draws with them)."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.models.arithmetic import Floats, Ints
from mbagent.models.base import Bools, Successors
from mbagent.models.kernels import largest
from mbagent.models.samplers import draw
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import derive, derive_one, uniform_at, uniforms

NEGLIGIBLE = 0.01
"""Probabilities under this share of the factor's largest count as 0 here: noise of the fit, which planners would
exploit."""

FOUND = 0.95
"""When the outcomes found hold this share of a row's mass, they are weighted by exact probability, else by points."""

CHUNK = 2048
"""Rows worked on at once; bounds the memory."""

Found: TypeAlias = tuple[Ints, Ints, Bools, Floats, Ints]
"""Outcomes of some rows: counts [B], states [M, F], terminated [M], exact probabilities [M], points [M]."""


class Particles(NamedTuple):
    """The particles of one row, in slots 0 ... n - 1.

    Attributes:
        first: lowest grid point, int64 [n].
        points: number of grid points, int64 [n].
        low: lower end of the interval, [n].
        high: upper end, [n].
        mass: exact probability of the outcome so far, [n].
        factors: values of the row's open factors so far, int64 [n, O], in order.
    """

    first: Ints
    points: Ints
    low: Floats
    high: Floats
    mass: Floats
    factors: Ints


@lru_cache(maxsize=4096)
def start(seed: int) -> tuple[np.uint64, float]:
    """The key of a seed and the grid's offset in [0, 1)."""
    key = derive(int(seed) % 2**64, 0x5EED)
    return key[0], float(uniforms(key, 1)[0, 0])


@compiled
def new_particles(n_grid: int, n_outputs: int) -> Particles:
    """Room for a row's particles."""
    ends = np.empty((3, n_grid), dtype=np.float64)
    counts = np.empty((2, n_grid), dtype=np.int64)
    factors = np.empty((n_grid, n_outputs), dtype=np.int64)
    return Particles(counts[0], counts[1], ends[0], ends[1], ends[2], factors)


@compiled
def begin(p: Particles, n_grid: int) -> int:
    """One particle with all points; returns 1."""
    p.first[0], p.points[0], p.low[0], p.high[0], p.mass[0] = 0, n_grid, 0.0, 1.0, 1.0
    return 1


@compiled
def prune(values: Floats, n: int) -> None:
    """Sets negligible probabilities to 0 and scales the rest to sum to one."""
    top, total = 0.0, 0.0
    for k in range(n):
        top = max(top, values[k])
    for k in range(n):
        if values[k] < NEGLIGIBLE * top:
            values[k] = 0.0
        total += values[k]
    for k in range(n):
        values[k] /= total


@compiled
def settle(probs: Floats, b: int, outputs: Ints, base: Ints) -> None:
    """Writes to ``base`` [O] the value of each factor of row b that has only one worth drawing, else -1."""
    for i in range(len(outputs)):
        if outputs[i] == 2:  # written out, since most factors of most worlds are settled bits
            zero, one = probs[b, i, 0], probs[b, i, 1]
            base[i] = 0 if one < NEGLIGIBLE * zero else (1 if zero < NEGLIGIBLE * one else -1)
            continue
        best = largest(probs, b, i, outputs[i])
        base[i] = best
        for k in range(outputs[i]):
            if k != best and probs[b, i, k] >= NEGLIGIBLE * probs[b, i, best]:
                base[i] = -1


@compiled
def split(
    p: Particles, q: int, n_live: int, i: int, w: int, values: Floats, n: int, n_grid: int, key: np.uint64, offset: float
) -> int:
    """Shares the points of particle ``q`` among the values of factor i, open factor number ``w``; returns how many live.

    The first value with a point keeps the slot; particles for further ones are appended.
    """
    if p.points[q] == 1:
        chosen = draw(values, n, uniform_at(derive_one(key, np.uint64(p.first[q])), i))
        p.factors[q, w] = chosen
        p.mass[q] *= values[chosen]
        return n_live
    low, width, mass = p.low[q], p.high[q] - p.low[q], p.mass[q]
    point, left, below = p.first[q], p.points[q], 0.0
    slot, last = q, n - 1
    while values[last] <= 0.0:
        last -= 1
    for k in range(last + 1):
        lower = low + width * below
        below += values[k]
        upper = low + width * below
        taken = left if k == last else min(max(math.ceil(upper * n_grid - offset) - point, 0), left)
        if values[k] <= 0.0 or taken == 0:
            continue
        if slot < 0:
            slot = n_live
            n_live += 1
            for v in range(w):
                p.factors[slot, v] = p.factors[q, v]
        p.first[slot], p.points[slot], p.factors[slot, w] = point, taken, k
        p.low[slot], p.high[slot], p.mass[slot] = lower, upper, mass * values[k]
        slot = -1
        point += taken
        left -= taken
    return n_live


@compiled
def write(p: Particles, n_live: int, base: Ints, still_open: Ints, n_open: int, total: int, found: Found) -> None:
    """Writes a row's outcomes from number ``total`` on: ``base`` [O] with the open factors' values filled in."""
    _, states, terminated, mass, points = found
    n_factors = states.shape[1]
    for q in range(n_live):
        for w in range(n_open):
            base[still_open[w]] = p.factors[q, w]
        for f in range(n_factors):
            states[total + q, f] = base[f]
        terminated[total + q] = base[n_factors] == 1
        mass[total + q], points[total + q] = p.mass[q], p.points[q]


@compiled
def room(n_rows: int, n_grid: int, n_outputs: int) -> Found:
    """Room for as many outcomes as there can be."""
    most = n_rows * n_grid
    return (
        np.empty(n_rows, dtype=np.int64),
        np.empty((most, n_outputs - 1), dtype=np.int64),
        np.empty(most, dtype=np.bool_),
        np.empty(most, dtype=np.float64),
        np.empty(most, dtype=np.int64),
    )


@compiled
def used(found: Found, total: int) -> Found:
    """The part of the room that was used."""
    counts, states, terminated, mass, points = found
    return counts, states[:total], terminated[:total], mass[:total], points[:total]


def assemble(parts: list[Found], n_samples: int, n_outputs: int) -> Successors:
    """Successors from the outcomes found in consecutive runs of rows."""
    if not parts:
        none = np.zeros((0, n_outputs - 1), dtype=np.int64)
        return Successors(np.zeros(1, dtype=np.int64), none, np.zeros(0, dtype=np.bool_), np.zeros(0))
    if len(parts) > 1:
        counts, states, terminated, mass, points = (np.concatenate(column) for column in zip(*parts, strict=True))
    else:
        counts, states, terminated, mass, points = parts[0]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    totals = np.add.reduceat(mass, offsets[:-1])
    exact = np.repeat(totals >= FOUND, counts)
    weights = np.where(exact, mass / np.repeat(totals, counts), points / n_samples)
    return Successors(offsets, states, terminated, weights)


def rows_at_once(n_samples: int, n_outputs: int) -> int:
    """How many rows to work on at once."""
    return max(1, min(CHUNK, (1 << 24) // (n_samples * n_outputs)))
