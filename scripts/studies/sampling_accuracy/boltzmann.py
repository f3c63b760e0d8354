"""A conditional restricted Boltzmann machine: the other family of joint samplers that the paper's discussion names.

P(y | x) is proportional to exp(y b + y A x) prod_h (1 + exp(c_h + W_h y + U_h x)), as in Mnih, Larochelle and Hinton 2011,
"Conditional restricted Boltzmann machines for structured output prediction". x are the columns of state and action,
y those of the next factors and ``terminated``; a factor with k > 2 values is a softmax unit of k columns. A yardstick:
the agent's own models sample in one pass and know their probabilities exactly.
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
from mbagent.models.base import BaseTransitionModel, FitReport
from mbagent.models.neural.networks import FactorCodec, uniform
from mbagent.models.neural.training import Examples, batches, examples, one_cycle, one_thread
from mbagent.models.protocol import as_keys
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs.random_keys import derive, uniforms

ENUMERATED = 4096
"""Joint outcomes up to which probabilities are exact, by listing them all."""


@dataclass(frozen=True)
class BoltzmannConfig:
    """Size and training.

    Attributes:
        hidden: hidden units.
        learning_rate: Adam's largest, of a one-cycle schedule.
        epochs: passes over the distinct rows, within the bounds on steps.
        min_steps: fewest gradient steps.
        max_steps: most gradient steps.
        batch_size: rows of a gradient step.
        contrast: Gibbs steps from an observation to the outcome it is contrasted with (CD-k).
        burn_in: Gibbs steps, from a random outcome, before a draw.
        exact: whether training lists all outcomes instead of contrasting, where there are at most ``ENUMERATED``.
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
    """The model.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        config: see BoltzmannConfig.
        seed: of the first weights; ``fit`` starts from its own seed's.
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
        """See TransitionModel; fits anew, to all rows."""
        began, config, generator = time.perf_counter(), self.config, self._build(seed)
        rows = examples(data.rows())
        per_epoch = max(1, -(-len(rows) // config.batch_size))
        n_steps = int(min(max(config.epochs * per_epoch, config.min_steps), config.max_steps)) if len(rows) else 0
        optimizer = torch.optim.Adam(self.weights.parameters(), lr=config.learning_rate)
        every = self._every_outcome() if config.exact and self.n_outcomes <= ENUMERATED else None
        for done, batch in enumerate(batches(rows, config.batch_size, n_steps, generator)):
            optimizer.param_groups[0]["lr"] = config.learning_rate * one_cycle(done / n_steps)
            optimizer.zero_grad(set_to_none=True)
            self._loss(batch, every, generator).backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            if progress is not None and done % 100 == 0:
                progress(done / n_steps)
        if progress is not None:
            progress(1.0)
        seconds = time.perf_counter() - began
        return FitReport(n_train=len(data), n_validation=0, epochs=round(n_steps / per_epoch), seconds=seconds)

    def _loss(self, batch: Examples, every: Tensor | None, generator: torch.Generator) -> Tensor:
        """Minus log-likelihood where all outcomes are listed; else what contrastive divergence descends."""
        inputs = self.codec.inputs(batch.states, batch.actions)
        outcomes = self.codec.targets(batch.outcomes)
        if every is not None:
            scores = self._goodness(inputs, every)
            losses = torch.logsumexp(scores, dim=1) - self._goodness(inputs, outcomes[:, None])[:, 0]
            return (losses * batch.weights).mean()
        with torch.no_grad():
            imagined = outcomes
            for _ in range(self.config.contrast):
                hidden = torch.bernoulli(torch.sigmoid(self._drive(inputs, imagined)), generator=generator)
                probabilities = torch.softmax(self._logits(inputs, hidden), dim=2)
                drawn = torch.multinomial(probabilities.flatten(0, 1), 1, generator=generator).view(len(inputs), -1)
                imagined = self.codec.targets(drawn)
        difference = self._goodness(inputs, imagined[:, None]) - self._goodness(inputs, outcomes[:, None])
        return (difference[:, 0] * batch.weights).mean()

    def _every_outcome(self) -> Tensor:
        """Columns [Y, n_columns] of all joint outcomes."""
        every = list(itertools.product(*(range(k) for k in self.codec.outputs)))
        return self.codec.targets(torch.tensor(every, dtype=torch.int64))

    def _drive(self, inputs: Tensor, outcomes: Tensor) -> Tensor:
        """Inputs [B, H] of the hidden units."""
        w = self.weights
        drive: Tensor = outcomes @ w["W"].T + inputs @ w["U"].T + w["c"]
        return drive

    def _logits(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        """Logits [B, O, K] of the next factors given the hidden units [B, H]."""
        w = self.weights
        return self.codec.logits(hidden @ w["W"] + inputs @ w["A"].T + w["b"])

    def _goodness(self, inputs: Tensor, outcomes: Tensor) -> Tensor:
        """Unnormalised log-probability [B, Y] of outcomes [Y, n_columns], or of each row's own [B, Y, n_columns]."""
        w = self.weights
        linear = inputs @ w["A"].T + w["b"]
        drive = (outcomes @ w["W"].T) + (inputs @ w["U"].T + w["c"])[:, None]
        goodness: Tensor = (outcomes * linear[:, None]).sum(dim=2) + functional.softplus(drive).sum(dim=2)
        return goodness

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
            drive = codec.targets(factors).double() @ w["W"].T + to_hidden
            hidden = (torch.from_numpy(noise[:, : self.config.hidden]) < torch.sigmoid(drive)).double()
            factors = _choose(codec.logits(hidden @ w["W"] + from_inputs), noise[:, self.config.hidden :])
        result = factors.numpy()
        return np.ascontiguousarray(result[:, :-1]), result[:, -1] == 1

    def marginals(self, states: States, actions: Actions, n_samples: int = 1000) -> Floats:
        """See TransitionModel; exact where all outcomes can be listed, else from draws."""
        offsets = np.concatenate([[0], np.cumsum(self.cardinalities)[:-1]])
        result = np.zeros((len(states), sum(self.cardinalities)))
        if self.n_outcomes <= ENUMERATED:
            every = np.array(list(itertools.product(*(range(k) for k in self.codec.outputs))))[:, :-1]
            probabilities = np.exp(self._log_probabilities(states, actions))
            for outcome, mass in zip(every, probabilities.T, strict=True):
                result[:, offsets + outcome] += mass[:, None]
            return result
        rows = np.repeat(np.arange(len(states)), n_samples)
        drawn, _ = self.sample(states[rows], actions[rows], derive(0, np.arange(len(rows))))
        np.add.at(result, (rows[:, None], offsets + drawn), 1.0 / n_samples)
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact where all outcomes can be listed."""
        if self.n_outcomes > ENUMERATED:
            raise NotImplementedError(
                f"A Boltzmann machine over {self.n_outcomes:.3g} joint outcomes has no exact probabilities; "
                f"they are listed up to {ENUMERATED:,}."
            )
        outcomes = np.concatenate([next_states, terminated[:, None]], axis=1).astype(np.int64)
        place = np.ravel_multi_index(tuple(outcomes.T), self.codec.outputs)
        result: Floats = self._log_probabilities(states, actions)[np.arange(len(states)), place]
        return result

    @one_thread()
    @torch.no_grad()
    def _log_probabilities(self, states: States, actions: Actions) -> Floats:
        """Log-probabilities [B, Y] of all joint outcomes, in the order of ``itertools.product``."""
        every, parts = self._every_outcome(), []
        for begin in range(0, len(states), 256):
            inputs = self.codec.inputs(*_tensors(states[begin : begin + 256], actions[begin : begin + 256]))
            parts.append(torch.log_softmax(self._goodness(inputs, every).double(), dim=1))
        return torch.cat(parts).numpy() if parts else np.zeros((0, len(every)))

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        return {name: value.detach().numpy().copy() for name, value in self.weights.items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a machine of this shape; nothing is changed then.
        """
        own = {name: tuple(value.shape) for name, value in self.weights.items()}
        given = {name: np.shape(value) for name, value in state.items()}
        if own != given:
            raise ValueError(f"This machine has arrays of shapes {own}, but was given {given}; build it with the same size.")
        for name, value in state.items():
            self.weights[name].data = torch.from_numpy(np.array(value, dtype=np.float32))


def _tensors(states: States, actions: Actions) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(np.ascontiguousarray(states, dtype=np.int64)), torch.from_numpy(np.asarray(actions, dtype=np.int64))


def _choose(logits: Tensor, noise: Floats) -> Tensor:
    """The value [B, O] of each factor at luck [B, O] of its distribution function."""
    cumulated = torch.softmax(logits, dim=2).cumsum(dim=2)
    return (torch.from_numpy(noise)[:, :, None] >= cumulated[:, :, :-1]).sum(dim=2)
