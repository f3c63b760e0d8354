"""Rules that changed (paper 3.1): from which step on the past still tells how a variable behaves, one by one.

Where a few recent steps foretell the newest ones better than all steps do, something changed; what did not change keeps all
its data, so that only what is new has to be learned anew.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.transitions import TransitionBatch

Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]
Foretell: TypeAlias = Callable[[TransitionBatch, TransitionBatch], Floats]
"""``foretell(train, tests) -> float [T, V]``: log-probability of each variable's outcome after learning from ``train``."""

NEWEST = 200
"""Steps that are foretold."""

LEAST = 250
"""Steps of the shortest past that is tried; each longer one is twice as long."""

MOST_ROWS = 2500
"""Of a longer past, so many evenly chosen steps are learned from."""

NOTICEABLE = 0.02
"""Nats a step that must be gained."""


def still_true_since(rows: TransitionBatch, n_variables: int, foretell: Foretell) -> Ints:
    """First row that tells of each variable as it is now, int64 [V]; 0 where nothing changed.

    Args:
        rows: transitions in the order met.
        n_variables: number of variables V.
        foretell: learns from some transitions and foretells others.
    """
    since, n_old = np.zeros(n_variables, dtype=np.int64), len(rows) - NEWEST
    if n_old < 2 * LEAST:
        return since
    tests, thinned = rows.select(np.arange(n_old, len(rows))), np.linspace(0, n_old - 1, min(n_old, MOST_ROWS))
    everything = foretell(rows.select(thinned.astype(np.int64)), tests)
    best, best_mean = since.copy(), everything.mean(axis=0)
    best_logs = everything.copy()
    changed, length, tried = np.zeros(n_variables, dtype=np.bool_), LEAST, 0
    while 1.5 * length < n_old and (tried < 2 or changed.any()):
        first = n_old - length
        some = np.linspace(first, n_old - 1, min(length, MOST_ROWS)).astype(np.int64)
        recent = foretell(rows.select(some), tests)
        changed |= _gained(recent - everything)
        better = changed & (recent.mean(axis=0) > best_mean)
        best[better], best_mean[better], best_logs[:, better] = first, recent.mean(axis=0)[better], recent[:, better]
        length, tried = 2 * length, tried + 1
    if changed.any() and n_old > MOST_ROWS:  # what a part of the past cannot foretell, all of it perhaps can
        changed &= _gained(best_logs - foretell(rows.select(np.arange(n_old)), tests))
    since[changed] = best[changed]
    return since


def _gained(gain: Floats) -> NDArray[np.bool_]:
    """Of which variables the gains [T, V] are more than chance, and noticeable."""
    error = gain.std(axis=0, ddof=1) / np.sqrt(len(gain))
    limit = (3.0 + np.sqrt(2.0 * np.log(gain.shape[1]))) * error
    result: NDArray[np.bool_] = (gain.mean(axis=0) > limit) & (gain.mean(axis=0) > NOTICEABLE)
    return result
