"""Value function for unexpanded states: linear in features and in pairs of features."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled


class LeafValues(NamedTuple):
    """A sum over the active features of a state and over pairs of them.

    Each of the C features is the test whether a factor has one value, other than its commonest.

    Attributes:
        common: commonest value of each factor, int64 [F]; empty if nothing was learned: unexpanded states then have the lowest
            value of the expanded ones.
        first: where each factor's values begin in ``column``, int64 [F].
        column: index of the feature of each value of each factor, -1 for none, int64 [sum of cardinalities].
        mean: value of a state without active features.
        weights: of each feature, [C].
        pairs: weights of pairs of features, symmetric, [C, C]; [0, 0] if pairs are not used.
        low: lower bound of values.
        high: upper bound of values.
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
"""No values were learned: unexpanded states have the lowest value of the expanded states around their root."""


@compiled
def features_on(leaf: LeafValues, state: Ints, on: Ints) -> int:
    """Writes the active features of a state [F] to ``on`` [F]; returns their number."""
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
    """Value of a state with the active features ``on``."""
    total, paired = leaf.mean, len(leaf.pairs) > 0
    for i in range(len(on)):
        total += leaf.weights[on[i]]
        if paired:
            for j in range(i):
                total += leaf.pairs[on[i], on[j]]
    return float(min(max(total, leaf.low), leaf.high))


@compiled
def leaf_value(leaf: LeafValues, state: Ints) -> float:
    """Value of a state [F]; not defined for LOWEST_KNOWN."""
    on = np.empty(len(state), dtype=np.int64)
    return sum_of(leaf, on[: features_on(leaf, state, on)])


@compiled
def evaluate(leaf: LeafValues, states: Ints, skipped: Bools, v: Floats) -> None:
    """Writes the values of states [N, F] that are not ``skipped`` to ``v`` [N]; does nothing for LOWEST_KNOWN."""
    if len(leaf.common) > 0:
        for node in range(len(v)):
            if not skipped[node]:
                v[node] = leaf_value(leaf, states[node])
