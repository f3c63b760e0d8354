"""The compared samplers, each a transition model fitted to the observations of a trial."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from mbagent.models.protocol import TransitionModel
from mbagent.models.tabular import TabularModel
from mbagent_envs.random_keys import derive
from studies.sampling_accuracy.boltzmann import BoltzmannConfig, ConditionalBoltzmannMachine
from studies.sampling_accuracy.data import Observations
from studies.sampling_accuracy.measures import Distribution, counted, number

T = TypeVar("T")

PREDICTOR = "predictor alone (paper)"
COMBINED = "predictor + conditioner (paper)"
CAUSAL = "causal conditioner"
BOLTZMANN = "conditional Boltzmann machine"
TABLE = "counts with a prior"
PERFECT = "perfect sampler"

EXHAUSTIVE = 12
"""Largest number of variables for which all 2^d outcomes are listed."""


@dataclass(frozen=True)
class FitOptions:
    """Options for fitting the paper's networks, where its text leaves a choice.

    Attributes:
        iterations: passes over the data, "reshuffling the data on each iteration".
        targets: "batch": the frequencies P(y | X), the first method of section 3.1; "online": one update for the y of
            each observation, its second method, "slower and sensitive to the order of training".
        loss: "squared", as in backpropagation's textbook form, or "cross_entropy".
        learning_rate: maximum of the batch method's schedule; the online method uses a constant third of it.
        memory: AdamW's second beta (batch targets).
        updates: updates per iteration, each with the same number of observations (batch targets).
        sweeps: passes over all variables for one sample; the paper says only "repeat".
        real_guess: start from the predictor's probabilities, the literal reading of step 2, instead of bits sampled from them.
        rounding: of "2d^2+1" hidden nodes in d groups: "down" gives 2d per group, "up" 2d + 1.
        widening: factor of the paper's number of hidden nodes.

    Raises:
        ValueError: an option is out of range.
    """

    iterations: int = 250
    targets: Literal["batch", "online"] = "batch"
    loss: Literal["squared", "cross_entropy"] = "cross_entropy"
    learning_rate: float = 0.15
    memory: float = 0.98
    updates: int = 4
    sweeps: int = 5
    real_guess: bool = False
    rounding: Literal["down", "up"] = "down"
    widening: int = 1

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("iterations", "updates", "sweeps", "widening"):
            if getattr(self, name) < 1:
                raise ValueError(f"fit.{name} must be at least 1, got {getattr(self, name)}.")
        if not 0.0 < self.learning_rate < float("inf"):
            raise ValueError(f"fit.learning_rate must be a finite number above 0, got {self.learning_rate:g}.")
        if not 0.0 <= self.memory < 1.0:
            raise ValueError(f"fit.memory must lie in [0, 1), got {self.memory:g}.")


def paper_config(d: int, n: int, options: FitOptions) -> NeuralConfig:
    """Configuration of the paper's two networks for d variables, and of their fit to n observations."""
    config = NeuralConfig.paper(d)
    training = replace(
        config.training,
        loss=options.loss,
        learning_rate=options.learning_rate,
        online_learning_rate=options.learning_rate / 3.0,
        memory=options.memory,
        batch_size=max(1, n // options.updates),
        epochs=float(options.iterations),
        min_steps=1,
        max_steps=10**9,
        validation=0.0,
        patience=10**9,
    )
    size = (config.group_size + (options.rounding == "up")) * options.widening
    hidden = (config.hidden[0] * options.widening,)
    shape = replace(config, hidden=hidden, group_size=size, training=training)
    return replace(shape, sweeps=options.sweeps, real_guess=options.real_guess)


def causal_config(d: int) -> NeuralConfig:
    """The agent's conditioner, large and trained until it memorises the observations, as this data does not generalise.

    Small data is fitted with full-batch steps, since the noise of small batches keeps probabilities from reaching 0 and 1.
    """
    training = TrainingConfig(
        learning_rate=0.06,
        weight_decay=0.0,
        memory=0.95,
        batch_size=1280,
        epochs=750.0,
        min_steps=2000 if d > 2 else 1000,
        max_steps=10**9,
        validation=0.0,
        patience=10**9,
        negligible=0.0,
    )
    return NeuralConfig(hidden=(8 * d + 32,), group_size=8 * d, dropout=0.0, certain=1.0, training=training)


def fit_paper(data: Observations, options: FitOptions, seed: int) -> tuple[NeuralTransitionModel, NeuralTransitionModel]:
    """(predictor alone, predictor and conditioner combined); the predictor is the same."""
    config = paper_config(data.d, data.outputs.shape[0] * data.outputs.shape[1], options)
    cards = (2,) * data.d
    combined = NeuralTransitionModel(cards, 1, config, seed=seed)
    if options.targets == "batch":
        combined.fit(data.dataset(), seed=seed)
    else:
        _fit_online(combined, data, options.iterations, seed)
    alone = NeuralTransitionModel(cards, 1, replace(config, conditioner=None), seed=seed)
    state = combined.state_dict()
    alone.load_state_dict({name: value for name, value in state.items() if name.startswith("predictor.")})
    return alone, combined


def _fit_online(model: NeuralTransitionModel, data: Observations, iterations: int, seed: int) -> None:
    rows, rng = data.dataset().rows(), np.random.default_rng(seed)
    for _ in range(iterations):
        for i in rng.permutation(len(rows)):
            row = rows.select(slice(i, i + 1))  # the index has no meaning
            model.observe(row.states, row.actions, row.next_states, row.terminated)


def fit_causal(data: Observations, seed: int) -> NeuralTransitionModel:
    """Predictor and causal conditioner with exact probabilities."""
    model = NeuralTransitionModel((2,) * data.d, 1, causal_config(data.d), seed=seed)
    model.fit(data.dataset(), seed=seed)
    return model


def fit_boltzmann(data: Observations, seed: int) -> ConditionalBoltzmannMachine:
    """The alternative model mentioned in the paper's discussion."""
    config = BoltzmannConfig(hidden=16 * data.d, learning_rate=0.05, batch_size=32, epochs=0.0, min_steps=3000, burn_in=40)
    model = ConditionalBoltzmannMachine((2,) * data.d, 1, config)
    model.fit(data.dataset(), seed=seed)
    return model


def fit_table(data: Observations, prior: float) -> TabularModel:
    """Counts; without a prior they are a perfect sampler."""
    model = TabularModel((2,) * data.d, 1, prior=prior, validation=0.0)
    model.fit(data.dataset())
    return model


def observed(data: Observations) -> Distribution:
    """The observed frequencies."""
    n, c, _ = data.outputs.shape
    return counted(np.repeat(np.arange(n), c), number(data.outputs).ravel(), np.ones(n * c), n)


def draw(model: TransitionModel, data: Observations, n_draws: int, seed: int) -> Distribution:
    """Frequencies of ``n_draws`` independent samples per input."""
    n = len(data.inputs)
    found = np.empty((n, n_draws), dtype=np.uint64)
    step = max(1, 200_000 // n_draws)
    for begin in range(0, n, step):
        rows = np.repeat(np.arange(begin, min(begin + step, n)), n_draws)
        keys = derive(derive(seed, rows), np.tile(np.arange(n_draws), len(rows) // n_draws))
        states, _ = model.sample(data.inputs[rows], np.zeros(len(rows), dtype=np.int64), keys)
        found[begin : begin + step] = number(states).reshape(-1, n_draws)
    return counted(np.repeat(np.arange(n), n_draws), found.ravel(), np.ones(n * n_draws), n)


def draw_systematically(model: TransitionModel, data: Observations, n_draws: int, seed: int) -> Distribution:
    """Outcomes of ``n_draws`` systematic samples per input, with the weights that planners get.

    These are the exact probabilities if the outcomes contain nearly all of the mass, else their frequencies.
    """
    n = len(data.inputs)
    successors = model.successors(data.inputs, np.zeros(n, dtype=np.int64), n_draws, seed)
    return counted(successors.rows, number(successors.states), successors.probabilities, n)


def exact(model: TransitionModel, data: Observations) -> Distribution:
    """Exact probabilities of all outcomes if they can be listed, else of the observed ones.

    Raises:
        NotImplementedError: the model has no exact probabilities.
    """
    n, d = len(data.inputs), data.d
    if d <= EXHAUSTIVE:
        every = (np.arange(2**d)[:, None] >> np.arange(d)) & 1
        rows, outcomes = np.repeat(np.arange(n), 2**d), np.tile(every, (n, 1))
    else:
        seen = observed(data)
        rows = seen.inputs
        outcomes = ((seen.outcomes[:, None] >> np.arange(d, dtype=np.uint64)) & np.uint64(1)).astype(np.int64)
    nothing = np.zeros(len(rows), dtype=np.int64)
    logs = model.log_prob(data.inputs[rows], nothing, outcomes, nothing.astype(np.bool_))
    return Distribution(rows, number(outcomes), np.exp(logs), n, complete=d <= EXHAUSTIVE)


def log_likelihood(truth: Distribution, found: Distribution) -> float:
    """Mean log-probability of an observation in nats, from exact probabilities."""
    pairs = {(int(i), int(y)): float(q) for i, y, q in zip(found.inputs, found.outcomes, found.probabilities, strict=True)}
    logs = [np.log(max(pairs.get((int(i), int(y)), 0.0), 1e-300)) for i, y in zip(truth.inputs, truth.outcomes, strict=True)]
    return float((np.array(logs) * truth.probabilities).sum() / truth.n)
