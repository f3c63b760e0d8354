"""Comparison of candidate models on held-out transitions; evenly spaced subsets suffice for quick decisions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset

SOME_ROWS, SOME_TESTS = 2500, 1000
"""Maximum numbers of transitions for fits and for held-out tests in quick decisions between candidates."""

PERFECT_LOG_PROB = -1e-3
"""Mean log-probability above which predictions are considered perfect, so that no candidate can improve them."""


def better(logs: NDArray[np.float64], others: NDArray[np.float64], errors: float = 3.0) -> bool:
    """Whether log-probabilities [N] exceed ``others``, of the same transitions, by ``errors`` standard errors on average."""
    gain = logs - others
    return bool(len(gain) > 1 and gain.mean() > errors * gain.std(ddof=1) / np.sqrt(len(gain)))


def thinned(rows: TransitionBatch, most: int) -> TransitionBatch:
    """At most ``most`` evenly spaced transitions."""
    return rows.select(np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)) if len(rows) else rows


def within(data: TransitionDataset, most: int) -> TransitionDataset:
    """The dataset, or evenly spaced transitions of it, such that transitions times factors are at most ``most``."""
    n = max(1, most // max(1, len(data.cardinalities)))
    if len(data) <= n:
        return data
    smaller = TransitionDataset(data.cardinalities, data.n_actions)
    smaller.append(thinned(data.rows(), n))
    return smaller
