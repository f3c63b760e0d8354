"""Measures samplers on one data set and collects their scores."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mbagent.models.protocol import TransitionModel
from studies.sampling_accuracy import samplers as s
from studies.sampling_accuracy.data import Observations
from studies.sampling_accuracy.measures import (
    Distribution,
    align,
    full_correlation,
    observed_correlation,
    total_variation,
    union_correlation,
    valid_mass,
)

Draws = Literal["exact", "many", "c", "c systematic"]
"""Source of a distribution: exact probabilities, many independent samples, or c independent or c systematic ones."""

NAN = float("nan")

FEW_DRAWS = 100
"""Samples per input for slow samplers, variants, and growing numbers of variables beyond ``samplers.EXHAUSTIVE``."""


@dataclass(frozen=True)
class Score:
    """One sampler on one data set.

    Attributes:
        trial, seed: identification of the data set.
        sampler: name of the sampler.
        draws: source of its distribution.
        union: Pearson over the outcomes observed or generated, the paper's measure; NaN if undefined.
        seen: Pearson over the outcomes observed.
        full: Pearson over all outcomes; NaN if there are too many to list.
        variation: total variation, mean over inputs.
        valid: generated mass on observed outcomes, mean over inputs.
        log_likelihood: nats per observation, from exact probabilities; else NaN.
        at_zero: mean probability of outcomes that were never observed; NaN if there are too many to list.
        at_one: mean probability of outcomes that were always observed; NaN if there are none.
        parameters: number of weights that are not pruned.
        fit_seconds, sample_microseconds: processor time of the fit, and per sample.
    """

    trial: str
    seed: int
    sampler: str
    draws: Draws
    union: float
    seen: float
    full: float
    variation: float
    valid: float
    log_likelihood: float = NAN
    at_zero: float = NAN
    at_one: float = NAN
    parameters: int = 0
    fit_seconds: float = NAN
    sample_microseconds: float = NAN


class Bench:
    """Collects the scores of one data set.

    Args:
        trial, seed: identification for the scores.
        data: the data set.
        n_draws: samples per input where many are drawn.
    """

    def __init__(self, trial: str, seed: int, data: Observations, n_draws: int) -> None:
        """See the class."""
        self.trial, self.seed, self.data, self.n_draws = trial, seed, data, n_draws
        self.truth = s.observed(data)
        self.scores: list[Score] = []
        self.points: dict[str, NDArray[np.float64]] = {}

    def exact(self, sampler: str, model: TransitionModel, seconds: float) -> None:
        """Scores a model by its exact probabilities."""
        found = s.exact(model, self.data)
        self.add(sampler, "exact", found, size(model), seconds, log_likelihood=s.log_likelihood(self.truth, found))

    def many(self, sampler: str, model: TransitionModel, seconds: float, *, keep: bool = False, slow: bool = False) -> None:
        """Scores a model by c and by many independent samples; ``keep`` stores the points of the latter for the scatter plot.

        ``slow`` samplers draw at most ``FEW_DRAWS`` samples if there are many variables.
        """
        n_draws = min(self.n_draws, FEW_DRAWS) if slow and self.data.d > s.EXHAUSTIVE else self.n_draws
        self._drawn(sampler, "c", model, seconds, self.data.outputs.shape[1])
        found = self._drawn(sampler, "many", model, seconds, n_draws)
        if keep:
            self.points[sampler] = np.stack(align(self.truth, found), axis=1)

    def every_way(self, sampler: str, model: TransitionModel, seconds: float) -> None:
        """Scores a model by exact probabilities, many samples, c samples and c systematic samples."""
        self.exact(sampler, model, seconds)
        self.many(sampler, model, seconds)
        found = s.draw_systematically(model, self.data, self.data.outputs.shape[1], self.seed)
        self.add(sampler, "c systematic", found, size(model), seconds)

    def _drawn(self, sampler: str, draws: Draws, model: TransitionModel, seconds: float, n: int) -> Distribution:
        found, took = timed(lambda: s.draw(model, self.data, n, self.seed))
        each = took * 1e6 / (n * len(self.data.inputs))
        self.add(sampler, draws, found, size(model), seconds, sample_microseconds=each)
        return found

    def add(
        self, sampler: str, draws: Draws, found: Distribution, parameters: int = 0, seconds: float = NAN, **more: float
    ) -> None:
        """Scores a distribution; ``more`` are further fields of the score."""
        truth, d = self.truth, self.data.d
        countable = found.complete and d <= s.EXHAUSTIVE
        p, q = align(truth, found)
        self.scores.append(
            Score(
                trial=self.trial,
                seed=self.seed,
                sampler=sampler,
                draws=draws,
                union=union_correlation(truth, found) if draws != "exact" else NAN,
                seen=observed_correlation(truth, found),
                full=full_correlation(truth, found, d) if countable else NAN,
                variation=total_variation(truth, found),
                valid=valid_mass(truth, found),
                at_zero=float(q[p == 0.0].sum()) / (truth.n * 2**d - int((p > 0.0).sum())) if countable else NAN,
                at_one=_mean(q[p > 1.0 - 1e-9]),
                parameters=parameters,
                fit_seconds=seconds,
                **more,
            )
        )


def size(model: TransitionModel) -> int:
    """Number of weights that are not pruned."""
    arrays = model.state_dict()
    masks = {name: array for name, array in arrays.items() if array.dtype == np.bool_}
    pruned = sum(int((~mask).sum()) for name, mask in masks.items() if name.endswith(".mask"))
    return sum(int(array.size) for name, array in arrays.items() if name not in masks) - pruned


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else NAN


def timed(work: Callable[[], s.T]) -> tuple[s.T, float]:
    """Result of the work, and its processor time in seconds."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start
