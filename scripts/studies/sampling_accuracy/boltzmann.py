"""A conditional restricted Boltzmann machine, the other family of joint samplers that the paper's discussion mentions.

P(y | x) is proportional to exp(y b + y A x) prod_h (1 + exp(c_h + W_h y + U_h x)), as in Mnih, Larochelle and Hinton 2011,
"Conditional restricted Boltzmann machines for structured output prediction". x are the inputs for state and action,
y the outputs for the next factors and ``terminated``; a factor with k > 2 values is a softmax over k outputs. This model serves
for comparison: the agent's own models sample in one pass and have exact probabilities.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mbagent.data import TransitionDataset
from mbagent.models.base import BaseTransitionModel
from mbagent.models.fit_report import FitReport
from mbagent.models.neural.networks import FactorCodec, uniform
from mbagent.models.neural.training import Examples, batches, examples, one_cycle, one_thread
from mbagent.models.protocol import as_keys
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs.random_keys import derive, uniforms

ENUMERATED = 4096
"""Maximum number of joint outcomes for which probabilities are exact, by enumeration."""


@dataclass(frozen=True)
class BoltzmannConfig:
    """Size and training.

    Attributes:
        hidden: hidden units.
        learning_rate: maximum of Adam's one-cycle schedule.
        epochs: passes over the distinct rows, within the bounds on steps.
        min_steps: minimum number of gradient steps.
        max_steps: maximum number of gradient steps.
        batch_size: rows of a gradient step.
        contrast: Gibbs steps of contrastive divergence (k of CD-k).
        burn_in: Gibbs steps from a random outcome before a sample.
        exact: whether training uses the exact likelihood instead of contrastive divergence, for at most ``ENUMERATED`` outcomes.
    """

    hidden: int = 128
    learning_rate: float = 0.01
    epochs: float = 300.0
    min_steps: int = 3000
    max_steps: int = 10_000
    batch_size: int = 64
    contrast: int = 10
    burn_in: int = 100
    exact: bool = True


class ConditionalBoltzmannMachine(BaseTransitionModel):
    """A conditional restricted Boltzmann machine as a transition model.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        config: see BoltzmannConfig.
        seed: of the initial weights; ``fit`` starts from those of its own seed.
    """

    def __init__(
        self, cardinalities: tuple[int, ...], n_actions: int, config: BoltzmannConfig | None = None, *, seed: int = 0
    ) -> None:
        super().__init__(cardinalities, n_actions)
        self.config = config or BoltzmannConfig()
        self.codec = FactorCodec(self.cardinalities, self.n_actions)
        self._build(seed)

    def _build(self, seed: int) -> torch.Generator:
        generator = torch.Generator().manual_seed(seed)
        n_x, n_y, n_h = self.codec.n_inputs, self.codec.n_columns, self.config.hidden
        self.weights = nn.ParameterDict(
            {
                "b": torch.zeros(n_y),
                "c": torch.zeros(n_h),
                "A": uniform((n_y, n_x), 0.01, generator),
                "W": uniform((n_h, n_y), 0.1, generator),
                "U": uniform((n_h, n_x), 0.1, generator),
            }
        )
        return generator

    @property
    def n_outcomes(self) -> int:
        """Number of joint outcomes of the next factors and ``terminated``."""
        return int(np.prod([float(k) for k in self.codec.outputs]))

    @one_thread()
    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel; starts from new weights and uses all rows."""
        began, config, generator = time.perf_counter(), self.config, self._build(seed)
        rows = examples(data.rows())
        per_epoch = max(1, -(-len(rows) // config.batch_size))
        n_steps = int(min(max(config.epochs * per_epoch, config.min_steps), config.max_steps)) if len(rows) else 0
        optimizer = torch.optim.Adam(self.weights.parameters(), lr=config.learning_rate)
        all_outcomes = self._all_outcomes() if config.exact and self.n_outcomes <= ENUMERATED else None
        for done, batch in enumerate(batches(rows, config.batch_size, n_steps, generator)):
            optimizer.param_groups[0]["lr"] = config.learning_rate * one_cycle(done / n_steps)
            optimizer.zero_grad(set_to_none=True)
            self._loss(batch, all_outcomes, generator).backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            if progress is not None and done % 100 == 0:
                progress(done / n_steps)
        if progress is not None:
            progress(1.0)
        seconds = time.perf_counter() - began
        return FitReport(n_train=len(data), n_validation=0, epochs=round(n_steps / per_epoch), seconds=seconds)

    def _loss(self, batch: Examples, all_outcomes: Tensor | None, generator: torch.Generator) -> Tensor:
        """Negative log-likelihood if all outcomes are enumerated; else the objective of contrastive divergence."""
        inputs = self.codec.inputs(batch.states, batch.actions)
        outcomes = self.codec.targets(batch.outcomes)
        if all_outcomes is not None:
            scores = self._scores(inputs, all_outcomes)
            losses = torch.logsumexp(scores, dim=1) - self._scores(inputs, outcomes[:, None])[:, 0]
            return (losses * batch.weights).mean()
        with torch.no_grad():
            negatives = outcomes
            for _ in range(self.config.contrast):
                hidden = torch.bernoulli(torch.sigmoid(self._hidden_inputs(inputs, negatives)), generator=generator)
                probabilities = torch.softmax(self._logits(inputs, hidden), dim=2)
                drawn = torch.multinomial(probabilities.flatten(0, 1), 1, generator=generator).view(len(inputs), -1)
                negatives = self.codec.targets(drawn)
        difference = self._scores(inputs, negatives[:, None]) - self._scores(inputs, outcomes[:, None])
        return (difference[:, 0] * batch.weights).mean()

    def _all_outcomes(self) -> Tensor:
        """Columns [Y, n_columns] of all joint outcomes."""
        outcomes = list(itertools.product(*(range(k) for k in self.codec.outputs)))
        return self.codec.targets(torch.tensor(outcomes, dtype=torch.int64))

    def _hidden_inputs(self, inputs: Tensor, outcomes: Tensor) -> Tensor:
        """Inputs [B, H] of the hidden units."""
        w = self.weights
        hidden_inputs: Tensor = outcomes @ w["W"].T + inputs @ w["U"].T + w["c"]
        return hidden_inputs

    def _logits(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        """Logits [B, O, K] of the next factors given the hidden units [B, H]."""
        w = self.weights
        return self.codec.logits(hidden @ w["W"] + inputs @ w["A"].T + w["b"])

    def _scores(self, inputs: Tensor, outcomes: Tensor) -> Tensor:
        """Unnormalised log-probability [B, Y] of outcomes [Y, n_columns], or of different ones for each row [B, Y, n_columns]."""
        w = self.weights
        linear = inputs @ w["A"].T + w["b"]
        hidden_inputs = (outcomes @ w["W"].T) + (inputs @ w["U"].T + w["c"])[:, None]
        scores: Tensor = (outcomes * linear[:, None]).sum(dim=2) + functional.softplus(hidden_inputs).sum(dim=2)
        return scores

    @one_thread()
    @torch.no_grad()
    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel: ``burn_in`` steps of block Gibbs sampling from a random outcome."""
        keys, codec = as_keys(rng, len(states)), self.codec
        inputs = codec.inputs(*_tensors(states, actions)).double()
        w = {name: value.double() for name, value in self.weights.items()}
        from_inputs, to_hidden = inputs @ w["A"].T + w["b"], inputs @ w["U"].T + w["c"]
        logits = codec.logits(torch.zeros(len(inputs), codec.n_columns, dtype=torch.float64))
        factors = _choose(logits, uniforms(keys, len(codec.outputs)))
        for step in range(self.config.burn_in):
            noise = uniforms(derive(keys, step), self.config.hidden + len(codec.outputs))
            hidden_inputs = codec.targets(factors).double() @ w["W"].T + to_hidden
            hidden = (torch.from_numpy(noise[:, : self.config.hidden]) < torch.sigmoid(hidden_inputs)).double()
            factors = _choose(codec.logits(hidden @ w["W"] + from_inputs), noise[:, self.config.hidden :])
        result = factors.numpy()
        return np.ascontiguousarray(result[:, :-1]), result[:, -1] == 1

    def marginals(self, states: States, actions: Actions, n_samples: int = 1000) -> Floats:
        """See TransitionModel; exact if all outcomes can be enumerated, else from samples."""
        offsets = np.concatenate([[0], np.cumsum(self.cardinalities)[:-1]])
        result = np.zeros((len(states), sum(self.cardinalities)))
        if self.n_outcomes <= ENUMERATED:
            all_outcomes = np.array(list(itertools.product(*(range(k) for k in self.codec.outputs))))[:, :-1]
            probabilities = np.exp(self._log_probabilities(states, actions))
            for outcome, mass in zip(all_outcomes, probabilities.T, strict=True):
                result[:, offsets + outcome] += mass[:, None]
            return result
        rows = np.repeat(np.arange(len(states)), n_samples)
        drawn, _ = self.sample(states[rows], actions[rows], derive(0, np.arange(len(rows))))
        np.add.at(result, (rows[:, None], offsets + drawn), 1.0 / n_samples)
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact, for models whose outcomes can be enumerated.

        Raises:
            NotImplementedError: there are more than ``ENUMERATED`` outcomes.
        """
        if self.n_outcomes > ENUMERATED:
            raise NotImplementedError(
                f"A Boltzmann machine over {self.n_outcomes:.3g} joint outcomes has no exact probabilities; "
                f"these are available for at most {ENUMERATED:,} outcomes."
            )
        outcomes = np.concatenate([next_states, terminated[:, None]], axis=1).astype(np.int64)
        place = np.ravel_multi_index(tuple(outcomes.T), self.codec.outputs)
        result: Floats = self._log_probabilities(states, actions)[np.arange(len(states)), place]
        return result

    @one_thread()
    @torch.no_grad()
    def _log_probabilities(self, states: States, actions: Actions) -> Floats:
        """Log-probabilities [B, Y] of all joint outcomes, in the order of ``itertools.product``."""
        all_outcomes, parts = self._all_outcomes(), []
        for begin in range(0, len(states), 256):
            inputs = self.codec.inputs(*_tensors(states[begin : begin + 256], actions[begin : begin + 256]))
            parts.append(torch.log_softmax(self._scores(inputs, all_outcomes).double(), dim=1))
        return torch.cat(parts).numpy() if parts else np.zeros((0, len(all_outcomes)))

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        return {name: value.detach().numpy().copy() for name, value in self.weights.items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays do not have the shapes of this model; nothing is changed then.
        """
        own = {name: tuple(value.shape) for name, value in self.weights.items()}
        given = {name: np.shape(value) for name, value in state.items()}
        if own != given:
            raise ValueError(f"This model has arrays of shapes {own}, but was given {given}; build it with the same size.")
        for name, value in state.items():
            self.weights[name].data = torch.from_numpy(np.array(value, dtype=np.float32))


def _tensors(states: States, actions: Actions) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(np.ascontiguousarray(states, dtype=np.int64)), torch.from_numpy(np.asarray(actions, dtype=np.int64))


def _choose(logits: Tensor, noise: Floats) -> Tensor:
    """The value [B, O] of each factor: the inverse of its distribution function at the uniforms ``noise`` [B, O]."""
    cumulated = torch.softmax(logits, dim=2).cumsum(dim=2)
    return (torch.from_numpy(noise)[:, :, None] >= cumulated[:, :, :-1]).sum(dim=2)
