"""Pruning of predictor and conditioner: by magnitude with retraining (paper section 5), then by the extended BIC.

Some of the weights that remain after pruning by magnitude only fit noise: a fair coin keeps dozens of weak parents. A connection
is kept only if its removal increases the loss on the observed transitions, in nats, by more than half the logarithm of their
number (Schwarz 1978, "Estimating the dimension of a model") plus the logarithm of the number of candidate inputs, since the best
of many gains is large by chance (Chen and Chen 2008, "Extended Bayesian information criteria for model selection with large model
spaces"). Each connection is tested with the rest of the network fixed; its mean contribution is added to the bias.
Shapes: N rows, C output columns of a network, H hidden nodes, I inputs, F factors of the columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.neural.connections import Connections, PruningConfig, Shrinking
from mbagent.models.neural.networks import ACTIVATIONS, Affine, Conditioner, DensePredictor, FactorCodec
from mbagent.models.neural.training import Examples, Trainer
from mbagent.types import Progress

PRUNING_ROWS = 20_000
"""Largest number of transitions on which losses are computed; the losses are scaled up to all transitions."""


class Judge:
    """Decides whether changes to a network's output on transitions are acceptable.

    Args:
        rows: the transitions.
        factor: factor of each column, int64 [C]; a bit has one column, the logit of value 1.
        logits: logits of the columns, [N, C]; updated by accepted changes.
        n_transitions: number of transitions that the rows represent.
        n_candidates: number of inputs among which each connection was chosen; with ``n_transitions``, it determines the
            penalty per connection.
    """

    def __init__(self, rows: Examples, factor: Tensor, logits: Tensor, n_transitions: int, n_candidates: int) -> None:
        self.outcomes, self.factor, self.logits = rows.outcomes, factor, logits
        self.weights = rows.weights / rows.weights.sum()
        self.columns = {f: torch.nonzero(factor == f)[:, 0].tolist() for f in set(factor.tolist())}
        self.now = {f: self._nats(f, logits[:, self.columns[f]]) for f in self.columns}
        self.price = (0.5 * math.log(max(n_transitions, 2)) + math.log(max(n_candidates, 1))) / max(n_transitions, 1)

    def _nats(self, factor: int, logits: Tensor) -> float:
        """Mean loss of a factor whose columns have the ``logits`` [N, its columns]."""
        outcome = self.outcomes[:, factor]
        if logits.shape[1] == 1:
            losses = functional.softplus(logits[:, 0]) - logits[:, 0] * outcome
        else:
            losses = functional.cross_entropy(logits, outcome, reduction="none")
        return float(torch.dot(losses, self.weights))

    def mean(self, values: Tensor) -> Tensor:
        """The weighted mean over rows of ``values`` [N, ...]."""
        mean: Tensor = torch.tensordot(self.weights, values, dims=1)
        return mean

    def spread(self, values: Tensor) -> Tensor:
        """The weighted standard deviation over rows of each column of ``values`` [N, M]."""
        return self.mean((values - self.mean(values)) ** 2).sqrt()

    def accepts(self, columns: Tensor, change: Tensor, connections: int = 1) -> bool:
        """Whether adding ``change`` [N, c] to the columns increases the loss by less than the penalty; if so, it is applied."""
        proposed, found, cost, price = self.logits[:, columns] + change, {}, 0.0, connections * self.price
        place = {int(c): k for k, c in enumerate(columns)}
        for factor in {int(f) for f in self.factor[columns]}:
            mine = [proposed[:, place[c]] if c in place else self.logits[:, c] for c in self.columns[factor]]
            found[factor] = self._nats(factor, torch.stack(mine, dim=1))
            cost += found[factor] - self.now[factor]
        if cost >= price:
            return False
        self.logits[:, columns] = proposed
        self.now |= found
        return True


@dataclass
class Layers:
    """A hidden layer and its output columns, modified in place.

    Attributes:
        inputs: [N, I].
        first, bias: weights of the hidden layer, [H, I] and [H].
        last, last_bias: weights of the columns, [C, H] and [C].
        activation: activation of the hidden layer.
        columns: indices of the C columns among those of the Judge.
    """

    inputs: Tensor
    first: Tensor
    bias: Tensor
    last: Tensor
    last_bias: Tensor
    activation: Callable[[Tensor], Tensor]
    columns: Tensor

    def trim(self, judge: Judge) -> bool:
        """Removes unsupported connections and those without a path to an output; returns whether any were removed."""
        before = self._left()
        hidden = self.activation(self.inputs @ self.first.T + self.bias)
        trim_layer(hidden, self.last, self.last_bias, self.columns, judge)
        means, spread = judge.mean(self.inputs), judge.spread(self.inputs)
        for h in range(len(self.first)):
            if (self.last[:, h] != 0.0).any():
                self._trim_node(h, means, spread, judge)
            else:
                self.first[h] = 0.0
        return self._left() < before

    def trim_past(self, i: int, paths: Tensor, weight: Tensor, judge: Judge) -> bool:
        """Removes all paths from input i to column i at once, direct ones and those through nodes, which may cancel each other.

        Args:
            i: index of the input and of the column.
            paths: values of the A direct connections, [N, A].
            weight: their weights, [1, A].
            judge: decides on the change.
        """
        nodes = torch.nonzero((self.first[:, i] != 0.0) & (self.last[i] != 0.0))[:, 0]
        count = len(nodes) + int((weight != 0.0).sum())
        if count == 0:
            return False
        centred = self.inputs[:, i] - judge.mean(self.inputs[:, i])
        sums = self.inputs @ self.first[nodes].T + self.bias[nodes]
        change = self.activation(sums - centred[:, None] * self.first[nodes, i]) - self.activation(sums)
        change = change @ self.last[:, nodes].T
        past = paths @ weight[0]
        change[:, i] += judge.mean(past) - past
        moved = torch.nonzero((self.last[:, nodes] != 0.0).any(dim=1) | (torch.arange(len(self.last)) == i))[:, 0]
        if not judge.accepts(self.columns[moved], change[:, moved], count):
            return False
        self.bias[nodes] += self.first[nodes, i] * judge.mean(self.inputs[:, i])
        self.last_bias[i] += judge.mean(past)
        self.first[nodes, i] = 0.0
        weight.zero_()
        return True

    def _left(self) -> int:
        return int((self.first != 0.0).sum() + (self.last != 0.0).sum())

    def _trim_node(self, h: int, means: Tensor, spread: Tensor, judge: Judge) -> None:
        """Tests the connections into a hidden node, the weakest first."""
        to = torch.nonzero(self.last[:, h])[:, 0]
        sums = self.inputs @ self.first[h] + self.bias[h]
        given = self.activation(sums)
        for j in _weakest_first(self.first[h], spread):
            weight = float(self.first[h, j])
            without = sums - weight * (self.inputs[:, j] - means[j])
            proposed = self.activation(without)
            if judge.accepts(self.columns[to], (proposed - given)[:, None] * self.last[to, h]):
                self.bias[h] += weight * means[j]
                self.first[h, j] = 0.0
                sums, given = without, proposed


def trim_layer(inputs: Tensor, weight: Tensor, bias: Tensor, columns: Tensor, judge: Judge) -> None:
    """Tests direct connections [C, I] from ``inputs`` [N, I] to columns, weakest first; modifies ``weight`` and ``bias`` [C]."""
    means, spread = judge.mean(inputs), judge.spread(inputs)
    centred = inputs - means
    for row in range(len(columns)):
        for j in _weakest_first(weight[row], spread):
            if judge.accepts(columns[row : row + 1], -weight[row, j] * centred[:, j, None]):
                bias[row] += weight[row, j] * means[j]
                weight[row, j] = 0.0


def _weakest_first(weights: Tensor, spread: Tensor) -> list[int]:
    """Indices of the non-zero weights, by the standard deviation of their contribution."""
    places: list[int] = torch.nonzero(weights)[:, 0].tolist()
    sizes = (weights.abs() * spread).tolist()
    return sorted(places, key=sizes.__getitem__)


@torch.no_grad()
def trim_predictor(predictor: DensePredictor, rows: Examples, n_transitions: int) -> None:
    """Removes unsupported connections: residual paths, and those into and out of the last hidden layer.

    Args:
        predictor: the predictor, modified in place.
        rows: distinct transitions.
        n_transitions: number of transitions that they represent.
    """
    rows, codec, out = rows.spread(PRUNING_ROWS), predictor.codec, predictor.out
    inputs = values = codec.inputs(rows.states, rows.actions)
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    activation = ACTIVATIONS[predictor.activation]
    for layer in layers[:-1]:
        values = activation(layer(values))
    logits = _columns(codec, predictor(rows.states, rows.actions))
    judge = Judge(rows, codec.column_factor, logits, n_transitions, codec.n_inputs)
    everything = torch.arange(codec.n_columns)
    last = None
    if layers:
        last = Layers(values, layers[-1].weight, layers[-1].bias, out.weight, out.bias, activation, everything)
    if predictor.stay is not None:
        signed, acts = 2.0 * inputs - 1.0, inputs[:, codec.n_state_columns :]
        for i in range(codec.n_state_columns):
            here, paths = slice(i, i + 1), acts * signed[:, i : i + 1]
            stay = predictor.stay[:, here].T
            if last is None or len(layers) > 1 or not last.trim_past(i, paths, stay, judge):
                trim_layer(paths, stay, out.bias[here], everything[here], judge)
    if last is None:
        trim_layer(values, out.weight, out.bias, everything, judge)
    while last is not None and last.trim(judge):
        pass
    for above, layer in zip(layers[:0:-1], layers[-2::-1], strict=True):
        layer.weight[(above.weight == 0.0).all(dim=0)] = 0.0  # nodes without a path to an output


@torch.no_grad()
def trim_conditioner(conditioner: Conditioner, predictor: nn.Module, rows: Examples, n_transitions: int) -> None:
    """As ``trim_predictor``, for each group of a conditioner, given the predictor's output."""
    rows, codec, size = rows.spread(PRUNING_ROWS), conditioner.codec, conditioner.group_size
    columns = torch.cat((codec.inputs(rows.states, rows.actions), codec.targets(rows.outcomes)), dim=1)
    logits = conditioner(rows.states, rows.actions, rows.outcomes)
    if conditioner.correction:
        logits = logits + predictor(rows.states, rows.actions)
    groups, activation = conditioner.groups, ACTIVATIONS[conditioner.activation]
    if groups.mask is not None:
        groups.weight.mul_(groups.mask)
    for g, factor in enumerate(conditioner.members.tolist()):
        of_group = slice(g * size, (g + 1) * size)
        values = slice(1, 2) if codec.all_binary else slice(0, codec.outputs[factor])
        n = values.stop - values.start
        judge = Judge(rows, torch.full((n,), factor), logits[:, factor, values].clone(), n_transitions, columns.shape[1])
        readout, offset = conditioner.readout[g, :, :n].T, conditioner.offset[g, 0, :n]
        layers = Layers(columns, groups.weight[of_group], groups.bias[of_group], readout, offset, activation, torch.arange(n))
        while layers.trim(judge):
            pass


def _columns(codec: FactorCodec, logits: Tensor) -> Tensor:
    """Columns [N, C] of logits [N, O, K]; the inverse of ``codec.logits``."""
    return logits.flatten(1)[:, codec.slots].clone()


BATCHES = 0x9F
"""Added to the seed, so that the batches differ from those of the fit."""

PRUNING_ROUNDS = 3
"""Number of rounds of removal by the extended BIC; retraining after each round makes further removals possible."""

SETTLE, RATE = 600, 0.25
"""Training steps after each round, and their share of the learning rate."""


def prune_networks(
    trainer: Trainer,
    connections: Mapping[str, Connections],
    fraction: float,
    train: Examples,
    held_out: Examples,
    n_transitions: int,
    seed: int,
    progress: Progress | None,
    config: PruningConfig | None,
) -> float:
    """Prunes the predictor, then the conditioner, which corrects the pruned predictor; returns the number of epochs.

    Args:
        trainer: trainer of the networks.
        connections: connections of "predictor" and, if there is one, "conditioner".
        fraction: smallest share of each network's connections to be removed.
        train: training examples.
        held_out: examples for the selection of the best weights.
        n_transitions: number of transitions that the training examples represent.
        seed: seed of the batches.
        progress: called with the completed share.
        config: see PruningConfig.
    """
    config, generator = config or PruningConfig(), torch.Generator().manual_seed(seed + BATCHES)
    both = "conditioner" in connections and connections["conditioner"].total > 0
    predictor, conditioner = trainer.predictor, trainer.conditioner
    half = progress if progress is None or trainer.conditioner is None else lambda share: progress(0.5 * share)
    epochs = trainer.fit(train, held_out, generator, half, Shrinking(connections["predictor"], fraction, config))
    if isinstance(predictor, DensePredictor):
        for _ in range(PRUNING_ROUNDS * config.evidence):
            trim_predictor(predictor, train, n_transitions)
            epochs += _settle(trainer).fit(train, held_out, generator, None, _keep_removed(predictor))
    if not both or conditioner is None:
        return epochs
    half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
    shrinking = Shrinking(connections["conditioner"], fraction, config)
    epochs += trainer.fit_conditioner(train, held_out, generator, half, shrinking)
    for _ in range(PRUNING_ROUNDS * config.evidence):
        trim_conditioner(conditioner, predictor, train, n_transitions)
        epochs += _settle(trainer).fit_conditioner(train, held_out, generator, None, _keep_removed(conditioner))
    return epochs


def _settle(trainer: Trainer) -> Trainer:
    """A trainer of the same networks with few steps and a low learning rate."""
    config = trainer.config
    short = replace(config, min_steps=SETTLE, max_steps=SETTLE, learning_rate=RATE * config.learning_rate)
    return Trainer(trainer.codec, trainer.predictor, trainer.conditioner, short)


def _keep_removed(module: nn.Module) -> Shrinking:
    """A Shrinking that removes no more connections, but keeps removed ones at 0."""
    return Shrinking(Connections(module, zeros_gone=True), 0.0, PruningConfig(gradual=False))
