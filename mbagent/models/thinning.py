"""Fewer successors where there are too many: stratified draws from an exact list, see ``particles.py``."""

from __future__ import annotations

import numpy as np

from mbagent.models.arithmetic import Floats, Ints
from mbagent.models.base import Bools, Successors
from mbagent.models.particles import (
    MAIN,
    MASS,
    STRATA,
    Grid,
    begin,
    bit_chances,
    n_outcomes,
    n_possible,
    new_particles,
    share_out,
    slot_of,
    start,
    weigh,
)
from mbagent_envs._compiled import compiled


def thin(full: Successors, n_samples: int, seed: int) -> Successors:
    """Cuts rows with more than ``n_samples`` successors down to at most twice as many.

    What is rare stays as long as there is room, and that the episode ends always does; see ``particles.py``.

    Args:
        full: all successors, with exact probabilities.
        n_samples: grid points a row.
        seed: which random numbers; the same for all rows.
    """
    counts = np.diff(full.offsets)
    if counts.max(initial=0) <= n_samples:
        return full
    offsets = full.offsets.astype(np.int64)
    counts, chosen, weights = _thinned(offsets, full.terminated, full.probabilities, (n_samples, *start(seed)))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, full.states[chosen], full.terminated[chosen], weights)


@compiled
def _thinned(offsets: Ints, terminated: Bools, probabilities: Floats, grid: Grid) -> tuple[Ints, Ints, Floats]:
    """Of each row, how many successors stay; of all of these, their numbers and probabilities."""
    n_rows, n_grid, total, most = len(offsets) - 1, grid[0], 0, 0
    for b in range(n_rows):
        most = max(most, offsets[b + 1] - offsets[b])
    p, values = new_particles(n_grid, 2, max(most, 2)), np.empty(max(most, 2), dtype=np.float64)
    counts, room = np.empty(n_rows, dtype=np.int64), len(probabilities)
    chosen, weights = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.float64)
    for b in range(n_rows):
        first, n = offsets[b], offsets[b + 1] - offsets[b]
        counts[b] = n
        if n <= n_grid:
            for k in range(n):
                chosen[total + k], weights[total + k] = first + k, probabilities[first + k]
            total += n
            continue
        ends, ending = 0, 0.0
        for k in range(first, first + n):
            if terminated[k] and probabilities[k] > 0.0:
                ends, ending = ends + 1, ending + probabilities[k]
        others = n_possible(probabilities, first, n) - ends
        begin(p, n_grid, False, 0)
        p.factors[0, 0] = int(ends > 0)
        if ends > 0 and others > 0:
            bit_chances(ending, values)
            share_out(p, -1, 0, 0, values, 2, True, grid)
        n_main, n_strata = p.state[MAIN], p.state[STRATA]
        for j in range(n_main + n_strata):
            slot = n_grid + j if j < n_strata else j - n_strata  # strata first
            left = 0.0
            for k in range(n):
                same = int(terminated[first + k]) == p.factors[slot, 0]
                values[k] = probabilities[first + k] if same else 0.0
                left += values[k]
            for k in range(n):
                values[k] /= left
            share_out(p, slot, 1, 1, values, n, False, grid)
        weigh(p, n_grid)
        counts[b] = n_outcomes(p)
        for i in range(counts[b]):
            slot = slot_of(p, i, n_grid)
            chosen[total + i], weights[total + i] = first + p.factors[slot, 1], p.chances[slot, MASS]
        total += counts[b]
    return counts, chosen[:total], weights[:total]
