"""Fitting predictor and conditioner to transitions (paper 3.1 and 3.2): batches, early stopping, and the on-line method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.base import hash_rows
from mbagent.models.networks import Conditioner, FactorCodec
from mbagent.transitions import TransitionBatch

Loss: TypeAlias = Literal["cross_entropy", "squared"]


@dataclass(frozen=True)
class TrainingConfig:
    """How networks are fitted.

    Attributes:
        learning_rate: AdamW's largest, at a third of the one-cycle schedule.
        weight_decay: AdamW's.
        batch_size: rows of a gradient step.
        epochs: passes over the distinct rows, within the bounds on steps.
        min_steps: fewest gradient steps.
        max_steps: most gradient steps.
        validation: share of episodes held out.
        checks: how often the held-out loss is looked at; the best weights seen are kept.
        patience: stop after this many checks without a better held-out loss.
        loss: "cross_entropy", or "squared" as in the paper.
        online_learning_rate: Adam's, in the on-line method.
    """

    learning_rate: float = 0.01
    weight_decay: float = 1e-3
    batch_size: int = 256
    epochs: float = 30.0
    min_steps: int = 2000
    max_steps: int = 6000
    validation: float = 0.1
    checks: int = 40
    patience: int = 12
    loss: Loss = "cross_entropy"
    online_learning_rate: float = 3e-3


@dataclass(frozen=True)
class Examples:
    """Distinct transitions as tensors.

    Attributes:
        states: int64 [N, F].
        actions: int64 [N].
        outcomes: int64 [N, O], next factors and ``terminated``.
        weights: float [N], how often each was met, scaled to a mean of one.
    """

    states: Tensor
    actions: Tensor
    outcomes: Tensor
    weights: Tensor

    def __len__(self) -> int:
        """Number of distinct transitions N."""
        return len(self.actions)

    def select(self, rows: Tensor) -> Examples:
        """The rows with the given indices."""
        return Examples(self.states[rows], self.actions[rows], self.outcomes[rows], self.weights[rows])


def examples(rows: TransitionBatch) -> Examples:
    """Distinct transitions with counts: the paper's P(Y | X) as target, without doing equal rows again and again."""
    return as_examples(rows.states, rows.actions, rows.next_states, rows.terminated, merge=True)


def as_examples(
    states: NDArray[np.int64],
    actions: NDArray[np.int64],
    next_states: NDArray[np.int64],
    terminated: NDArray[np.bool_],
    merge: bool = False,
) -> Examples:
    """Transitions as tensors; ``merge`` joins equal ones where that shortens the table."""
    outcomes = np.concatenate([next_states, terminated[:, None].astype(np.int64)], axis=1)
    weights = np.ones(len(actions), dtype=np.float32)
    if merge:
        tags = hash_rows(np.concatenate([states, actions[:, None], outcomes], axis=1))
        _, first, counts = np.unique(tags, return_index=True, return_counts=True)
        order = np.argsort(first)  # the order met, not that of the hashes
        first, counts = first[order], counts[order]
        if len(first) < 0.8 * len(actions):
            states, actions, outcomes = states[first], actions[first], outcomes[first]
            weights = (counts / counts.mean()).astype(np.float32)
    return Examples(*(torch.from_numpy(np.ascontiguousarray(part)) for part in (states, actions, outcomes, weights)))


def losses(codec: FactorCodec, logits: Tensor, outcomes: Tensor, loss: Loss) -> Tensor:
    """Loss of each row [B], summed over factors, of logits [B, O, K] on outcomes int64 [B, O].

    Cross-entropy is in nats; squared error is summed over values.
    """
    if loss == "squared":
        wanted = functional.one_hot(outcomes, codec.width)
        return ((torch.softmax(logits, dim=2) - wanted) ** 2).sum(dim=(1, 2))
    if codec.all_binary:
        margin = logits[:, :, 1] - logits[:, :, 0]
        return functional.binary_cross_entropy_with_logits(margin, outcomes.to(margin.dtype), reduction="none").sum(1)
    flat = functional.cross_entropy(logits.flatten(0, 1), outcomes.flatten(), reduction="none")
    return flat.view(outcomes.shape).sum(dim=1)


class Trainer:
    """Gradient steps on a predictor and, at the same time, its conditioner.

    The two losses are added; the conditioner gets the predictor's logits detached, so neither disturbs the other.

    Args:
        codec: the factors.
        predictor: any predictor body.
        conditioner: None, or the conditioner.
        config: see TrainingConfig.
    """

    def __init__(
        self, codec: FactorCodec, predictor: nn.Module, conditioner: Conditioner | None, config: TrainingConfig
    ) -> None:
        self.codec = codec
        self.predictor = predictor
        self.conditioner = conditioner
        self.config = config
        self.modules = [m for m in (predictor, conditioner) if m is not None]

    def row_losses(self, batch: Examples, loss: Loss) -> tuple[Tensor, Tensor | None]:
        """Loss of the predictor and of the conditioner, [B] each."""
        logits = self.predictor(batch.states, batch.actions)
        first = losses(self.codec, logits, batch.outcomes, loss)
        if self.conditioner is None:
            return first, None
        given = self.conditioner(batch.states, batch.actions, batch.outcomes)
        if self.conditioner.correction:
            given = given + logits.detach()
        return first, losses(self.codec, given, batch.outcomes, loss)

    def step(self, optimizer: torch.optim.Optimizer, batch: Examples) -> None:
        """One gradient step."""
        first, second = self.row_losses(batch, self.config.loss)
        total = first if second is None else first + second
        optimizer.zero_grad(set_to_none=True)
        (total * batch.weights).mean().backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    @torch.no_grad()
    def evaluate(self, rows: Examples) -> tuple[float, float | None]:
        """Mean cross-entropy in nats a transition of the predictor and of the conditioner (given the true others)."""
        sums, weight = [0.0, 0.0], 0.0
        for part in torch.arange(len(rows)).split(4096):
            batch = rows.select(part)
            weight += float(batch.weights.sum())
            for which, values in enumerate(self.row_losses(batch, "cross_entropy")):
                sums[which] += float((values * batch.weights).sum()) if values is not None else 0.0
        weight = max(weight, 1e-12)
        return sums[0] / weight, sums[1] / weight if self.conditioner is not None else None

    def fit(
        self, train: Examples, held_out: Examples, generator: torch.Generator, progress: Callable[[float], None] | None
    ) -> float:
        """AdamW on a one-cycle schedule with early stopping; leaves the best weights in place; returns epochs done."""
        config = self.config
        per_epoch = math.ceil(len(train) / config.batch_size)
        n_steps = int(min(max(config.epochs * per_epoch, config.min_steps), config.max_steps))
        every = max(1, n_steps // config.checks)
        optimizer = self._adamw()
        best, best_weights, waited, done = math.inf, self._weights(), 0, 0
        for batch in batches(train, config.batch_size, n_steps, generator):
            self._set_rate(optimizer, config.learning_rate * one_cycle(done / n_steps))
            self.step(optimizer, batch)
            done += 1
            if done % every and done < n_steps:
                continue
            first, second = self.evaluate(held_out)
            score = first + (second or 0.0)
            waited += 1
            if score < best:
                best, best_weights, waited = score, self._weights(), 0
            if progress is not None:
                progress(done / n_steps)
            if waited >= config.patience:
                break
        for module, weights in zip(self.modules, best_weights, strict=True):
            module.load_state_dict(weights)
        return done / per_epoch

    def _adamw(self) -> torch.optim.AdamW:
        parameters = [p for module in self.modules for p in module.parameters()]
        decayed = {"params": [p for p in parameters if p.ndim > 1], "weight_decay": self.config.weight_decay}
        free = {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0}
        return torch.optim.AdamW([decayed, free], lr=self.config.learning_rate, fused=True)

    @staticmethod
    def _set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
        for group in optimizer.param_groups:
            group["lr"] = rate

    def _weights(self) -> list[dict[str, Tensor]]:
        return [{k: v.detach().clone() for k, v in module.state_dict().items()} for module in self.modules]


def batches(rows: Examples, size: int, n_steps: int, generator: torch.Generator) -> Iterator[Examples]:
    """``n_steps`` batches, reshuffled at each pass over the rows."""
    done = 0
    while done < n_steps:
        for part in torch.randperm(len(rows), generator=generator).split(size):
            if done == n_steps:
                return
            yield rows.select(part)
            done += 1


def one_cycle(t: float, peak: float = 0.3, start: float = 0.04) -> float:
    """Share of the largest learning rate at share ``t`` of training: a cosine up to ``peak``, then down to nothing.

    Smith and Topin 2017, "Super-convergence".
    """
    if t < peak:
        return start + (1.0 - start) * 0.5 * (1.0 - math.cos(math.pi * t / peak))
    return 0.5 * (1.0 + math.cos(math.pi * (t - peak) / (1.0 - peak))) + 1e-4
