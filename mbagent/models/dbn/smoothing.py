"""Back-off statistics of a variable given its value and the action: persistence and the probability of a value never observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbagent.types import Floats, Ints

THETAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
"""Parameters of Ewens' formula to choose from."""


@dataclass(frozen=True)
class Smoothing:
    """Statistics of a variable after each (action class, value) pair, regardless of all other features.

    Attributes:
        persistence: share of a pair's rows in which the variable kept its value, [pairs]; 1 without rows.
        unseen_mass: probability of outcomes never observed after that pair, [pairs]; without rows, as after one row.
        base: smoothed frequency of each value among changes, [cardinality], summing to one.
    """

    persistence: Floats
    unseen_mass: Floats
    base: Floats


@dataclass(frozen=True)
class Pools:
    """Pairs whose rows are counted together for the unseen mass.

    Attributes:
        of: number of each pair's pool, int64 [pairs].
        positives: outcome of each row, numbered consistently within a pool, int64 [N].
    """

    of: Ints
    positives: Ints


def smoothing_of(cardinality: int, n_actions: int, actions: Ints, now: Ints, then: Ints, pools: Pools | None = None) -> Smoothing:
    """Statistics of a variable in N rows; without ``pools``, each (action, current value) pair is a pool and outcomes are values.

    The unseen mass decreases with the number of rows as in Ewens' sampling formula, theta / (rows + theta). Theta has the best
    leave-one-out likelihood of the outcomes: it is large if many different outcomes follow a pair, and close to zero if the same
    outcomes recur.
    """
    size = n_actions * cardinality
    pair = actions * cardinality + now
    visits = np.bincount(pair, minlength=size).astype(np.float64)
    stayed = np.bincount(pair[now == then], minlength=size)
    persistence = np.where(visits > 0, stayed / np.maximum(visits, 1), 1.0)
    changes = np.bincount(then[now != then], minlength=cardinality) + 0.5
    base = changes / changes.sum()
    if cardinality == 2 or len(pair) == 0:
        return Smoothing(persistence, np.zeros(size), base)
    if pools is None:
        return Smoothing(persistence, _unseen_mass(np.arange(size), pair, then, base[then]), base)
    _, positives, times = np.unique(pools.positives, return_inverse=True, return_counts=True)
    share = (times + 0.5) / (times + 0.5).sum()
    return Smoothing(persistence, _unseen_mass(pools.of, pools.of[pair], positives, share[positives]), base)


def _unseen_mass(pool_of: Ints, pool: Ints, positives: Ints, base: Floats) -> Floats:
    """Probability of unseen outcomes after each pair.

    Args:
        pool_of: pool of each pair, int64 [pairs].
        pool: pool of each row, int64 [N].
        positives: outcome of each row, int64 [N].
        base: probability of that outcome without any data, [N].
    """
    visits = np.bincount(pool, minlength=int(pool_of.max()) + 1).astype(np.float64)
    _, first, times = np.unique(pool * (int(positives.max()) + 1) + positives, return_index=True, return_counts=True)
    n, c, likely = visits[pool[first]], times.astype(np.float64), base[first]

    def log_probs(theta: float) -> float:
        again = np.where(c > 1, np.log(np.maximum(c - 1, 1)), np.log(theta * likely))
        return float((c * (again - np.log(n - 1 + theta))).sum())

    theta = max(THETAS, key=log_probs)
    return np.asarray(theta / (np.maximum(visits, 1.0) + theta))[pool_of]
