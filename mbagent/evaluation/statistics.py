"""Normalised returns, and interquartile means with hierarchical bootstrap intervals.

The interquartile mean over runs and its bootstrap are those of Agarwal et al. 2021, "Deep Reinforcement
Learning at the Edge of the Statistical Precipice". A run is one training with one seed; the run's score is the mean over its
evaluation episodes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mbagent.types import Floats


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    Attributes:
        estimate: point estimate.
        low: lower end of the interval.
        high: upper end of the interval.
    """

    estimate: float
    low: float
    high: float


def mean_interval(values: Iterable[float]) -> Interval:
    """Mean with its 95% t interval, ignoring NaN values. For a single value, both ends of the interval are NaN."""
    given = np.asarray(list(values), dtype=np.float64)
    known = given[~np.isnan(given)]
    if len(known) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean, half = float(known.mean()), np.nan
    if len(known) > 1:
        half = float(scipy.stats.t.ppf(0.975, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known)))
    return Interval(mean, mean - half, mean + half)


def normalised(returns: ArrayLike, random: float, reference: float) -> Floats:
    """Rescales returns linearly so that random play is 0 and the reference is 1.

    Args:
        returns: returns of any shape.
        random: mean return of the random policy.
        reference: mean return that is scaled to 1; use the exact optimum if it can be computed.

    Returns:
        Float array of the same shape.

    Raises:
        ValueError: ``reference`` is not greater than ``random``, so no scale is defined.
    """
    if not reference > random:
        raise ValueError(
            f"The reference ({reference:g}) has to beat random play ({random:g}) to normalise with; "
            "choose another reference or another goal."
        )
    return (np.asarray(returns, dtype=np.float64) - random) / (reference - random)


def interquartile_mean(values: ArrayLike) -> Floats:
    """Mean of the middle half along the last axis: at each end, a quarter of the values (rounded down) is dropped.

    Args:
        values: floats [..., N].

    Returns:
        Float array [...]; for N < 4, the plain means.

    Raises:
        ValueError: no values.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=-1)
    n = ordered.shape[-1] if ordered.ndim else 0
    if n == 0:
        raise ValueError("The interquartile mean needs at least one value along the last axis.")
    cut = n // 4
    return np.asarray(ordered[..., cut : n - cut].mean(axis=-1))


def interquartile_interval(scores: ArrayLike, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0) -> Interval:
    """Interquartile mean over runs, with a percentile interval from a hierarchical bootstrap.

    Each resample draws runs with replacement and, within each drawn run, episodes with replacement, so that
    the interval covers both the variation between trainings and the noise of the evaluation. With a single run, it covers only
    the evaluation noise.

    Args:
        scores: floats [runs, episodes].
        confidence: probability mass of the interval, between 0 and 1.
        resamples: number of bootstrap resamples.
        seed: seed of the resampling; equal seeds give equal intervals.

    Raises:
        ValueError: ``scores`` is not a matrix with at least one entry, or ``confidence`` is outside (0, 1).
    """
    matrix = np.asarray(scores, dtype=np.float64)
    if matrix.ndim != 2 or matrix.size == 0:
        raise ValueError(f"Scores need the shape [runs, episodes] with at least one entry, not {matrix.shape}.")
    if not 0 < confidence < 1:
        raise ValueError(f"The confidence is a probability between 0 and 1, not {confidence}.")
    runs, episodes = matrix.shape
    rng = np.random.default_rng(seed)
    drawn = _resample(runs, episodes, resamples, rng)
    replicates = interquartile_mean(matrix[drawn].mean(axis=2))
    tail = (1 - confidence) / 2
    low, high = np.quantile(replicates, [tail, 1 - tail])
    return Interval(float(interquartile_mean(matrix.mean(axis=1))), float(low), float(high))


def ratio_interval(
    scores: ArrayLike, others: ArrayLike, zero: float, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """(mean of scores - zero) / (mean of others - zero), with a percentile interval from a hierarchical bootstrap.

    Corresponding entries of the two arrays were played with the same random numbers, so both arrays are resampled with the same
    indices. Numerator and denominator use plain means: trimming could favour one agent by removing only its bad runs.

    Args:
        scores: floats [runs, episodes].
        others: scores of the reference, floats [runs, episodes].
        zero: zero point of the scale, such as the mean of random play.
        confidence: probability mass of the interval, between 0 and 1.
        resamples: number of bootstrap resamples.
        seed: seed of the resampling.

    Raises:
        ValueError: ``scores`` and ``others`` differ in shape, or the mean of ``others`` is not above ``zero``.
    """
    above, below = (np.asarray(x, dtype=np.float64) - zero for x in (scores, others))
    if above.ndim != 2 or above.shape != below.shape or above.size == 0:
        raise ValueError(f"Both sides need the same shape [runs, episodes], not {above.shape} and {below.shape}.")
    if not below.mean() > 0:
        raise ValueError(f"What is measured against ({below.mean() + zero:g}) has to be above zero's stand-in ({zero:g}).")
    drawn = _resample(len(above), above.shape[1], resamples, np.random.default_rng(seed))
    tops, bottoms = above[drawn].mean(axis=(1, 2)), below[drawn].mean(axis=(1, 2))
    tail = (1 - confidence) / 2
    low, high = np.quantile(tops / np.maximum(bottoms, 1e-12), [tail, 1 - tail])
    return Interval(float(above.mean() / below.mean()), float(low), float(high))


def _resample(runs: int, episodes: int, resamples: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], ...]:
    """Index arrays that draw runs with replacement and, within each drawn run, episodes with replacement."""
    drawn_runs = rng.integers(runs, size=(resamples, runs, 1))
    return drawn_runs, rng.integers(episodes, size=(resamples, runs, episodes))
