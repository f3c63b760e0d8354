"""Pruning by magnitude (paper section 5): the smallest weights are removed gradually, while the others are trained.

The paper prunes once and retrains; gradual removal, the default here, loses less accuracy (the schedule is that of Zhu and Gupta
2017, "To prune, or not to prune"). A removed weight is exactly 0 and remains 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from mbagent.data import TransitionDataset
from mbagent.models.fit_report import FitReport
from mbagent.models.protocol import TransitionModel


def check_fraction(fraction: float) -> float:
    """The fraction as a float.

    Raises:
        ValueError: it is not a number in [0, 1).
    """
    if isinstance(fraction, bool) or not isinstance(fraction, int | float) or not 0.0 <= fraction < 1.0:
        raise ValueError(
            f"fraction is the share of connections to remove, a number from 0 up to but not including 1, got {fraction!r}."
        )
    return float(fraction)


@dataclass(frozen=True)
class PruningConfig:
    """How a network is pruned.

    Attributes:
        gradual: whether connections are removed gradually during training; False: all at once before training (the paper).
        removal: share of the training, from its start, during which connections are removed.
        steps: number of rounds of removal in that time.
        shrink: weight of the L1 penalty that is added to the loss during that time, to make useless weights small.
        evidence: whether to remove, in addition to the given share, all other connections that the transitions do not support
            (see ``pruning``); False: only the smallest ones are removed. Weights shared over positions are not tested for
            support.
    """

    gradual: bool = True
    removal: float = 0.6
    steps: int = 50
    shrink: float = 1e-3
    evidence: bool = True


class Connections:
    """The weights of a network that are connections, and which of them remain.

    Args:
        module: the network; its biases, and weights that its own masks disable, are not connections.
        zeros_gone: whether weights that are exactly 0 count as removed connections.
    """

    def __init__(self, module: nn.Module, zeros_gone: bool = False) -> None:
        self.weights = {name: p for name, p in module.named_parameters() if not name.endswith(("bias", "offset"))}
        self.possible = {name: _possible(module, name, p) for name, p in self.weights.items()}
        self.kept = dict(self.possible)
        if zeros_gone:
            self.kept = {name: self.possible[name] & (p.detach() != 0.0) for name, p in self.weights.items()}
        self.total = sum(int(mask.sum()) for mask in self.possible.values())

    @property
    def left(self) -> int:
        """Number of remaining connections."""
        return sum(int(mask.sum()) for mask in self.kept.values())

    @torch.no_grad()
    def drop(self, fraction: float) -> None:
        """Removes connections of least absolute weight until ``fraction`` of all are removed, counting earlier removals."""
        stay = self.total - round(fraction * self.total)
        sizes = torch.cat([p.abs()[self.kept[name]] for name, p in self.weights.items()])
        if len(sizes) <= stay or stay < 1:
            return
        limit = torch.kthvalue(sizes, len(sizes) - stay).values
        self.kept = {name: self.kept[name] & (p.abs() > limit) for name, p in self.weights.items()}
        self.apply()

    @torch.no_grad()
    def apply(self) -> None:
        """Sets the weights of all removed connections to 0."""
        for name, p in self.weights.items():
            p.mul_(self.kept[name])


class Shrinking:
    """Removal of a network's connections during training by ``Trainer``.

    Args:
        connections: connections of the network.
        fraction: the share of connections to be removed by the end.
        config: see PruningConfig.
    """

    def __init__(self, connections: Connections, fraction: float, config: PruningConfig) -> None:
        self.connections, self.config = connections, config
        self._removed_before = 1.0 - connections.left / max(connections.total, 1)
        self.fraction = max(fraction, self._removed_before)  # removed connections remain removed
        self._done = 0
        if not config.gradual:
            connections.drop(fraction)

    @property
    def finished(self) -> bool:
        """Whether the requested share has been removed."""
        return not self.config.gradual or self._done >= self.config.steps

    def penalty(self) -> Tensor | float:
        """The penalty added to the loss."""
        if self.finished or self.config.shrink == 0.0:
            return 0.0
        return self.config.shrink * torch.stack([p.abs().sum() for p in self.connections.weights.values()]).sum()

    def after_step(self, share: float) -> None:
        """Prunes after a gradient step; ``share`` is the share of the training that is completed."""
        due = math.floor(self.config.steps * min(share / self.config.removal, 1.0))
        if self.config.gradual and due > self._done:
            self._done = due
            left = (1.0 - due / self.config.steps) ** 3
            self.connections.drop(self.fraction + (self._removed_before - self.fraction) * left)
        self.connections.apply()


def _possible(module: nn.Module, name: str, weight: nn.Parameter) -> Tensor:
    """Mask of the weights that their own layer's mask enables, bool."""
    owner = module.get_submodule(name.rpartition(".")[0])
    mask = getattr(owner, "mask", None)
    return torch.ones_like(weight, dtype=torch.bool) if mask is None else mask.clone()


@runtime_checkable
class PrunableModel(Protocol):
    """A transition model with connections that can be removed; see ``NeuralTransitionModel.prune``."""

    def prune(
        self,
        data: TransitionDataset,
        fraction: float,
        *,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        config: PruningConfig | None = None,
    ) -> FitReport:
        """Removes connections and trains the remaining ones; if that fails, the model is unchanged."""
        ...


def prunable(model: TransitionModel, fitted: bool, n_transitions: int) -> PrunableModel:
    """The model, if it can be pruned now.

    Args:
        model: any transition model.
        fitted: whether ``model`` is fitted.
        n_transitions: number of transitions available for training the remaining connections.

    Raises:
        TypeError: the model has no connections to prune; the message suggests a solution.
        ValueError: nothing is learned yet, or there are no transitions.
    """
    if not isinstance(model, PrunableModel):
        raise TypeError(
            f"This agent's model, {type(model).__name__}, has no connections to prune: decision graphs and tables contain only "
            "dependencies that the data support. Learn with model='networks' or model='paper' to prune networks."
        )
    if not fitted:
        raise ValueError("There is nothing to prune yet: call learn() first.")
    if not n_transitions:
        raise ValueError(
            "prune() trains the remaining connections on observed transitions, and this agent has none: give it some with "
            "load_transitions(path), or save agents with include=['transitions']."
        )
    return model
