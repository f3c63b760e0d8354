"""Fitting predictor and conditioner to transitions (paper 3.1 and 3.2): batches, early stopping, and the on-line method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mbagent.data import TransitionBatch
from mbagent.models.neural.connections import Shrinking
from mbagent.models.neural.networks import Activation, Conditioner, Dropout, FactorCodec, Mask
from mbagent.types import Progress
from mbagent_envs.random_keys import hash_rows

Loss: TypeAlias = Literal["cross_entropy", "squared"]
RowLosses: TypeAlias = "Callable[[Examples, Loss], Tensor]"
"""(examples, kind of loss) -> loss of each row and factor [B, O]."""


@dataclass(frozen=True)
class TrainingConfig:
    """How networks are fitted.

    Attributes:
        learning_rate: AdamW's peak, a third into the one-cycle schedule.
        weight_decay: AdamW's.
        memory: AdamW's beta2, the decay rate of squared gradients; lower makes large learning rates safe.
        batch_size: rows per gradient step.
        epochs: passes over the distinct rows, subject to the bounds on steps.
        min_steps: minimum number of gradient steps.
        max_steps: maximum number of gradient steps.
        validation: share of episodes held out.
        checks: number of evaluations of the held-out loss; the weights with the lowest loss are kept.
        patience: stop after this many checks without a better held-out loss.
        loss: "cross_entropy", or "squared" as in the paper.
        negligible: a factor whose held-out cross-entropy under the predictor is below this many nats gets no group
            in the conditioner.
        online_learning_rate: Adam's, in the on-line method.
    """

    learning_rate: float = 0.02
    weight_decay: float = 0.01
    memory: float = 0.999
    batch_size: int = 256
    epochs: float = 30.0
    min_steps: int = 2000
    max_steps: int = 6000
    validation: float = 0.1
    checks: int = 40
    patience: int = 12
    loss: Loss = "cross_entropy"
    negligible: float = 1e-3
    online_learning_rate: float = 3e-3


@dataclass(frozen=True)
class NeuralConfig:
    """Architecture and use of the networks.

    Attributes:
        hidden: sizes of the dense predictor's hidden layers.
        activation: of all hidden nodes.
        residual: whether the predictor has a learned path from s_i to s'_i.
        conditioner: "causal" (ancestral sampling, exact probabilities), "others" (the paper's sweeps), or None (factors
            independent given state and action).
        group_size: hidden nodes in each of the conditioner's groups.
        correction: whether the conditioner's output is added to the predictor's logits.
        certain: a factor whose most likely value has at least this predicted probability is sampled from the predictor; sweeps
            evaluate the conditioner for it only if the random number is extreme (``gibbs.LEEWAY``).
        dropout: share of hidden nodes zeroed in each training step; without it, networks fit the noise of rare
            states. None: 0.4, or 0 for single-factor states, which share no features: the network is then in effect a table, and
            dropout only adds noise.
        sweeps: passes over all factors, with mask "others".
        real_guess: whether sweeps start from the predictor's probabilities rather than from bits drawn from them.
        training: see TrainingConfig.
    """

    hidden: tuple[int, ...] = (128,)
    activation: Activation = "silu"
    residual: bool = True
    conditioner: Mask | None = "causal"
    group_size: int = 16
    correction: bool = True
    certain: float = 0.999
    dropout: float | None = None
    sweeps: int = 5
    real_guess: bool = False
    training: TrainingConfig = field(default_factory=TrainingConfig)

    def dropout_for(self, n_factors: int) -> float:
        """The dropout rate for states of ``n_factors`` factors."""
        if self.dropout is not None:
            return self.dropout
        return 0.4 if n_factors > 1 else 0.0

    @classmethod
    def paper(cls, n_variables: int) -> NeuralConfig:
        """The networks of section 3, for d = ``n_variables``: 2d + 1 and 2d^2 hidden nodes, sigmoids, squared error."""
        return cls(
            hidden=(2 * n_variables + 1,),
            activation="sigmoid",
            residual=False,
            conditioner="others",
            group_size=2 * n_variables,
            correction=False,
            certain=1.0,
            dropout=0.0,
            training=TrainingConfig(learning_rate=0.03, weight_decay=0.0, loss="squared"),
        )


@dataclass(frozen=True)
class Examples:
    """Distinct transitions as tensors.

    Attributes:
        states: int64 [N, F].
        actions: int64 [N].
        outcomes: int64 [N, O], next factors and ``terminated``.
        weights: float [N], counts of each transition, scaled to a mean of one.
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

    def spread(self, most: int) -> Examples:
        """At most ``most`` rows, evenly spaced, since rows are sorted, so neighbours are similar."""
        return self.select(torch.linspace(0, len(self) - 1, min(len(self), most)).long()) if len(self) else self


def examples(rows: TransitionBatch) -> Examples:
    """Distinct transitions with counts: the paper's P(Y | X) as target, without repeated rows."""
    return as_examples(rows.states, rows.actions, rows.next_states, rows.terminated, merge=True)


def as_examples(
    states: NDArray[np.int64],
    actions: NDArray[np.int64],
    next_states: NDArray[np.int64],
    terminated: NDArray[np.bool_],
    merge: bool = False,
) -> Examples:
    """Transitions as tensors; ``merge`` merges equal ones if that shortens the table."""
    outcomes = np.concatenate([next_states, terminated[:, None].astype(np.int64)], axis=1)
    weights = np.ones(len(actions), dtype=np.float32)
    if merge:
        tags = hash_rows(np.concatenate([states, actions[:, None], outcomes], axis=1))
        _, first, counts = np.unique(tags, return_index=True, return_counts=True)
        order = np.argsort(first)  # in the order of observation, not of the hashes
        first, counts = first[order], counts[order]
        if len(first) < 0.8 * len(actions):
            states, actions, outcomes = states[first], actions[first], outcomes[first]
            weights = (counts / counts.mean()).astype(np.float32)
    return Examples(*(torch.from_numpy(np.ascontiguousarray(part)) for part in (states, actions, outcomes, weights)))


def losses(codec: FactorCodec, logits: Tensor, outcomes: Tensor, loss: Loss) -> Tensor:
    """Loss of each row and factor [B, O] of logits [B, O, K] on outcomes int64 [B, O].

    Cross-entropy is in nats; squared error is summed over values.
    """
    if loss == "squared":
        wanted = functional.one_hot(outcomes, codec.width)
        return ((torch.softmax(logits, dim=2) - wanted) ** 2).sum(dim=2)
    if codec.all_binary:
        margin = logits[:, :, 1] - logits[:, :, 0]
        return functional.binary_cross_entropy_with_logits(margin, outcomes.to(margin.dtype), reduction="none")
    flat = functional.cross_entropy(logits.flatten(0, 1), outcomes.flatten(), reduction="none")
    return flat.view(outcomes.shape)


class Trainer:
    """Fits a predictor, then a conditioner, to examples; or updates both on-line, by one gradient step per call.

    The conditioner's loss has no gradient with respect to the predictor, which can therefore be fitted first; the conditioner
    then corrects a fixed predictor.

    Args:
        codec: the factors.
        predictor: a ``networks.Predictor``.
        conditioner: None, or the conditioner.
        config: see TrainingConfig.
    """

    def __init__(
        self,
        codec: FactorCodec,
        predictor: nn.Module,
        conditioner: Conditioner | None,
        config: TrainingConfig,
    ) -> None:
        self.codec = codec
        self.predictor = predictor
        self.conditioner = conditioner
        self.config = config

    def predictor_losses(self, batch: Examples, loss: Loss) -> Tensor:
        """The predictor's loss [B, O]."""
        return losses(self.codec, self.predictor(batch.states, batch.actions), batch.outcomes, loss)

    def conditioner_losses(self, batch: Examples, loss: Loss) -> Tensor:
        """The conditioner's loss [B, O], given the true other variables."""
        assert self.conditioner is not None
        logits = self.conditioner(batch.states, batch.actions, batch.outcomes)
        if self.conditioner.correction:
            with torch.no_grad():
                base = self.predictor(batch.states, batch.actions)
            logits = logits + base
        return losses(self.codec, logits, batch.outcomes, loss)

    def fit(
        self,
        train: Examples,
        held_out: Examples,
        generator: torch.Generator,
        progress: Progress | None,
        shrinking: Shrinking | None = None,
    ) -> float:
        """Fits the predictor and keeps its best weights; returns the epochs. ``shrinking`` prunes it during training."""
        return self._run(self.predictor, self.predictor_losses, train, held_out, generator, progress, shrinking)

    def fit_conditioner(
        self,
        train: Examples,
        held_out: Examples,
        generator: torch.Generator,
        progress: Progress | None,
        shrinking: Shrinking | None = None,
    ) -> float:
        """Fits the conditioner, if any factor needs it, and keeps its best weights; returns the epochs."""
        if self.conditioner is None or len(self.conditioner.members) == 0:
            return 0.0
        return self._run(self.conditioner, self.conditioner_losses, train, held_out, generator, progress, shrinking)

    def observe(self, optimizer: torch.optim.Optimizer, batch: Examples) -> None:
        """One gradient step of both networks."""
        total = self.predictor_losses(batch, self.config.loss).sum(dim=1)
        if self.conditioner is not None:
            total = total + self.conditioner_losses(batch, self.config.loss).sum(dim=1)
        _descend(optimizer, total.mean())

    def open_factors(self, rows: Examples) -> Tensor:
        """Factors of which the predictor is uncertain, bool [O]; all False if there are fewer than two."""
        nats = self._mean(self.predictor_losses, rows)
        still_open = nats > self.config.negligible
        return still_open if int(still_open.sum()) > 1 else torch.zeros_like(still_open)

    def evaluate(self, rows: Examples) -> tuple[float, float | None]:
        """Mean cross-entropy, in nats per transition, of predictor and conditioner (given the true other variables)."""
        first = float(self._mean(self.predictor_losses, rows).sum())
        if self.conditioner is None:
            return first, None
        return first, float(self._mean(self.conditioner_losses, rows).sum())

    @torch.no_grad()
    def _mean(self, row_losses: RowLosses, rows: Examples) -> Tensor:
        """Weighted mean cross-entropy of each factor, float64 [O]."""
        total, weight = torch.zeros(len(self.codec.outputs), dtype=torch.float64), 1e-12
        for part in torch.split(torch.arange(len(rows)), 4096):
            batch = rows.select(part)
            total += (row_losses(batch, "cross_entropy") * batch.weights[:, None]).sum(dim=0)
            weight += float(batch.weights.sum())
        return total / weight

    def _run(
        self,
        module: nn.Module,
        row_losses: RowLosses,
        train: Examples,
        held_out: Examples,
        generator: torch.Generator,
        progress: Progress | None,
        shrinking: Shrinking | None,
    ) -> float:
        """AdamW on a one-cycle schedule with early stopping on the held-out loss."""
        config = self.config
        per_epoch = max(1, math.ceil(len(train) / config.batch_size))
        n_steps = int(min(max(config.epochs * per_epoch, config.min_steps), config.max_steps)) if len(train) else 0
        every = max(1, n_steps // config.checks)
        optimizer = self._adamw(module)
        best, best_weights, waited, done = math.inf, _weights(module), 0, 0
        for batch in batches(train, config.batch_size, n_steps, generator):
            _set_rate(optimizer, config.learning_rate * one_cycle(done / n_steps))
            with noise(module, generator if shrinking is None else None):  # no dropout when few paths remain
                total = row_losses(batch, config.loss).sum(dim=1)
            loss = (total * batch.weights).mean()
            _descend(optimizer, loss if shrinking is None else loss + shrinking.penalty())
            done += 1
            if shrinking is not None:
                shrinking.after_step(done / n_steps)
            if (done % every and done < n_steps) or (shrinking is not None and not shrinking.finished):
                continue
            score = float(self._mean(row_losses, held_out).sum())
            waited += 1
            if score < best:
                best, best_weights, waited = score, _weights(module), 0
            if progress is not None:
                progress(done / n_steps)
            if waited >= config.patience:
                break
        module.load_state_dict(best_weights)
        return done / per_epoch

    def _adamw(self, module: nn.Module) -> torch.optim.AdamW:
        decayed = {
            "params": [p for p in module.parameters() if p.ndim > 1],
            "weight_decay": self.config.weight_decay,
        }
        free = {"params": [p for p in module.parameters() if p.ndim <= 1], "weight_decay": 0.0}
        return torch.optim.AdamW([decayed, free], lr=self.config.learning_rate, betas=(0.9, self.config.memory), fused=True)


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


def _set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate


def _weights(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Limits torch to one thread: small networks gain nothing from more, and the order of sums is then reproducible."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def noise(module: nn.Module, generator: torch.Generator | None) -> Iterator[None]:
    """Activates the module's dropout within the block, if there is a generator."""
    layers = [layer for layer in module.modules() if isinstance(layer, Dropout)]
    for layer in layers:
        layer.generator = generator
    try:
        yield
    finally:
        for layer in layers:
            layer.generator = None


def batches(rows: Examples, size: int, n_steps: int, generator: torch.Generator) -> Iterator[Examples]:
    """``n_steps`` batches, reshuffled at each pass over the rows."""
    done = 0
    while done < n_steps:
        for part in torch.split(torch.randperm(len(rows), generator=generator), size):
            if done == n_steps:
                return
            yield rows.select(part)
            done += 1


def one_cycle(t: float, peak: float = 0.3, start: float = 0.04) -> float:
    """Learning rate relative to its peak, at share ``t`` of training: cosine from ``start`` to 1 at ``peak``, then to 1e-4.

    Smith and Topin 2017, "Super-convergence".
    """
    if t < peak:
        return start + (1.0 - start) * 0.5 * (1.0 - math.cos(math.pi * t / peak))
    return 0.5 * (1.0 + math.cos(math.pi * (t - peak) / (1.0 - peak))) + 1e-4
