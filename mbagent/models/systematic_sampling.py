"""Systematic and stratified sampling: the outcomes of a (state, action) from few samples, including rare outcomes.

Variables are processed one after the other; each particle represents the values chosen so far. If all outcomes fit, they are
listed with their exact probabilities. Otherwise particles are stratified. The *main* particles are runs of grid points, divided
among the values of each variable. A value too rare for the grid gets a particle of its own, a *stratum*: all outcomes in which
this is the first rare value. It has the stratum's exact probability, and later variables are sampled. So every rare value of
every variable is represented, the weights sum to one, and expected values are unbiased (stratified sampling, Cochran 1977). If
there are more strata than slots, two are merged: one of them is kept, with probability proportional to its weight, and gets the
weight of both. The stratum in which the episode ends is never merged with another.
Shapes: n grid points, 2 n slots (main particles first, strata from slot n on), O open variables, K values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from mbagent.models.kernel import Outcomes
from mbagent.models.protocol import Successors
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.random_keys import derive, derive_one, uniform_at, uniforms
from mbagent_envs.structs import Struct


@inlined
def largest(probs: Floats, b: int, i: int, n: int) -> int:
    """Most probable of the ``n`` values of factor i in row b; the lowest in a tie."""
    best = 0
    for k in range(1, n):
        if probs[b, i, k] > probs[b, i, best]:
            best = k
    return best


@inlined
def draw(values: Floats, n: int, u: float) -> int:
    """Index sampled from the first ``n`` values, which sum to one: the inverse of their cumulative sum at ``u`` in [0, 1)."""
    chosen = 0
    for k in range(n):
        if values[k] > 0.0:
            chosen = k
            u -= values[k]
            if u < 0.0:
                break
    return chosen


NEGLIGIBLE = 0.01
"""Probabilities below this share of the variable's largest are treated as noise of the fit, which planners would exploit, and set
to 0. Decision graphs do this only for values that were never observed; networks, which cannot distinguish these, always."""

RARE_VALUE, RARE_TOGETHER = 0.05, 0.25
"""Values below the first probability get strata of their own, if together they are below the second."""

ENOUGH_POINTS = 4.0
"""Values with this expected number of grid points are not rare: points represent the other variables better than a stratum."""

LARGEST_CHUNK = 2048
"""Maximum number of rows processed at once; bounds the memory."""

MAIN, STRATA, LISTED, MERGES, PLACE = range(5)
"""Entries of ``Particles.state``: numbers of main particles and of strata, whether all outcomes are listed, merges so far, and a
hash of the state, so that the choice between merged strata differs between states; else all states would miss the same ones."""

_TAG = 1 << 32
"""Value ``k`` of variable number ``i`` is stratum ``i * _TAG + k``; for the variable ``terminated`` it is ``-1 - k``."""

_MERGE, _LATER = np.uint64(0x3E46E), np.uint64(0x1A7E5)
"""Salts of the random numbers that choose between merged strata, and of those that sample the later variables of strata."""

Grid: TypeAlias = tuple[int, np.uint64, float]
"""Number of grid points, key of their random numbers, and offset of the grid; see ``start``."""


FIRST_POINT, POINTS, TAG = range(3)
"""Columns of ``Particles.grid``: lowest grid point, number of grid points, number of the stratum."""

LOW, HIGH, MASS, ORIGINAL_SHARE = range(4)
"""Columns of ``Particles.chances``: ends of the particle's interval in [0, 1); exact probability of the values so far, or the
weight of a stratum including merged ones; probability that no value so far was rare, or the stratum's own probability."""


class Particles(Struct):
    """The particles of one row.

    Attributes:
        grid: see FIRST_POINT, int64 [2 n, 3].
        chances: see LOW, [2 n, 4].
        factors: values of the row's open variables so far, int64 [2 n, O], in order.
        rare: probabilities of the rare values of the current variable, [K].
        state: see MAIN, int64 [5].
        left: probability of the strata that were merged with others and not kept, [1].
    """

    grid: Ints
    chances: Floats
    factors: Ints
    rare: Floats
    state: Ints
    left: Floats


@lru_cache(maxsize=4096)
def start(seed: int) -> tuple[np.uint64, float]:
    """Key and grid offset in [0, 1) of a seed."""
    key = derive(int(seed) % 2**64, 0x5EED)
    return key[0], float(uniforms(key, 1)[0, 0])


def new_particles(n_grid: int, n_outputs: int, n_values: int) -> Particles:
    """Arrays for a row's particles, for ``n_outputs`` variables of at most ``n_values`` values."""
    return Particles(
        np.empty((2 * n_grid, 3), dtype=np.int64),
        np.empty((2 * n_grid, 4), dtype=np.float64),
        np.empty((2 * n_grid, n_outputs), dtype=np.int64),
        np.empty(n_values, dtype=np.float64),
        np.zeros(5, dtype=np.int64),
        np.zeros(1, dtype=np.float64),
    )


@inlined
def begin(p: Particles, n_grid: int, exact: bool, place: int) -> None:
    """Starts with one particle with all points. ``exact``: all outcomes fit, at most 2 n. ``place``: see PLACE."""
    (
        p.grid[0, FIRST_POINT],
        p.grid[0, POINTS],
        p.chances[0, LOW],
        p.chances[0, HIGH],
        p.chances[0, MASS],
        p.chances[0, ORIGINAL_SHARE],
    ) = (
        0,
        n_grid,
        0.0,
        1.0,
        1.0,
        1.0,
    )
    p.state[MAIN], p.state[STRATA], p.state[LISTED], p.state[MERGES] = 1, 0, int(exact), 0
    p.state[PLACE], p.left[0] = place, 0.0


@compiled
def place_of(state: Ints) -> int:
    """A hash of a state [F], see PLACE."""
    total = np.uint64(0)
    for f in range(len(state)):
        total = total * np.uint64(31) + np.uint64(state[f] + 1)
    return int(total >> np.uint64(2))


@inlined
def n_outcomes(p: Particles) -> int:
    """Number of particles."""
    return int(p.state[MAIN] + p.state[STRATA])


@inlined
def slot_of(p: Particles, i: int, n_grid: int) -> int:
    """Slot of the particle with index i, main particles first."""
    return int(i if i < p.state[MAIN] else n_grid + i - p.state[MAIN])


@compiled
def prune(values: Floats, n: int) -> None:
    """Sets negligible probabilities to 0 and normalises the others."""
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
    """For each factor in row b of ``probs``, writes its only non-negligible value to ``base`` [O], or -1 if there are several."""
    for i in range(len(outputs)):
        if outputs[i] == 2:  # a case of its own for speed, since most factors are bits with a certain value
            zero, one = probs[b, i, 0], probs[b, i, 1]
            base[i] = 0 if one < NEGLIGIBLE * zero else (1 if zero < NEGLIGIBLE * one else -1)
            continue
        best = largest(probs, b, i, outputs[i])
        base[i] = best
        for k in range(outputs[i]):
            if k != best and probs[b, i, k] >= NEGLIGIBLE * probs[b, i, best]:
                base[i] = -1


@inlined
def bit_chances(one: float, values: Floats) -> None:
    """Writes the distribution of a bit that is 1 with probability ``one`` to ``values``."""
    values[0], values[1] = 1.0 - one, one


@inlined
def n_possible(values: Floats, start: int, n: int) -> int:
    """Number of positive entries in ``values[start : start + n]``."""
    count = 0
    for k in range(start, start + n):
        if values[k] > 0.0:
            count += 1
    return count


@compiled
def _separate_rare(values: Floats, rare: Floats, n: int, n_grid: int) -> float:
    """Moves the probabilities of rare values to ``rare`` [n] and normalises the others; returns the sum of the rare ones.

    Rare values are below a bound of at most RARE_VALUE and ENOUGH_POINTS grid points, chosen so that their sum is below
    RARE_TOGETHER; equally probable values are all rare or all not.
    """
    bound, total = min(RARE_VALUE, ENOUGH_POINTS / n_grid), RARE_TOGETHER
    while total >= RARE_TOGETHER:
        total = 0.0
        for k in range(n):
            if values[k] < bound:
                total += values[k]
        if total >= RARE_TOGETHER:
            bound *= 0.5
    for k in range(n):
        rare[k] = 0.0
        if total > 0.0:
            if values[k] < bound:
                rare[k], values[k] = values[k], 0.0
            values[k] /= 1.0 - total
    return total


@compiled
def share_out(p: Particles, only: int, variable: int, w: int, values: Floats, n: int, ends: bool, grid: Grid) -> None:
    """Divides the particles among the values of a variable.

    Args:
        p: the particles.
        only: slot of one particle, if probabilities depend on its values so far (strata must precede main particles); -1 for all.
        variable: index of the variable, for its random numbers.
        w: index of the variable among the open ones: its column in ``Particles.factors``.
        values: probability of each value, summing to one, overwritten, [n].
        n: number of values.
        ends: whether the variable is ``terminated``.
        grid: see Grid.
    """
    points, chances, factors, rare, state = p.grid, p.chances, p.factors, p.rare, p.state
    n_grid, n_main, rare_mass = grid[0], state[MAIN], 0.0
    if state[LISTED]:
        for q in range(n_main if only < 0 else 1):
            _list_values(p, max(q, only), w, values, n)
        return
    for slot in range(n_grid, n_grid + state[STRATA]):
        if only < 0 or slot == only:
            factors[slot, w] = draw(values, n, uniform_at(derive_one(grid[1], _LATER + np.uint64(slot)), variable))
    if only >= n_grid:
        return
    rare_mass = _separate_rare(values, rare, n, n_grid)
    for i in range(n_main if only < 0 else 1):
        q = max(i, only)
        here = points[q, POINTS] / n_grid * chances[q, ORIGINAL_SHARE]
        for k in range(n if rare_mass > 0.0 else 0):
            if rare[k] > 0.0:
                _add_stratum(p, q, variable, k, w, here * rare[k], ends, grid)
        chances[q, MASS] *= 1.0 - rare_mass
        chances[q, ORIGINAL_SHARE] *= 1.0 - rare_mass
        state[MAIN] = _split(p, q, state[MAIN], variable, w, values, n, grid)


@compiled
def _list_values(p: Particles, q: int, w: int, values: Floats, n: int) -> None:
    """Replaces particle ``q`` by one particle for each possible value; the first one keeps the slot."""
    chances, factors, state = p.chances, p.factors, p.state
    slot, mass, last = q, chances[q, MASS], state[MAIN]
    for k in range(n):
        if values[k] > 0.0:
            if slot < 0:
                slot = last
                last += 1
                for v in range(w):
                    factors[slot, v] = factors[q, v]
            factors[slot, w], chances[slot, MASS] = k, mass * values[k]
            slot = -1
    state[MAIN] = last


@compiled
def _split(p: Particles, q: int, n_live: int, i: int, w: int, values: Floats, n: int, grid: Grid) -> int:
    """Divides the points of main particle ``q`` among the values of variable i; returns the number of main particles.

    The first value with a point keeps the slot; particles for further values are appended.
    """
    points, chances, factors = p.grid, p.chances, p.factors
    n_grid, key, offset = grid
    if points[q, POINTS] == 1:
        chosen = draw(values, n, uniform_at(derive_one(key, np.uint64(points[q, FIRST_POINT])), i))
        factors[q, w] = chosen
        chances[q, MASS] *= values[chosen]
        return n_live
    low, width, mass = chances[q, LOW], chances[q, HIGH] - chances[q, LOW], chances[q, MASS]
    point, left, below = points[q, FIRST_POINT], points[q, POINTS], 0.0
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
                factors[slot, v] = factors[q, v]
        points[slot, FIRST_POINT], points[slot, POINTS], factors[slot, w] = point, taken, k
        chances[slot, LOW], chances[slot, HIGH], chances[slot, MASS], chances[slot, ORIGINAL_SHARE] = (
            lower,
            upper,
            mass * values[k],
            chances[q, ORIGINAL_SHARE],
        )
        slot = -1
        point += taken
        left -= taken
    return n_live


@compiled
def _slot_for(p: Particles, tag: int, ends: bool, n_grid: int) -> int:
    """Slot of a stratum: its own, a new one of mass 0, or that of another one with which it has to be merged."""
    points, chances, state = p.grid, p.chances, p.state
    last, room = n_grid + int(state[STRATA]), n_grid if ends else max(1, n_grid - 1)  # one is reserved for termination
    for slot in range(n_grid, last):
        if points[slot, TAG] == tag:
            return slot
        if points[slot, TAG] < 0:
            room = n_grid
    if state[STRATA] < room:
        state[STRATA] += 1
        chances[last, MASS] = 0.0
        return last
    slot = n_grid + int(state[MERGES] % state[STRATA])
    for _ in range(state[STRATA]):
        if (points[slot, TAG] < 0) != ends:
            slot = slot + 1 if slot + 1 < last else n_grid
    return slot


@compiled
def _add_stratum(p: Particles, q: int, variable: int, k: int, w: int, weight: float, ends: bool, grid: Grid) -> None:
    """Adds a stratum: main particle q with value k of a variable, with the given weight."""
    points, chances, factors, state = p.grid, p.chances, p.factors, p.state
    n_grid, key, _ = grid
    tag = -1 - k if ends else variable * _TAG + k
    slot = _slot_for(p, tag, ends, n_grid)
    before, total = chances[slot, MASS], chances[slot, MASS] + weight
    if before > 0.0:
        state[MERGES] += 1
        kept = uniform_at(derive_one(key, _MERGE + np.uint64(state[PLACE])), state[MERGES]) * total >= weight
        if points[slot, TAG] != tag:
            p.left[0] += weight if kept else chances[slot, ORIGINAL_SHARE]
            chances[slot, ORIGINAL_SHARE] = chances[slot, ORIGINAL_SHARE] if kept else weight
        else:
            chances[slot, ORIGINAL_SHARE] += weight
        if kept:
            chances[slot, MASS] = total
            return
    else:
        chances[slot, ORIGINAL_SHARE] = weight
    for v in range(w):
        factors[slot, v] = factors[q, v]
    factors[slot, w], chances[slot, MASS], points[slot, TAG] = k, total, tag


@compiled
def weigh(p: Particles, n_grid: int) -> None:
    """Turns the particles' masses into probabilities that sum to one.

    If all outcomes are listed, these are exact. Otherwise a main particle with at least the probability of a grid point, whose
    inclusion is certain, keeps its own; a less probable one gets that of a grid point (Hájek 1971: mass divided by the
    probability of inclusion, normalised).
    """
    points, chances, n_main, total = p.grid, p.chances, p.state[MAIN], 0.0
    if not p.state[LISTED]:
        wanted, weights = 0.0, 0.0
        for q in range(n_main):
            wanted += points[q, POINTS] / n_grid * chances[q, ORIGINAL_SHARE]
            chances[q, MASS] = max(chances[q, MASS], chances[q, ORIGINAL_SHARE] / n_grid)
            weights += chances[q, MASS]
        for q in range(n_main):
            chances[q, MASS] *= wanted / weights
    for i in range(n_outcomes(p)):
        total += chances[slot_of(p, i, n_grid), MASS]
    for i in range(n_outcomes(p)):
        chances[slot_of(p, i, n_grid), MASS] /= total


@compiled
def write(p: Particles, base: Ints, open_factors: Ints, n_open: int, n_grid: int, total: int, out: Outcomes) -> int:
    """Writes a row's outcomes, ``base`` [O] plus open factors' values, from index ``total``; returns their number."""
    n_factors = out.states.shape[1]
    weigh(p, n_grid)
    for i in range(n_outcomes(p)):
        slot = slot_of(p, i, n_grid)
        for w in range(n_open):
            base[open_factors[w]] = p.factors[slot, w]
        for f in range(n_factors):
            out.states[total + i, f] = base[f]
        out.terminated[total + i] = base[n_factors] == 1
        out.probabilities[total + i] = p.chances[slot, MASS]
    return n_outcomes(p)


def outcomes_of_rows(n_rows: int, n_grid: int, n_outputs: int) -> Outcomes:
    """Arrays for the maximum number of outcomes of ``n_rows`` rows, in which counts and ``left_out`` are [B]."""
    most = 2 * n_rows * n_grid
    return Outcomes(
        np.empty(n_rows, dtype=np.int64),
        np.empty((most, n_outputs - 1), dtype=np.int64),
        np.empty(most, dtype=np.bool_),
        np.empty(most),
        np.zeros(n_rows),
    )


def listed(n_rows: int, n_samples: int, n_outputs: int, seed: int, kernel: Callable[[slice, Grid, Outcomes], int]) -> Successors:
    """Successors of rows, which a kernel writes for a run of rows to given arrays, returning their number.

    Args:
        n_rows: number of rows B.
        n_samples: number of grid points of each row.
        n_outputs: number of factors, with ``terminated``.
        seed: of the grid.
        kernel: called with the rows, the grid and the arrays.
    """
    offsets, parts = [np.zeros(1, dtype=np.int64)], []
    step = max(1, min(LARGEST_CHUNK, (1 << 24) // (2 * n_samples * n_outputs)))
    for first in range(0, max(n_rows, 1), step):
        out = outcomes_of_rows(min(step, n_rows - first), n_samples, n_outputs)
        total = kernel(slice(first, first + step), (n_samples, *start(seed)), out)
        offsets.append(offsets[-1][-1] + np.cumsum(out.counts))
        parts.append((out.states[:total], out.terminated[:total], out.probabilities[:total]))
    columns = (np.concatenate(column) if len(parts) > 1 else column[0] for column in zip(*parts, strict=True))
    return Successors(np.concatenate(offsets).astype(np.int64), *columns)


def thin(full: Successors, n_samples: int, seed: int) -> Successors:
    """Reduces rows with more than ``n_samples`` successors to at most ``2 * n_samples``.

    Rare successors are kept while there is room, termination always; see the module docstring.

    Args:
        full: all successors, with exact probabilities.
        n_samples: number of grid points for each row.
        seed: of the random numbers, which are the same for all rows.
    """
    counts = np.diff(full.offsets)
    if counts.max(initial=0) <= n_samples:
        return full
    offsets = full.offsets.astype(np.int64)
    work, values, grid = new_particles(n_samples, 2, int(counts.max())), np.empty(counts.max()), (n_samples, *start(seed))
    counts, chosen, weights = _thinned(offsets, full.terminated, full.probabilities, work, values, grid)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, full.states[chosen], full.terminated[chosen], weights)


@compiled
def _thinned(
    offsets: Ints, terminated: Bools, probabilities: Floats, p: Particles, values: Floats, grid: Grid
) -> tuple[Ints, Ints, Floats]:
    """Number of successors kept in each row, and the indices and probabilities of all that are kept."""
    n_rows, room, total = len(offsets) - 1, len(probabilities), 0
    counts, chosen = np.empty(n_rows, dtype=np.int64), np.empty(room, dtype=np.int64)
    weights = np.empty(room, dtype=np.float64)
    for b in range(n_rows):
        n, first = thin_row(offsets[b], offsets[b + 1], terminated, probabilities, p, values, grid), offsets[b]
        counts[b] = n
        for i in range(n):
            if p.state[LISTED]:
                chosen[total + i], weights[total + i] = first + i, probabilities[first + i]
            else:
                slot = slot_of(p, i, grid[0])
                chosen[total + i], weights[total + i] = first + p.factors[slot, 1], p.chances[slot, MASS]
        total += n
    return counts, chosen[:total], weights[:total]


@compiled
def thin_row(first: int, end: int, terminated: Bools, probabilities: Floats, p: Particles, values: Floats, grid: Grid) -> int:
    """Reduces the successors ``first`` ... ``end`` - 1 of a row if there are more than ``n_grid``; returns how many are kept.

    All are kept if ``p.state[LISTED]`` is set. Otherwise, the particles hold those that are kept: number
    ``p.factors[slot, 1]`` of the row with probability ``p.chances[slot, MASS]``. ``values`` has room for at least 2 numbers.
    """
    n, ends, ending = end - first, 0, 0.0
    begin(p, grid[0], n <= grid[0], 0)
    if n <= grid[0]:
        return int(n)
    for k in range(first, end):
        if terminated[k] and probabilities[k] > 0.0:
            ends, ending = ends + 1, ending + probabilities[k]
    others = n_possible(probabilities, first, n) - ends
    p.factors[0, 0] = int(ends > 0)
    if ends > 0 and others > 0:
        bit_chances(ending, values)
        share_out(p, -1, 0, 0, values, 2, True, grid)
    n_main, n_strata = p.state[MAIN], p.state[STRATA]
    for j in range(n_main + n_strata):
        slot = grid[0] + j if j < n_strata else j - n_strata  # strata first
        left = 0.0
        for k in range(n):
            same = int(terminated[first + k]) == p.factors[slot, 0]
            values[k] = probabilities[first + k] if same else 0.0
            left += values[k]
        for k in range(n):
            values[k] /= left
        share_out(p, slot, 1, 1, values, n, False, grid)
    weigh(p, grid[0])
    return n_outcomes(p)
