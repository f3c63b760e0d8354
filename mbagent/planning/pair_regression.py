"""Ridge regression of values on what states have on, and on all pairs of it, by way of a kernel."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from mbagent.models.base import States
from mbagent.planning.leaf_values import Floats, Indices, LeafValues, sum_of
from mbagent_envs._compiled import compiled

RIDGE = 0.1
"""Strength of the pull towards equal values, in states."""

PAIRED = 0.3
"""Weight of pairs beside single columns: how large their part is expected to be."""

MOST_PAIRS = 10_000_000
"""Pairs in all states that are to be valued, at most; where there are more, there are no pairs."""

MOST_COLUMNS = 2000
"""Columns between which there can be pairs."""


class PairRegression:
    """Regression for many targets on the same states; columns are as in LeafValues, each factor's commonest value is none.

    The kernel of two states that share d columns is d + PAIRED d (d - 1) / 2, which counts every pair of columns as one more.

    Args:
        states: int64 [N, F], whose values are given, one at least.
        cardinalities: of the factors.
        valued: int64 [M, F], whose values are asked for.
        low, high: bounds of values.
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
        self._x = csr_array((np.ones(len(rows)), (rows, column)), shape=(len(states), len(used)))
        self._on, self._begin = self._shown(valued)
        n_on = np.diff(self._begin)
        self._paired = len(used) <= MOST_COLUMNS and int((n_on * (n_on - 1) // 2).sum()) <= MOST_PAIRS
        shared = (self._x @ self._x.T).toarray()
        kernel = shared + (PAIRED / 2.0) * shared * (shared - 1.0) if self._paired else shared
        self._typical = kernel.mean(axis=0)
        centred = kernel - self._typical - self._typical[:, None] + self._typical.mean()
        self._factor, self._bounds = cho_factor(centred + RIDGE * np.eye(len(states))), (low, high)

    def _shown(self, states: States) -> tuple[Indices, Indices]:
        """Columns that are on in states [M, F], those of one after another, and where each one's begin, int64 [M + 1]."""
        rows, factors = np.nonzero(states != self._common)
        column = self._column[self._first[factors] + states[rows, factors]]
        known = column >= 0
        return column[known], np.searchsorted(rows[known], np.arange(len(states) + 1)).astype(np.int64)

    def fit(self, values: Floats) -> LeafValues:
        """What fits values [N] of the states best."""
        mean, x = float(values.mean()), self._x
        share = cho_solve(self._factor, values - mean)
        pairs = PAIRED * (x.T @ x.multiply(share[:, None])).toarray() if self._paired else np.zeros((0, 0))
        level = mean - float(share @ self._typical)
        return LeafValues(self._common, self._first, self._column, level, x.T @ share, pairs, *self._bounds)

    def values(self, leaf: LeafValues) -> Floats:
        """Values [M] of the states that they are asked for."""
        out = np.empty(len(self._begin) - 1)
        _sums(leaf, self._on, self._begin, out)
        return out


@compiled
def _sums(leaf: LeafValues, on: Indices, begin: Indices, out: Floats) -> None:
    for i in range(len(out)):
        out[i] = sum_of(leaf, on[begin[i] : begin[i + 1]])
