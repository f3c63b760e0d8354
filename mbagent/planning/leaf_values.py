"""What states are worth that were imagined, but not looked beyond."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent_envs._compiled import compiled

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]


class LeafValues(NamedTuple):
    """The sum of a weight for the value of each factor, and of the last weight.

    Attributes:
        weights: [sum of cardinalities + 1]; or empty: an unexpanded state is worth as much as the lowest expanded one.
        first: where each factor's weights begin, int64 [F].
        low: a state is worth so much, at least.
        high: and so much, at most.
    """

    weights: Floats
    first: Indices
    low: float
    high: float


LOWEST_KNOWN = LeafValues(np.zeros(0), np.zeros(0, dtype=np.int64), 0.0, 0.0)
"""Nothing was learned of unexpanded states."""


@compiled
def leaf_value(leaf: LeafValues, state: Indices) -> float:
    """What an unexpanded state [F] is worth; there must be weights."""
    total = leaf.weights[-1]
    for f in range(len(state)):
        total += leaf.weights[leaf.first[f] + state[f]]
    return float(min(max(total, leaf.low), leaf.high))


@compiled
def evaluate(leaf: LeafValues, states: Indices, skipped: Bools, v: Floats) -> None:
    """Writes the values of states [N, F] to ``v`` [N], but of those that are skipped; does nothing without weights."""
    if len(leaf.weights) > 0:
        for node in range(len(v)):
            if not skipped[node]:
                v[node] = leaf_value(leaf, states[node])
