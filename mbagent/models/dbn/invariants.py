"""What every state keeps to on planes: counts that never change, and values that meet in one cell.

Graphs draw cell after cell, channel after channel, so that of two things that move by chance one may be drawn in two places or
in none, or without its colour. Where the number of cells with some value stayed the same in every transition, and where only
some of all combinations of values were ever met in a cell, draws are conditioned on that: what breaks a law is left out, and
what is left shares its probability. An episode's last state is free, since what is hit may well be covered there.
Shapes: K counts, C channels, P combinations of values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mbagent.data import TransitionBatch
from mbagent.models.protocol import Successors
from mbagent.models.systematic_sampling import RARE_VALUE
from mbagent.spaces import PlaneLayout
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled

FEWEST_MOVES = 100
"""Transitions, at least, in which cells took or lost a value while their number stayed the same."""

MOST_COMBINATIONS = 1 << 20
"""More combinations of values than so many are not kept in a table."""

RARELY_NEW = 1e-3
"""A combination never met may come up in this share of states and still count as impossible."""

MOST_TRIES = 64
"""Draws until all laws are kept, at most."""

COVERING = 256
"""Systematic draws from which it is estimated how probable it is that all laws are kept."""


class Invariants(NamedTuple):
    """What every state keeps to.

    Attributes:
        counts: channels and values of which the number of cells never changes, int64 [K, 2].
        observed: which combinations of the channels' values are met in a cell, bool [P]; empty where any may be.
    """

    counts: Ints
    observed: Bools

    @property
    def none(self) -> bool:
        """Whether anything goes."""
        return len(self.counts) == 0 and len(self.observed) == 0


NO_INVARIANTS = Invariants(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.bool_))


def radix(cardinalities: Sequence[int]) -> Ints:
    """What each channel's value counts in the number of a combination, int64 [C]."""
    result: Ints = np.cumprod([1, *cardinalities], dtype=np.int64)[:-1]
    return result


def n_combinations(cardinalities: Sequence[int]) -> int:
    """Number of combinations of the channels' values, or 0 where they are too many for a table."""
    total = 1
    for k in cardinalities:
        total *= int(k)
        if total > MOST_COMBINATIONS:
            return 0
    return total


def find_invariants(rows: TransitionBatch, board: PlaneLayout, cardinalities: Sequence[int]) -> Invariants:
    """The laws that some transitions keep to.

    Args:
        rows: transitions.
        board: where cells lie.
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
    """Combinations met; nothing where any may be, or where new ones keep coming.

    How probable it is that the next state shows a new one is told by those that were met in one state only (Good 1953).
    """
    size, weights = n_combinations(cardinalities), radix(cardinalities)
    if size == 0 or len(cardinalities) < 2 or len(rows) == 0:
        return NO_INVARIANTS.observed
    times = np.zeros(size, dtype=np.int64)
    for part in rows.parts(1000):
        planes = board.to_planes(part.after)
        code = sum(planes[:, c].astype(np.int64) * weight for c, weight in enumerate(weights))
        code = np.sort(np.asarray(code).reshape(len(part), -1), axis=1)
        first = np.ones(code.shape, dtype=np.bool_)  # of its kind in this state
        first[:, 1:] = code[:, 1:] != code[:, :-1]
        times += np.bincount(code[first], minlength=size)
    return times > 0 if (times == 1).sum() <= RARELY_NEW * len(rows) and (times == 0).any() else NO_INVARIANTS.observed


@compiled
def keeps(counts: Ints, observed: Bools, weights: Ints, cells: Ints, state: Ints, following: Ints) -> bool:
    """Whether a next state [F] keeps all laws, of which the counts are those of the state before."""
    n_channels, height, width = cells.shape
    for k in range(len(counts)):
        here, value, surplus = cells[counts[k, 0]], counts[k, 1], 0
        for y in range(height):
            for x in range(width):
                surplus += int(following[here[y, x]] == value) - int(state[here[y, x]] == value)
        if surplus != 0:
            return False
    if len(observed):
        for y in range(height):
            for x in range(width):
                code = 0
                for c in range(n_channels):
                    code += weights[c] * following[cells[c, y, x]]
                if not observed[code]:
                    return False
    return True


@compiled
def all_kept(counts: Ints, observed: Bools, weights: Ints, cells: Ints, states: Ints, following: Ints) -> Bools:
    """``keeps`` for rows, bool [B]."""
    result = np.empty(len(states), dtype=np.bool_)
    for b in range(len(states)):
        result[b] = keeps(counts, observed, weights, cells, states[b], following[b])
    return result


@compiled
def leave_out(
    counts: Ints,
    observed: Bools,
    weights: Ints,
    cells: Ints,
    state: Ints,
    following: Ints,
    terminated: Bools,
    probabilities: Floats,
    first: int,
    n: int,
) -> int:
    """Takes those of the outcomes ``first`` to ``first + n`` that go on and break a law out, in place; returns how many are left.

    The others that go on share their probability. Where hardly any of that keeps the laws, all stay.
    """
    kept, lost = 0.0, 0.0
    for q in range(first, first + n):
        if not terminated[q]:
            if keeps(counts, observed, weights, cells, state, following[q]):
                kept += probabilities[q]
            else:
                lost += probabilities[q]
    if lost == 0.0 or kept < RARE_VALUE * (kept + lost):
        return n
    left = first
    for q in range(first, first + n):
        over = terminated[q]
        if over or keeps(counts, observed, weights, cells, state, following[q]):
            following[left] = following[q]
            terminated[left] = over
            probabilities[left] = probabilities[q] if over else probabilities[q] * (kept + lost) / kept
            left += 1
    return left - first


@compiled
def leave_out_all(
    counts: Ints,
    observed: Bools,
    weights: Ints,
    cells: Ints,
    states: Ints,
    offsets: Ints,
    following: Ints,
    over: Bools,
    chances: Floats,
) -> Ints:
    """``leave_out`` for every row, in place; returns how many outcomes each has left."""
    left = np.empty(len(states), dtype=np.int64)
    for b in range(len(states)):
        n = offsets[b + 1] - offsets[b]
        left[b] = leave_out(counts, observed, weights, cells, states[b], following, over, chances, offsets[b], n)
    return left


def enforced(invariants: Invariants, weights: Ints, cells: Ints, states: Ints, found: Successors) -> Successors:
    """Successors of states [B, F] without those that break a law."""
    if invariants.none or len(states) == 0:
        return found
    following, over, chances = found.states.copy(), found.terminated.copy(), found.probabilities.copy()
    left = leave_out_all(*invariants, weights, cells, states, found.offsets, following, over, chances)
    sizes = np.diff(found.offsets)
    kept = np.arange(len(over)) - np.repeat(found.offsets[:-1], sizes) < np.repeat(left, sizes)
    offsets = np.concatenate([[0], np.cumsum(left)]).astype(np.int64)
    return Successors(offsets, following[kept], over[kept], chances[kept])


def kept_chances(invariants: Invariants, weights: Ints, cells: Ints, states: Ints, found: Successors) -> Floats:
    """Probability that an outcome that goes on keeps all laws, for each row of successors; 1 where none does, or none goes on."""
    rows, on = found.rows, ~found.terminated
    kept = all_kept(*invariants, weights, cells, states[rows], found.states)
    total, good = (np.bincount(rows, weights=found.probabilities * which, minlength=len(states)) for which in (on, on & kept))
    return np.where(good > 0.0, good / np.where(total > 0.0, total, 1.0), 1.0)
