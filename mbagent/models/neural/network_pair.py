"""The two networks of a neural model: construction, conversion to arrays, and remaining connections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mbagent.models.base import BaseTransitionModel
from mbagent.models.neural.connections import Connections
from mbagent.models.neural.export import pack_layout
from mbagent.models.neural.networks import Conditioner, DensePredictor, FactorCodec
from mbagent.models.neural.training import NeuralConfig
from mbagent.models.protocol import LARGEST_NUMBER

BodyFactory: TypeAlias = Callable[[FactorCodec, torch.Generator], nn.Module]
"""Builds a predictor body (see ``networks.Predictor``); all its initial weights must be drawn from the generator."""


PRUNED = "pruned"
"""An array of this name marks a pruned model, whose zero weights are removed connections; see ``truth_tables.find_parents``."""


NO_MARKS = np.zeros((0, 0), dtype=np.int8)
"""Marks of a model without tables."""


class NetworkPair(BaseTransitionModel):
    """A predictor network, alone or with a conditioner network.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A of a single step.
        config: see NeuralConfig.
        body: function that builds a predictor body to replace the dense one.
        n_steps: length of the string of actions that forms one action of this model (paper 4.2); see ``FactorCodec``.
        seed: seed of the initial weights; ``fit`` uses its own seed.
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
        """Creates new networks; returns the generator from which their weights were drawn."""
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
        self._pruned, self._marks = False, NO_MARKS
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
        """Called whenever weights have changed."""

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        arrays: dict[str, NDArray[Any]] = {
            f"{part}.{name}": tensor.detach().numpy().copy()
            for part, module in self._parts().items()
            for name, tensor in module.state_dict().items()
        }
        return {**arrays, PRUNED: self._marks} if self._pruned else arrays

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of this shape; the model is unchanged.
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
        self._online, self._pruned = None, PRUNED in state
        self._marks = np.array(state.get(PRUNED, NO_MARKS), dtype=np.int8)
        self._changed()

    def _misfit(self, state: Mapping[str, NDArray[Any]]) -> list[str]:
        """Names of missing, unknown or wrongly shaped arrays (the conditioner's may have a first axis of any length)."""
        own = self.state_dict()
        wrong = sorted((set(own) ^ set(state)) - {PRUNED})
        for name in set(own) - {PRUNED} if not wrong else ():
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

    @property
    def parents(self) -> NDArray[np.int8]:
        """Parents of each outcome bit and fixed values of other bits (``truth_tables.find_parents``); empty if not pruned."""
        return self._marks

    def connections(self) -> dict[str, Connections]:
        """The connections of each network."""
        return {part: Connections(module, self._pruned) for part, module in self._parts().items()}
