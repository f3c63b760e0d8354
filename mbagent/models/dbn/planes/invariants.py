"""Invariants of planes: constant counts of values, and the combinations of channel values that occur in a cell.

Graphs draw cell after cell and channel after channel, so an object that moves at random may be drawn in two places or in none, or
without its colour. If the number of cells with a value was the same before and after every transition, or if only some
combinations of values were ever observed in a cell, draws are conditioned on that: outcomes that violate an invariant are
removed, and the others are renormalised. The last state of an episode is exempt, since one object may cover another there.
Shapes: K counts, C channels, P combinations of values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mbagent.data import TransitionBatch
from mbagent.models.dbn.features import Layout
from mbagent.models.kernel import Outcomes
from mbagent.models.protocol import Successors
from mbagent.models.systematic_sampling import RARE_VALUE
from mbagent.spaces import PlaneLayout
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled

FEWEST_MOVES = 100
"""Minimum number of transitions in which some cells took or lost a value while their number stayed the same."""

MOST_COMBINATIONS = 1 << 20
"""Maximum number of combinations of values for which a table is kept."""

RARELY_NEW = 1e-3
"""Maximum estimated share of states with a new combination of values for which unobserved combinations count as impossible."""

MOST_TRIES = 64
"""Maximum number of repeated draws until all invariants hold."""

COVERING = 256
"""Systematic draws from which the probability that all invariants hold is estimated."""


class Invariants(NamedTuple):
    """Invariants of all transitions.

    Attributes:
        counts: (channel, value) pairs; the number of cells with this value never changes, int64 [K, 2].
        observed: which combinations of the channels' values occur in a cell, bool [P]; empty if any may occur.
    """

    counts: Ints
    observed: Bools

    @property
    def none(self) -> bool:
        """Whether there are no invariants."""
        return len(self.counts) == 0 and len(self.observed) == 0


NO_INVARIANTS = Invariants(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.bool_))


def radix(cardinalities: Sequence[int]) -> Ints:
    """Weight of each channel's value in the index of a combination of values, int64 [C]."""
    result: Ints = np.cumprod([1, *cardinalities], dtype=np.int64)[:-1]
    return result


def n_combinations(cardinalities: Sequence[int]) -> int:
    """Number of combinations of the channels' values, or 0 if there are too many for a table."""
    total = 1
    for k in cardinalities:
        total *= int(k)
        if total > MOST_COMBINATIONS:
            return 0
    return total


def find_invariants(rows: TransitionBatch, board: PlaneLayout, cardinalities: Sequence[int]) -> Invariants:
    """The invariants of some transitions.

    Args:
        rows: transitions.
        board: positions of the cells.
        cardinalities: number of values of each channel's cells.
    """
    return Invariants(
        _find_counts(rows.select(~rows.terminated), board, cardinalities), _find_observed(rows, board, cardinalities)
    )


def _find_counts(rows: TransitionBatch, board: PlaneLayout, cardinalities: Sequence[int]) -> Ints:
    before, after, found = board.to_planes(rows.before), board.to_planes(rows.after), []
    for channel, k in enumerate(cardinalities):
        now, then = before[:, channel], after[:, channel]
        for value in range(k):
            here, there = now == value, then == value
            moved = (here != there).any(axis=(1, 2))
            if moved.sum() >= FEWEST_MOVES and (here.sum(axis=(1, 2)) == there.sum(axis=(1, 2))).all():
                found.append((channel, value))
    return np.asarray(found, dtype=np.int64).reshape(-1, 2)


def _find_observed(rows: TransitionBatch, board: PlaneLayout, cardinalities: Sequence[int]) -> Bools:
    """Which combinations were observed, bool [P]; empty if any may occur, or if new ones are still being observed.

    The probability of a new combination in the next state is estimated from the number of combinations observed in exactly one
    state (Good 1953).
    """
    size, weights = n_combinations(cardinalities), radix(cardinalities)
    if size == 0 or len(cardinalities) < 2 or len(rows) == 0:
        return NO_INVARIANTS.observed
    times = np.zeros(size, dtype=np.int64)
    for part in rows.parts(1000):
        planes = board.to_planes(part.after)
        code = sum(planes[:, c].astype(np.int64) * weight for c, weight in enumerate(weights))
        code = np.sort(np.asarray(code).reshape(len(part), -1), axis=1)
        first = np.ones(code.shape, dtype=np.bool_)  # first occurrence of the combination in this state
        first[:, 1:] = code[:, 1:] != code[:, :-1]
        times += np.bincount(code[first], minlength=size)
    return times > 0 if (times == 1).sum() <= RARELY_NEW * len(rows) and (times == 0).any() else NO_INVARIANTS.observed


def with_invariants(layout: Layout, invariants: Invariants) -> Layout:
    """The layout with the given invariants."""
    return replace(layout, counts=invariants.counts, observed=invariants.observed)


def has_invariants(layout: Layout) -> bool:
    """Whether a layout has invariants."""
    return len(layout.counts) > 0 or len(layout.observed) > 0


@compiled
def keeps(layout: Layout, state: Ints, following: Ints) -> bool:
    """Whether a next state [F] satisfies all invariants; its counts must equal those of the current state."""
    counts, observed, cells = layout.counts, layout.observed, layout.cells
    n_channels, height, width = cells.shape
    for k in range(len(counts)):
        channel, value, surplus = counts[k, 0], counts[k, 1], 0
        for y in range(height):
            for x in range(width):
                surplus += int(following[cells[channel, y, x]] == value) - int(state[cells[channel, y, x]] == value)
        if surplus != 0:
            return False
    if len(observed):
        for y in range(height):
            for x in range(width):
                code = 0
                for c in range(n_channels):
                    code += layout.weights[c] * following[cells[c, y, x]]
                if not observed[code]:
                    return False
    return True


@compiled
def all_kept(layout: Layout, states: Ints, following: Ints) -> Bools:
    """``keeps`` for each row, bool [B]."""
    result = np.empty(len(states), dtype=np.bool_)
    for b in range(len(states)):
        result[b] = keeps(layout, states[b], following[b])
    return result


@compiled
def leave_out(layout: Layout, state: Ints, first: int, n: int, out: Outcomes) -> int:
    """Of the ``n`` outcomes from ``first`` on, removes non-terminal ones that violate an invariant; returns how many are left.

    Works in place. The remaining non-terminal outcomes are rescaled to keep the total. If they have less than a share
    ``RARE_VALUE`` of the non-terminal probability, nothing is removed.
    """
    kept, removed = 0.0, 0.0
    for q in range(first, first + n):
        if not out.terminated[q]:
            if keeps(layout, state, out.states[q]):
                kept += out.probabilities[q]
            else:
                removed += out.probabilities[q]
    if removed == 0.0 or kept < RARE_VALUE * (kept + removed):
        return n
    left = first
    for q in range(first, first + n):
        over, probability = out.terminated[q], out.probabilities[q]
        if over or keeps(layout, state, out.states[q]):
            for f in range(len(state)):
                out.states[left, f] = out.states[q, f]
            out.terminated[left] = over
            out.probabilities[left] = probability if over else probability * (kept + removed) / kept
            left += 1
    return left - first


@compiled
def _leave_out_all(layout: Layout, states: Ints, offsets: Ints, out: Outcomes) -> None:
    """``leave_out`` for every row, in place; writes how many outcomes each has left to ``out.counts`` [B]."""
    for b in range(len(states)):
        out.counts[b] = leave_out(layout, states[b], offsets[b], offsets[b + 1] - offsets[b], out)


def enforced(layout: Layout, states: Ints, found: Successors) -> Successors:
    """Successors of states [B, F], without the outcomes that violate an invariant."""
    if not has_invariants(layout) or len(states) == 0:
        return found
    counts = np.empty(len(states), dtype=np.int64)
    out = Outcomes(counts, found.states.copy(), found.terminated.copy(), found.probabilities.copy(), np.zeros(len(states)))
    _leave_out_all(layout, states, found.offsets, out)
    sizes = np.diff(found.offsets)
    kept = np.arange(len(out.terminated)) - np.repeat(found.offsets[:-1], sizes) < np.repeat(counts, sizes)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, out.states[kept], out.terminated[kept], out.probabilities[kept])


def kept_chances(layout: Layout, states: Ints, found: Successors) -> Floats:
    """Probability [B], for each state, that an outcome satisfies all invariants, given that it is non-terminal.

    It is 1 if no non-terminal outcome satisfies them, or if all outcomes are terminal.
    """
    rows, on = found.rows, ~found.terminated
    kept = all_kept(layout, states[rows], found.states)
    total, good = (np.bincount(rows, weights=found.probabilities * which, minlength=len(states)) for which in (on, on & kept))
    return np.where(good > 0.0, good / np.where(total > 0.0, total, 1.0), 1.0)
