"""What states are worth that were imagined, but not looked beyond."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled


class LeafValues(NamedTuple):
    """A sum over the *columns* that a state has on, and over pairs of them.

    A column is on where a factor has one certain value other than its common one; C columns in all.

    Attributes:
        common: common value of each factor, int64 [F]; or empty: an unexpanded state is worth as much as the lowest expanded one.
        first: where each factor's values begin in ``column``, int64 [F].
        column: number of the column that each value of each factor is, -1 for none, int64 [sum of cardinalities].
        mean: worth of a state in which no column is on.
        weights: what each column adds, [C].
        pairs: what two columns add together, symmetric, [C, C]; or [0, 0] for nothing.
        low: a state is worth so much, at least.
        high: and so much, at most.
    """

    common: Ints
    first: Ints
    column: Ints
    mean: float
    weights: Floats
    pairs: Floats
    low: float
    high: float


_NOTHING = np.zeros(0, dtype=np.int64)

LOWEST_KNOWN = LeafValues(_NOTHING, _NOTHING, _NOTHING, 0.0, np.zeros(0), np.zeros((0, 0)), 0.0, 0.0)
"""Nothing was learned of unexpanded states."""


@compiled
def features_on(leaf: LeafValues, state: Ints, on: Ints) -> int:
    """Writes the columns that a state [F] has on to ``on`` [F]; returns how many."""
    n = 0
    for f in range(len(state)):
        if state[f] != leaf.common[f]:
            column = leaf.column[leaf.first[f] + state[f]]
            if column >= 0:
                on[n] = column
                n += 1
    return n


@compiled
def sum_of(leaf: LeafValues, on: Ints) -> float:
    """What a state with these columns on is worth."""
    total, paired = leaf.mean, len(leaf.pairs) > 0
    for i in range(len(on)):
        total += leaf.weights[on[i]]
        if paired:
            for j in range(i):
                total += leaf.pairs[on[i], on[j]]
    return float(min(max(total, leaf.low), leaf.high))


@compiled
def leaf_value(leaf: LeafValues, state: Ints) -> float:
    """What an unexpanded state [F] is worth; something must have been learned."""
    on = np.empty(len(state), dtype=np.int64)
    return sum_of(leaf, on[: features_on(leaf, state, on)])


@compiled
def evaluate(leaf: LeafValues, states: Ints, skipped: Bools, v: Floats) -> None:
    """Writes the values of states [N, F] to ``v`` [N], but of those that are skipped; nothing where nothing was learned."""
    if len(leaf.common) > 0:
        for node in range(len(v)):
            if not skipped[node]:
                v[node] = leaf_value(leaf, states[node])
