"""Causes of the combined sampler's remaining error: the same networks with one change at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.neural.model import NeuralTransitionModel
from studies.sampling_accuracy.data import Bits, Observations
from studies.sampling_accuracy.measures import Distribution, counted, number
from studies.sampling_accuracy.samplers import FitOptions, draw, fit_paper, paper_config

Sampler: TypeAlias = Callable[[Observations, FitOptions, int, int], Distribution]
"""(data, options, number of samples per input, seed) -> distribution of the samples."""


@dataclass(frozen=True)
class Variant:
    """One change of the combined sampler.

    Attributes:
        name: the change.
        sample: fits and samples.
    """

    name: str
    sample: Sampler


def _changed(change: Callable[[FitOptions], FitOptions]) -> Sampler:
    def sample(data: Observations, options: FitOptions, n_draws: int, seed: int) -> Distribution:
        return draw(fit_paper(data, change(options), seed)[1], data, n_draws, seed)

    return sample


def fit_masked(data: Observations, options: FitOptions, seed: int) -> NeuralTransitionModel:
    """The paper's networks with a causal mask: output i depends on y_<i, so a sample takes one pass without convergence."""
    config = paper_config(data.d, data.outputs.shape[0] * data.outputs.shape[1], options)
    model = NeuralTransitionModel((2,) * data.d, 1, replace(config, conditioner="causal"), seed=seed)
    model.fit(data.dataset(), seed=seed)
    return model


def _causal(data: Observations, options: FitOptions, n_draws: int, seed: int) -> Distribution:
    return draw(fit_masked(data, options, seed), data, n_draws, seed)


def draw_exact_sweeps(data: Observations, options: FitOptions, n_draws: int, seed: int) -> Distribution:
    """The paper's procedure with perfect networks: every probability is the observed frequency.

    If the other variables' values were never observed together, there is no frequency; then the predictor's probability
    is used, from which the procedure started.
    """
    rng, found = np.random.default_rng(seed), []
    for outcomes in data.outputs:
        found.append(number(_swept(outcomes, n_draws, options.sweeps, rng)))
    n = len(data.inputs)
    return counted(np.repeat(np.arange(n), n_draws), np.concatenate(found), np.ones(n * n_draws), n)


def _swept(outcomes: Bits, n_draws: int, sweeps: int, rng: np.random.Generator) -> Bits:
    """Samples [n_draws, d] for an input with observed outcomes [c, d]."""
    d, marginal = outcomes.shape[1], outcomes.mean(axis=0)
    bits: Bits = (rng.random((n_draws, d)) < marginal).astype(np.int64)
    wrong: NDArray[np.int64] = (bits[:, None] != outcomes[None]).sum(axis=2)  # [n_draws, c]
    for _ in range(sweeps):
        for i in rng.permutation(d):
            others = wrong - (bits[:, None, i] != outcomes[None, :, i])
            same = others == 0
            n_same = same.sum(axis=1)
            p = np.where(n_same > 0, same @ outcomes[:, i] / np.maximum(n_same, 1), marginal[i])
            bits[:, i] = rng.random(n_draws) < p
            wrong = others + (bits[:, None, i] != outcomes[None, :, i])
    return bits


VARIANTS: tuple[Variant, ...] = (
    Variant("as scored", _changed(lambda o: o)),
    Variant("four times the iterations", _changed(lambda o: replace(o, iterations=4 * o.iterations))),
    Variant("twice the hidden nodes", _changed(lambda o: replace(o, widening=2))),
    Variant("one sweep", _changed(lambda o: replace(o, sweeps=1))),
    Variant("four times the sweeps", _changed(lambda o: replace(o, sweeps=4 * o.sweeps))),
    Variant("twenty times the sweeps", _changed(lambda o: replace(o, sweeps=20 * o.sweeps))),
    Variant("first guess of real values", _changed(lambda o: replace(o, real_guess=True))),
    Variant("squared error", _changed(lambda o: replace(o, loss="squared"))),
    Variant(
        "twice the nodes, four times the iterations, twenty times the sweeps",
        _changed(lambda o: replace(o, widening=2, iterations=4 * o.iterations, sweeps=20 * o.sweeps)),
    ),
    Variant("perfect networks, same procedure", draw_exact_sweeps),
    Variant("causal mask, same size and training", _causal),
)
