"""What a unit does after a present value and an action, whatever else is the case: how often it stays, or does what is new."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbagent.types import Floats, Ints

THETAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
"""Parameters of Ewens' formula to choose from."""


@dataclass(frozen=True)
class Smoothing:
    """What a unit does after each pair (way, value), whatever else is the case.

    Attributes:
        persistence: share of a pair's rows in which the unit kept its value, [pairs]; 1 where there are none.
        unseen_mass: probability that it does what it never did after that pair, [pairs]; where there are no
            rows, as after one.
        base: how often each value came anew, [cardinality], summing to one.
    """

    persistence: Floats
    unseen_mass: Floats
    base: Floats


@dataclass(frozen=True)
class Pools:
    """Pairs whose rows are counted together for what is new.

    Attributes:
        of: number of each pair's pool, int64 [pairs].
        positives: what came in each row, by any numbers that mean the same throughout a pool, int64 [N].
    """

    of: Ints
    positives: Ints


def smoothing_of(cardinality: int, n_actions: int, actions: Ints, now: Ints, then: Ints, pools: Pools | None = None) -> Smoothing:
    """A unit's habit in N rows; where ``pools`` is None, each pair (action, present value) is a pool, and what comes is a value.

    Novelty falls with the rows seen as in Ewens' sampling formula, theta / (rows + theta), with the theta under which what
    followed each pair is foretold best, each row from the others: large where anything may follow, next to nothing
    where the same things follow again and again.
    """
    size = n_actions * cardinality
    pair = actions * cardinality + now
    visits = np.bincount(pair, minlength=size).astype(np.float64)
    stayed = np.bincount(pair[now == then], minlength=size)
    persistence = np.where(visits > 0, stayed / np.maximum(visits, 1), 1.0)
    anew = np.bincount(then[now != then], minlength=cardinality) + 0.5
    base = anew / anew.sum()
    if cardinality == 2 or len(pair) == 0:
        return Smoothing(persistence, np.zeros(size), base)
    if pools is None:
        return Smoothing(persistence, _unseen_mass(np.arange(size), pair, then, base[then]), base)
    _, positives, times = np.unique(pools.positives, return_inverse=True, return_counts=True)
    share = (times + 0.5) / (times + 0.5).sum()
    return Smoothing(persistence, _unseen_mass(pools.of, pools.of[pair], positives, share[positives]), base)


def _unseen_mass(pool_of: Ints, pool: Ints, positives: Ints, base: Floats) -> Floats:
    """Probability of what is new after each pair.

    Args:
        pool_of: pool of each pair, int64 [pairs].
        pool: pool of each row, int64 [N].
        positives: what came in each row, int64 [N].
        base: how likely that is where nothing is known, [N].
    """
    visits = np.bincount(pool, minlength=int(pool_of.max()) + 1).astype(np.float64)
    _, first, times = np.unique(pool * (int(positives.max()) + 1) + positives, return_index=True, return_counts=True)
    n, c, likely = visits[pool[first]], times.astype(np.float64), base[first]

    def log_probs(theta: float) -> float:
        again = np.where(c > 1, np.log(np.maximum(c - 1, 1)), np.log(theta * likely))
        return float((c * (again - np.log(n - 1 + theta))).sum())

    theta = max(THETAS, key=log_probs)
    return np.asarray(theta / (np.maximum(visits, 1.0) + theta))[pool_of]
