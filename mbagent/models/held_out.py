"""Comparing candidate models on held-out transitions, of which evenly spaced ones are enough for a quick decision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset

SOME_ROWS, SOME_TESTS = 2500, 1000
"""Transitions learned from and held out to look at a question such as this one."""

FORETOLD = -1e-3
"""Mean log-probability from which on nothing is left to find."""


def better(logs: NDArray[np.float64], others: NDArray[np.float64], errors: float = 3.0) -> bool:
    """Whether log-probabilities [N] are higher than others, of the same transitions, by so many standard errors."""
    gain = logs - others
    return bool(len(gain) > 1 and gain.mean() > errors * gain.std(ddof=1) / np.sqrt(len(gain)))


def thinned(rows: TransitionBatch, most: int) -> TransitionBatch:
    """Evenly chosen transitions."""
    return rows.select(np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)) if len(rows) else rows


def within(data: TransitionDataset, most: int) -> TransitionDataset:
    """The dataset, or evenly chosen transitions of it, that have at most so many values of factors."""
    n = max(1, most // max(1, len(data.cardinalities)))
    if len(data) <= n:
        return data
    smaller = TransitionDataset(data.cardinalities, data.n_actions)
    smaller.append(thinned(data.rows(), n))
    return smaller
