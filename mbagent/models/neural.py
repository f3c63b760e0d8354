"""The learned model of the paper's section 3: a predictor network, and a conditioner network on top of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mbagent.models import causal_bits as causal_bits  # its overloads
from mbagent.models.arithmetic import Floats32, probabilities
from mbagent.models.base import (
    LARGEST_NUMBER,
    Actions,
    BaseTransitionModel,
    Bools,
    FitReport,
    Floats,
    Randomness,
    States,
    Successors,
    as_keys,
)
from mbagent.models.bit_networks import CausalBits, pack_bits
from mbagent.models.config import NeuralConfig
from mbagent.models.kernels import GroupWeights
from mbagent.models.networks import Conditioner, DensePredictor, FactorCodec
from mbagent.models.packing import CompiledBody, compiled_body, pack_dense, pack_groups, pack_layout
from mbagent.models.samplers import log_prob_causal, sample_causal, sample_independent
from mbagent.models.sweeps import sample_sweeps
from mbagent.models.systematic import causal_successors, independent_successors
from mbagent.models.training import Examples, Trainer, as_examples, examples, one_thread
from mbagent.transitions import TransitionDataset

BodyFactory: TypeAlias = Callable[[FactorCodec, torch.Generator], nn.Module]
"""Builds a predictor body (see ``networks.Predictor``); all its first weights must come from the generator."""


class NeuralTransitionModel(BaseTransitionModel):
    """A predictor network, alone or with a conditioner network.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A of a single step.
        config: see NeuralConfig.
        body: builds another predictor body than the dense one.
        n_steps: actions in the string that is an action of this model (paper 4.2); see ``FactorCodec``.
        seed: of the first weights; ``fit`` starts from its own seed's.
    """

    def __init__(
        self,
        cardinalities: tuple[int, ...],
        n_actions: int,
        config: NeuralConfig | None = None,
        *,
        body: BodyFactory | None = None,
        n_steps: int = 1,
        seed: int = 0,
    ) -> None:
        if n_steps < 1 or n_actions**n_steps > LARGEST_NUMBER:
            raise ValueError(
                f"A model's action is a string of 1 or more actions, at most {LARGEST_NUMBER:.0e} strings in all; "
                f"got n_steps = {n_steps} with {n_actions} actions."
            )
        super().__init__(cardinalities, n_actions**n_steps)
        self.config = config or NeuralConfig()
        self.codec = FactorCodec(self.cardinalities, n_actions, n_steps)
        self._body = body
        self._layout = pack_layout(self.codec)
        self._dropout = self.config.dropout_for(len(self.cardinalities))
        self._build(seed)

    def _build(self, seed: int) -> torch.Generator:
        """New networks; returns the generator that their weights came from."""
        config, generator = self.config, torch.Generator().manual_seed(seed)
        self.predictor: nn.Module
        if self._body is not None:
            self.predictor = self._body(self.codec, generator)
        else:
            shape = (config.hidden, config.activation, config.residual, self._dropout)
            self.predictor = DensePredictor(self.codec, *shape, generator=generator)
        self.conditioner: Conditioner | None = None
        if config.conditioner is not None:
            self.conditioner = self._new_conditioner(None, generator)
        self._online: torch.optim.Optimizer | None = None
        self._changed()
        return generator

    def _new_conditioner(self, grouped: torch.Tensor | None, generator: torch.Generator) -> Conditioner:
        config = self.config
        assert config.conditioner is not None
        return Conditioner(
            self.codec,
            config.conditioner,
            config.group_size,
            config.activation,
            config.correction,
            self._dropout,
            grouped,
            generator=generator,
        )

    def _changed(self) -> None:
        self._forward: CompiledBody | None = None
        self._groups: GroupWeights | None = None
        self._kernel: CausalBits | None = None

    @one_thread()
    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel; fits anew from first weights that depend on ``seed`` only, whatever was fitted before.

        Going on from the weights of an earlier fit was measured, too: it takes half the time or less, but ends 0.001 to
        0.003 nats a transition worse than fitting anew to all the data, and depends on what was fitted before.

        The predictor is fitted first; then the conditioner, with groups for the factors that the predictor leaves open.
        """
        began = time.perf_counter()
        generator = self._build(seed)
        train_rows, held_out_rows = data.split(self.config.training.validation, seed)
        train, held_out = examples(train_rows), examples(held_out_rows)
        trainer = Trainer(self.codec, self.predictor, None, self.config.training)
        half = progress if progress is None or self.conditioner is None else lambda share: progress(0.5 * share)
        epochs = trainer.fit(train, held_out, generator, half)
        if self.conditioner is not None:
            grouped = trainer.open_factors(held_out)
            self.conditioner = trainer.conditioner = self._new_conditioner(grouped, generator)
            half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
            epochs += trainer.fit_conditioner(train, held_out, generator, half)
        self._changed()
        first, second = trainer.evaluate(held_out)
        return FitReport(
            n_train=len(train_rows),
            n_validation=len(held_out_rows),
            epochs=round(epochs),
            seconds=time.perf_counter() - began,
            predictor_loss=first,
            conditioner_loss=second,
            exact_match=self._exact_match(held_out),
            log={
                "distinct_transitions": float(len(train)),
                "conditioned_factors": float(len(self.conditioner.members)) if self.conditioner else 0.0,
            },
        )

    def _exact_match(self, rows: Examples) -> float:
        """Weighted share of transitions whose likeliest outcome, factor after factor, is the one met."""
        states, actions, outcomes = rows.states.numpy(), rows.actions.numpy(), rows.outcomes.numpy()
        logits, probs = self._predict(states, actions)
        likeliest = probs.argmax(axis=2)
        if self.config.conditioner == "causal":
            keys = np.zeros(len(states), dtype=np.uint64)
            likeliest = sample_causal(
                states,
                actions,
                logits,
                probs,
                keys,
                self._layout,
                self._packed_groups(),
                self.config.certain,
                True,
            )
        weights = rows.weights.numpy()
        return float(np.average((likeliest == outcomes).all(axis=1), weights=weights)) if len(weights) else 1.0

    @one_thread()
    def observe(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> None:
        """The paper's on-line method: one gradient step with each observation's own outcome as target.

        Follows a world whose dynamics change; slower, and it depends on the order of what is seen.
        """
        trainer = Trainer(self.codec, self.predictor, self.conditioner, self.config.training)
        if self._online is None:
            parameters = [p for module in self._parts().values() for p in module.parameters()]
            self._online = torch.optim.Adam(parameters, lr=self.config.training.online_learning_rate)
        trainer.observe(self._online, as_examples(states, actions, next_states, terminated))
        self._changed()

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        keys = as_keys(rng, len(states))
        states, actions = _rows(states, actions, len(self.cardinalities))
        logits, probs = self._predict(states, actions)
        config = self.config
        if config.conditioner is None:
            factors = sample_independent(probs, self._layout.outputs, keys)
        elif config.conditioner == "causal":
            factors = sample_causal(
                states,
                actions,
                logits,
                probs,
                keys,
                self._layout,
                self._packed_groups(),
                config.certain,
                False,
            )
        else:
            factors = sample_sweeps(
                states,
                actions,
                logits,
                probs,
                keys,
                self._layout,
                self._packed_groups(),
                config.certain,
                config.sweeps,
                config.real_guess,
            )
        return np.ascontiguousarray(factors[:, :-1]), factors[:, -1] == 1

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        probs = self.probabilities(states, actions)[:, :-1]
        possible = np.arange(self.codec.width) < np.asarray(self.cardinalities)[:, None]
        return probs[:, possible]

    def probabilities(self, states: States, actions: Actions) -> Floats:
        """The predictor's output for every factor, ``terminated`` last: float64 [B, O, K], 0 where a factor lacks a value."""
        return self._predict(*_rows(states, actions, len(self.cardinalities)))[1]

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact for the distribution that ``sample`` draws from."""
        if self.config.conditioner == "others":
            raise NotImplementedError(
                'A conditioner with mask "others" samples by sweeps and has no exact probabilities; '
                'use NeuralConfig(conditioner="causal").'
            )
        states, actions = _rows(states, actions, len(self.cardinalities))
        outcomes = np.concatenate([next_states, terminated[:, None]], axis=1).astype(np.int64)
        logits, probs = self._predict(states, actions)
        if self.config.conditioner is None:
            with np.errstate(divide="ignore"):
                result: Floats = np.log(np.take_along_axis(probs, outcomes[:, :, None], axis=2)[:, :, 0]).sum(axis=1)
            return result
        return log_prob_causal(states, actions, outcomes, logits, probs, self._layout, self._packed_groups(), self.config.certain)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; systematic draws where probabilities are exact (``systematic.py``), else plain draws."""
        if self.config.conditioner == "others":
            return super().successors(states, actions, n_samples, seed)
        states, actions = _rows(states, actions, len(self.cardinalities))
        logits, probs = self._predict(states, actions)
        if self.config.conditioner is None:
            return independent_successors(probs, self._layout.outputs, n_samples, seed)
        return causal_successors(
            states,
            actions,
            logits,
            probs,
            self._layout,
            self._packed_groups(),
            self.config.certain,
            n_samples,
            seed,
        )

    def kernel(self) -> CausalBits | None:
        """The networks for compiled search (see ``compiled_model``); None where ``bit_networks`` does not cover them."""
        if self._kernel is None and self.config.conditioner == "causal" and isinstance(self.predictor, DensePredictor):
            self._kernel = pack_bits(pack_dense(self.predictor), self._packed_groups(), self._layout, self.config.certain)
        return self._kernel

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        return {
            f"{part}.{name}": tensor.detach().numpy().copy()
            for part, module in self._parts().items()
            for name, tensor in module.state_dict().items()
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of this shape; nothing is changed then.
        """
        wrong = self._misfit(state)
        if wrong:
            raise ValueError(
                f"These weights do not fit this model (first difference: {wrong[0]!r}); "
                "build the model with the configuration that the weights were saved from."
            )
        if self.conditioner is not None:
            grouped = torch.from_numpy(np.array(state["conditioner.grouped"], dtype=np.bool_))
            self.conditioner = self._new_conditioner(grouped, torch.Generator())
        for part, module in self._parts().items():
            names = module.state_dict()
            module.load_state_dict({n: torch.from_numpy(np.array(state[f"{part}.{n}"])) for n in names})
        self._online = None
        self._changed()

    def _misfit(self, state: Mapping[str, NDArray[Any]]) -> list[str]:
        """Names of arrays that are missing, unknown, or of the wrong shape (the conditioner's first axis is free)."""
        own = self.state_dict()
        wrong = sorted(set(own) ^ set(state))
        for name in own if not wrong else ():
            shape, given = own[name].shape, np.shape(state[name])
            free = name.startswith("conditioner.") and name != "conditioner.grouped"
            if shape[free:] != given[free:] or len(shape) != len(given):
                wrong.append(name)
        return wrong

    def _parts(self) -> dict[str, nn.Module]:
        parts = {"predictor": self.predictor}
        if self.conditioner is not None:
            parts["conditioner"] = self.conditioner
        return parts

    def _packed_groups(self) -> GroupWeights:
        if self._groups is None:
            assert self.conditioner is not None
            self._groups = pack_groups(self.conditioner)
        return self._groups

    def _predict(self, states: States, actions: Actions) -> tuple[Floats32, Floats]:
        """The predictor's logits float32 and probabilities float64, [B, O, K]."""
        if self._forward is None:
            self._forward = compiled_body(self.predictor, self._layout)
        logits = self._forward(states, actions)
        return logits, probabilities(logits, self._layout.outputs)


def _rows(states: States, actions: Actions, n_factors: int) -> tuple[States, Actions]:
    """Both as contiguous int64, the one form that the compiled kernels take, which look at no shape."""
    states, actions = np.ascontiguousarray(states, dtype=np.int64), np.ascontiguousarray(actions, dtype=np.int64)
    if states.ndim != 2 or states.shape[1] != n_factors or actions.shape != (len(states),):
        raise ValueError(
            f"A model of {n_factors} factors needs states [B, {n_factors}] and actions [B], "
            f"got shapes {states.shape} and {actions.shape}."
        )
    return states, actions
