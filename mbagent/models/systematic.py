"""Successors for planning: systematic draws through the ancestral inverse distribution function, equal ones merged.

A row starts as one *particle* that holds the n grid points (j + offset) / n of [0, 1). At each factor the particle's
interval
is split in proportion to P(y_i | s, a, y_<i) and its points go to the parts; parts without a point are dropped. So work
grows with the number of different outcomes and not with n, no outcome of probability 1 / n or more is missed, and an
outcome's share of the points is within 1 / n of its probability. The offset is the same for all rows: two actions,
or two
states, differ by their effects and not by luck. A particle down to a single point goes on with fresh numbers, hashed
from
(seed, point, factor), for its interval would soon be too narrow for a float. Shapes: B batch, F state factors, O = F
+ 1
output factors, K largest cardinality, n points a row, M successors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.models.base import Successors
from mbagent.models.kernels import (
    Floats,
    Floats32,
    GroupWeights,
    Ints,
    Layout,
    active_columns,
    conditional,
    largest,
    trusted,
)
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

Conditional: TypeAlias = Callable[[int, Ints, Ints], Floats]
"""(factor i, row of each particle [P], its outcome so far [P, O]) -> P(y_i | s, a, y_<i), float64 [P, cardinality of
i]."""

_Found: TypeAlias = tuple[Ints, Ints, Floats, Ints]
"""Counts of outcomes [B], outcomes [M, O], their probabilities [M], their points [M]."""


class _Particles(NamedTuple):
    """The particles of one row, in slots 0 ... n - 1.

    Attributes:
        first: lowest grid point, int64 [n].
        points: number of grid points, int64 [n].
        low: lower end of the interval, [n].
        high: upper end, [n].
        mass: exact probability of the outcome so far, [n].
        factors: the outcome so far, int64 [n, O].
    """

    first: Ints
    points: Ints
    low: Floats
    high: Floats
    mass: Floats
    factors: Ints


def start(seed: int) -> tuple[np.uint64, float]:
    """The key of a seed and the grid's offset in [0, 1)."""
    key = derive(int(seed) % 2**64, 0x5EED)
    return key[0], float(uniforms(key, 1)[0, 0])


@compiled
def _prune(values: Floats, n: int, out: Floats) -> None:
    """Sets negligible probabilities to 0 and scales the rest to sum to one."""
    floor = NEGLIGIBLE * values[largest(values, n)]
    total = 0.0
    for k in range(n):
        out[k] = values[k] if values[k] >= floor else 0.0
        total += out[k]
    for k in range(n):
        out[k] /= total


@compiled
def _split(
    p: _Particles,
    q: int,
    n_live: int,
    i: int,
    values: Floats,
    n: int,
    n_grid: int,
    key: np.uint64,
    offset: float,
) -> int:
    """Shares the points of particle ``q`` among the values of factor i; new particles are appended; returns how many live."""
    if p.points[q] == 1:
        chosen = draw(values, n, uniform_at(derive_one(key, np.uint64(p.first[q])), i))
        p.factors[q, i] = chosen
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
        taken = left if k == last else min(max(int(math.ceil(upper * n_grid - offset)) - point, 0), left)
        if values[k] <= 0.0 or taken == 0:
            continue
        if slot < 0:
            slot = n_live
            n_live += 1
            p.factors[slot, :i] = p.factors[q, :i]
        p.first[slot], p.points[slot], p.factors[slot, i] = point, taken, k
        p.low[slot], p.high[slot], p.mass[slot] = lower, upper, mass * values[k]
        slot = -1
        point += taken
        left -= taken
    return n_live


@compiled
def _begin(p: _Particles, n_grid: int) -> int:
    """One particle with all points; returns 1."""
    p.first[0], p.points[0], p.low[0], p.high[0], p.mass[0] = 0, n_grid, 0.0, 1.0, 1.0
    return 1


@compiled
def _new_particles(n_grid: int, n_outputs: int) -> _Particles:
    ends = np.empty((3, n_grid), dtype=np.float64)
    counts = np.empty((2, n_grid), dtype=np.int64)
    return _Particles(counts[0], counts[1], ends[0], ends[1], ends[2], np.empty((n_grid, n_outputs), dtype=np.int64))


@compiled
def _certain(values: Floats, n: int) -> int:
    """The value of a factor that has only one worth drawing, else -1."""
    best = largest(values, n)
    floor = NEGLIGIBLE * values[best]
    for k in range(n):
        if k != best and values[k] >= floor:
            return -1
    return best


@compiled
def _independent(probs: Floats, outputs: Ints, n_grid: int, key: np.uint64, offset: float) -> _Found:
    n_rows, n_outputs = probs.shape[0], probs.shape[1]
    p = _new_particles(n_grid, n_outputs)
    counts = np.empty(n_rows, dtype=np.int64)
    found = np.empty((n_rows * n_grid, n_outputs), dtype=np.int64)
    mass, points = np.empty(len(found), dtype=np.float64), np.empty(len(found), dtype=np.int64)
    kept = np.empty(probs.shape[2], dtype=np.float64)
    total = 0
    for b in range(n_rows):
        n_live = _begin(p, n_grid)
        for i in range(n_outputs):
            only = _certain(probs[b, i], outputs[i])
            if only >= 0:
                for q in range(n_live):
                    p.factors[q, i] = only
                continue
            _prune(probs[b, i], outputs[i], kept)
            for q in range(n_live):
                n_live = _split(p, q, n_live, i, kept, outputs[i], n_grid, key, offset)
        counts[b] = n_live
        found[total : total + n_live] = p.factors[:n_live]
        mass[total : total + n_live] = p.mass[:n_live]
        points[total : total + n_live] = p.points[:n_live]
        total += n_live
    return counts, found[:total], mass[:total], points[:total]


@compiled
def _causal(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    n_grid: int,
    key: np.uint64,
    offset: float,
) -> _Found:
    n_rows, n_outputs = probs.shape[0], probs.shape[1]
    p = _new_particles(n_grid, n_outputs)
    counts = np.empty(n_rows, dtype=np.int64)
    found = np.empty((n_rows * n_grid, n_outputs), dtype=np.int64)
    mass, points = np.empty(len(found), dtype=np.float64), np.empty(len(found), dtype=np.int64)
    active = np.empty(states.shape[1] + 1, dtype=np.int64)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(probs.shape[2], dtype=np.float32)
    values = np.empty(probs.shape[2], dtype=np.float64)
    total = 0
    for b in range(n_rows):
        n_active = active_columns(states[b], actions[b], layout, active)
        n_live = _begin(p, n_grid)
        for i in range(n_outputs):
            n = layout.outputs[i]
            trust = trusted(i, probs[b, i], layout, group, certain)
            only = _certain(probs[b, i], n) if trust else -1
            for q in range(n_live):
                if only >= 0:
                    p.factors[q, i] = only
                    continue
                if trust:
                    values[:] = probs[b, i]
                else:
                    conditional(
                        i,
                        logits[b, i],
                        active,
                        n_active,
                        p.factors[q],
                        layout,
                        group,
                        hidden,
                        row_logits,
                        values,
                    )
                _prune(values, n, values)
                n_live = _split(p, q, n_live, i, values, n, n_grid, key, offset)
        counts[b] = n_live
        found[total : total + n_live] = p.factors[:n_live]
        mass[total : total + n_live] = p.mass[:n_live]
        points[total : total + n_live] = p.points[:n_live]
        total += n_live
    return counts, found[:total], mass[:total], points[:total]


def independent_successors(probs: Floats, outputs: Ints, n_samples: int, seed: int) -> Successors:
    """Successors under independent factors.

    Args:
        probs: float64 [B, O, K], each factor's distribution.
        outputs: int64 [O], cardinalities; the last factor is ``terminated``.
        n_samples: grid points n a row.
        seed: which grid offset and fresh numbers.
    """
    key, offset = start(seed)
    step = _rows_at_once(n_samples, len(outputs))
    parts = [_independent(probs[b : b + step], outputs, n_samples, key, offset) for b in range(0, len(probs), step)]
    return assemble(parts, n_samples, len(outputs))


def causal_successors(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    n_samples: int,
    seed: int,
) -> Successors:
    """Successors under a compiled causal conditioner; arguments as of ``samplers.sample_causal``, and n and seed as above."""
    key, offset = start(seed)
    step = _rows_at_once(n_samples, len(layout.outputs))
    parts = []
    for b in range(0, len(states), step):
        rows = slice(b, b + step)
        parts.append(
            _causal(
                states[rows],
                actions[rows],
                logits[rows],
                probs[rows],
                layout,
                group,
                certain,
                n_samples,
                key,
                offset,
            )
        )
    return assemble(parts, n_samples, len(layout.outputs))


def assemble(parts: list[_Found], n_samples: int, n_outputs: int) -> Successors:
    """Successors from the outcomes found in consecutive runs of rows."""
    if not parts:
        none = np.zeros((0, n_outputs - 1), dtype=np.int64)
        return Successors(np.zeros(1, dtype=np.int64), none, np.zeros(0, dtype=np.bool_), np.zeros(0))
    merged = parts[0] if len(parts) == 1 else tuple(np.concatenate(column) for column in zip(*parts, strict=True))
    counts, found, mass, points = merged
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    totals = np.add.reduceat(mass, offsets[:-1])
    weights = np.where(np.repeat(totals >= FOUND, counts), mass / np.repeat(totals, counts), points / n_samples)
    return Successors(offsets, np.ascontiguousarray(found[:, :-1]), found[:, -1] == 1, weights)


def _rows_at_once(n_samples: int, n_outputs: int) -> int:
    return max(1, min(CHUNK, (1 << 24) // (n_samples * n_outputs)))


FEW = 20
"""Rows with no more successors than this are listed in full, however few draws are asked for."""


def thin(full: Successors, n_samples: int, seed: int) -> Successors:
    """Cuts rows with more than max(n_samples, FEW) successors down to ``n_samples`` systematic draws of them, merged.

    Args:
        full: all successors, with exact probabilities.
        n_samples: grid points a row.
        seed: which grid offset; the same for all rows.
    """
    counts = np.diff(full.offsets)
    if counts.max(initial=0) <= max(n_samples, FEW):
        return full
    rows = full.rows
    below = np.cumsum(full.probabilities)
    below -= np.concatenate([[0.0], below])[full.offsets[:-1]][rows]
    ends = np.ceil(below * n_samples - start(seed)[1]).clip(0, n_samples)
    ends[full.offsets[1:][counts > 0] - 1] = n_samples
    points = np.diff(ends, prepend=0.0)
    points[full.offsets[:-1][counts > 0]] = ends[full.offsets[:-1][counts > 0]]
    listed = (counts <= max(n_samples, FEW))[rows]
    kept = listed | (points > 0)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(rows[kept], minlength=len(counts)))]).astype(np.int64)
    weights = np.where(listed, full.probabilities, points / n_samples)[kept]
    return Successors(offsets, full.states[kept], full.terminated[kept], weights)
