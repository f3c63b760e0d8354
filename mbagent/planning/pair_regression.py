"""Kernel ridge regression of values on active features and pairs of active features (a polynomial kernel of degree two)."""

from __future__ import annotations

import numpy as np
import scipy

from mbagent.planning.value_iteration import LeafValues, sum_of
from mbagent.types import Floats, Ints, States
from mbagent_envs.jit import compiled

RIDGE = 0.1
"""Ridge penalty, which shrinks values towards their mean; in units of one state's weight."""


PAIRED = 0.3
"""Weight of pairs of features relative to single features: the expected size of their contribution."""


MOST_PAIRS = 10_000_000
"""Maximum number of pairs, summed over the states to evaluate; if there are more, pairs are not used."""


MOST_PAIR_FEATURES = 2000
"""Maximum number of features for which pairs are used."""


class PairRegression:
    """Regression of many targets on fixed states. Features as in LeafValues: a factor's commonest value has none.

    The kernel of two states that share d features is d + PAIRED d (d - 1) / 2: each shared pair acts as a further feature with
    weight PAIRED.

    Args:
        states: int64 [N, F], states to fit the values on, at least one.
        cardinalities: number of values of each factor, length F.
        valued: int64 [M, F], states whose values are predicted.
        low, high: bounds of predicted values.
    """

    def __init__(self, states: States, cardinalities: tuple[int, ...], valued: States, low: float, high: float) -> None:
        """See the class."""
        counts = np.asarray(cardinalities)
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        self._common = np.array([np.bincount(values).argmax() for values in states.T], dtype=np.int64)
        rows, factors = np.nonzero(states != self._common)
        used, column = np.unique(self._first[factors] + states[rows, factors], return_inverse=True)
        self._column = np.full(int(counts.sum()), -1)
        self._column[used] = np.arange(len(used))
        self._x = scipy.sparse.csr_array((np.ones(len(rows)), (rows, column)), shape=(len(states), len(used)))
        self._on, self._begin = self._active_features(valued)
        n_on = np.diff(self._begin)
        self._paired = len(used) <= MOST_PAIR_FEATURES and int((n_on * (n_on - 1) // 2).sum()) <= MOST_PAIRS
        shared = (self._x @ self._x.T).toarray()
        kernel = shared + (PAIRED / 2.0) * shared * (shared - 1.0) if self._paired else shared
        self._kernel_mean = kernel.mean(axis=0)
        centred = kernel - self._kernel_mean - self._kernel_mean[:, None] + self._kernel_mean.mean()
        self._factor, self._bounds = scipy.linalg.cho_factor(centred + RIDGE * np.eye(len(states))), (low, high)

    def _active_features(self, states: States) -> tuple[Ints, Ints]:
        """Active features of states [M, F], concatenated, and offsets where each state's features begin, int64 [M + 1]."""
        rows, factors = np.nonzero(states != self._common)
        column = self._column[self._first[factors] + states[rows, factors]]
        known = column >= 0
        return column[known], np.searchsorted(rows[known], np.arange(len(states) + 1)).astype(np.int64)

    def fit(self, values: Floats) -> LeafValues:
        """Value function fitted to the states' values [N]."""
        mean, x = float(values.mean()), self._x
        dual = scipy.linalg.cho_solve(self._factor, values - mean)
        pairs = PAIRED * (x.T @ x.multiply(dual[:, None])).toarray() if self._paired else np.zeros((0, 0))
        level = mean - float(dual @ self._kernel_mean)
        return LeafValues(self._common, self._first, self._column, level, x.T @ dual, np.ascontiguousarray(pairs), *self._bounds)

    def values(self, leaf: LeafValues) -> Floats:
        """Predicted values [M] of the states ``valued``."""
        out = np.empty(len(self._begin) - 1)
        _sums(leaf, self._on, self._begin, out)
        return out


@compiled
def _sums(leaf: LeafValues, on: Ints, begin: Ints, out: Floats) -> None:
    for i in range(len(out)):
        out[i] = sum_of(leaf, on[begin[i] : begin[i + 1]])
