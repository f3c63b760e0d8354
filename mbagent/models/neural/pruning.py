"""Pruning of predictor and conditioner: by size with retraining (paper section 5), then by evidence.

Among the weights that pruning by size leaves, some only fit noise: a variable that is a fair coin keeps dozens of weak causes. A
connection stays only if removing it costs more nats on the observed transitions than half the logarithm of their number (Schwarz
1978, "Estimating the dimension of a model") and the logarithm of the number of inputs it was chosen from, since the best of many
gains is large by chance (Chen and Chen 2008, "Extended Bayesian information criteria for model selection with large model
spaces"). Each is judged with the rest of the network as it is; its mean contribution goes to the bias.
Shapes: N rows, C output columns of a network, H hidden nodes, I inputs, F factors that the columns stand for.
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
"""Transitions that are looked at, at most; what they cost is scaled up to all of them."""


class Judge:
    """Knows what a network says about transitions, and whether it may say something else instead.

    Args:
        rows: the transitions.
        factor: that each column stands for, int64 [C]; a bit has one column, which is the logit of 1.
        logits: of the columns, [N, C]; kept up to date.
        n_transitions: that the rows stand for.
        n_candidates: inputs that each connection was chosen from; both set how much it has to be worth.
    """

    def __init__(self, rows: Examples, factor: Tensor, logits: Tensor, n_transitions: int, n_candidates: int) -> None:
        self.outcomes, self.factor, self.logits = rows.outcomes, factor, logits
        self.weights = rows.weights / rows.weights.sum()
        self.columns = {f: torch.nonzero(factor == f)[:, 0].tolist() for f in set(factor.tolist())}
        self.now = {f: self._nats(f, logits[:, self.columns[f]]) for f in self.columns}
        self.price = (0.5 * math.log(max(n_transitions, 2)) + math.log(max(n_candidates, 1))) / max(n_transitions, 1)

    def _nats(self, factor: int, logits: Tensor) -> float:
        """Mean loss on a factor whose columns are at ``logits`` [N, its columns]."""
        outcome = self.outcomes[:, factor]
        if logits.shape[1] == 1:
            lost = functional.softplus(logits[:, 0]) - logits[:, 0] * outcome
        else:
            lost = functional.cross_entropy(logits, outcome, reduction="none")
        return float(torch.dot(lost, self.weights))

    def mean(self, values: Tensor) -> Tensor:
        """The weighted mean over rows of ``values`` [N, ...]."""
        mean: Tensor = torch.tensordot(self.weights, values, dims=1)
        return mean

    def spread(self, values: Tensor) -> Tensor:
        """The standard deviation over rows of each column of ``values`` [N, M]."""
        return self.mean((values - self.mean(values)) ** 2).sqrt()

    def accepts(self, columns: Tensor, change: Tensor, connections: int = 1) -> bool:
        """Whether adding ``change`` [N, c] to the given columns costs less than the connections are worth; if so, it is done."""
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
    """A hidden layer and the columns that come out of it, changed in place.

    Attributes:
        inputs: [N, I].
        first, bias: of the hidden layer, [H, I] and [H].
        last, last_bias: of the columns, [C, H] and [C].
        activation: of the hidden layer.
        columns: places of its C columns among the judge's.
    """

    inputs: Tensor
    first: Tensor
    bias: Tensor
    last: Tensor
    last_bias: Tensor
    activation: Callable[[Tensor], Tensor]
    columns: Tensor

    def trim(self, judge: Judge) -> bool:
        """Removes what is not called for, and all that leads into nothing; returns whether anything went."""
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
        """Removes all from input i to column i at once, through nodes and past them: there are pairs that cancel each other.

        Args:
            i: place of the input, and of the column.
            paths: values of the A connections past the nodes, [N, A].
            weight: their weights, [1, A].
            judge: of the change.
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
        """The connections into a hidden node, the weakest first."""
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
    """Removes connections [C, I] from ``inputs`` [N, I] straight to columns, the weakest first; changes weight and bias [C]."""
    means, spread = judge.mean(inputs), judge.spread(inputs)
    centred = inputs - means
    for row in range(len(columns)):
        for j in _weakest_first(weight[row], spread):
            if judge.accepts(columns[row : row + 1], -weight[row, j] * centred[:, j, None]):
                bias[row] += weight[row, j] * means[j]
                weight[row, j] = 0.0


def _weakest_first(weights: Tensor, spread: Tensor) -> list[int]:
    """Places of the weights that are not 0, by how much they move what they lead to."""
    places: list[int] = torch.nonzero(weights)[:, 0].tolist()
    sizes = (weights.abs() * spread).tolist()
    return sorted(places, key=sizes.__getitem__)


@torch.no_grad()
def trim_predictor(predictor: DensePredictor, rows: Examples, n_transitions: int) -> None:
    """Removes what the transitions do not call for: residual paths, the last hidden layer, and what comes out of it.

    Args:
        predictor: changed in place.
        rows: distinct transitions.
        n_transitions: that they stand for.
    """
    rows, codec, out = rows.spread(PRUNING_ROWS), predictor.codec, predictor.out
    inputs = values = codec.inputs(rows.states, rows.actions)
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    activation = ACTIVATIONS[predictor.activation]
    for layer in layers[:-1]:
        values = activation(layer(values))
    said = _columns(codec, predictor(rows.states, rows.actions))
    judge = Judge(rows, codec.column_factor, said, n_transitions, codec.n_inputs)
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
        layer.weight[(above.weight == 0.0).all(dim=0)] = 0.0  # they lead to nothing


@torch.no_grad()
def trim_conditioner(conditioner: Conditioner, predictor: nn.Module, rows: Examples, n_transitions: int) -> None:
    """The same for each of a conditioner's groups, given what the predictor says. Arguments as above."""
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
    """Columns [N, C] of logits [N, O, K]: what ``codec.logits`` made them of."""
    return logits.flatten(1)[:, codec.slots].clone()


BATCHES = 0x9F
"""Added to the seed of the batches: they are not those of the fit before."""

PRUNING_ROUNDS = 3
"""How often what the data do not call for goes; what is left says it more clearly each time that it is trained again."""

SETTLE, RATE = 600, 0.25
"""Steps of training after each time, and share of the learning rate."""


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
    """Prunes the predictor, then the conditioner, which corrects what the pruned predictor says; returns epochs done.

    Args:
        trainer: of the networks.
        connections: of "predictor" and, where there is one, "conditioner".
        fraction: of each network's connections that are gone in the end.
        train: to train on.
        held_out: to choose the best weights by.
        n_transitions: that the rows to train on stand for.
        seed: of the batches.
        progress: is told the share done.
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
            epochs += _settle(trainer).fit(train, held_out, generator, None, _as_left(predictor))
    if not both or conditioner is None:
        return epochs
    half = None if progress is None else lambda share: progress(0.5 + 0.5 * share)
    shrinking = Shrinking(connections["conditioner"], fraction, config)
    epochs += trainer.fit_conditioner(train, held_out, generator, half, shrinking)
    for _ in range(PRUNING_ROUNDS * config.evidence):
        trim_conditioner(conditioner, predictor, train, n_transitions)
        epochs += _settle(trainer).fit_conditioner(train, held_out, generator, None, _as_left(conditioner))
    return epochs


def _settle(trainer: Trainer) -> Trainer:
    """A trainer of the same networks that trains them for a short while, at a low rate."""
    config = trainer.config
    short = replace(config, min_steps=SETTLE, max_steps=SETTLE, learning_rate=RATE * config.learning_rate)
    return Trainer(trainer.codec, trainer.predictor, trainer.conditioner, short)


def _as_left(module: nn.Module) -> Shrinking:
    """Keeps what is gone at 0."""
    return Shrinking(Connections(module, zeros_gone=True), 0.0, PruningConfig(gradual=False))
