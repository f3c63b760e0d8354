"""Pruning of predictor and conditioner, and the dependencies between variables that remain.

Pruning is first by magnitude with retraining (paper section 5), then by the extended BIC, because some of the weights left by
magnitude pruning only fit noise: a fair coin, for example, keeps dozens of weak parents. A connection is kept only if its
removal increases the total loss on the observed transitions, in nats, by at least the sum of two terms. The first is half the
logarithm of the number of transitions (Schwarz 1978, "Estimating the dimension of a model"). The second is the logarithm of the
number of candidate inputs, since the best of many gains is large by chance (Chen and Chen 2008, "Extended Bayesian information
criteria for model selection with large model spaces"). Each connection is tested with the rest of the network fixed, except that
the mean contribution of the connection is added to the bias.

"If we can find that some sets of variables are conditionally independent of one another, we can separate them into different
modules" (paper section 5, figures 11 and 12). Influences and variable groups are computed from the remaining connections.
Shapes: N rows, C output columns of a network, H hidden nodes, I inputs, F state factors, O = F + 1 output factors (``terminated``
last), A actions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mbagent.models.neural.connections import Connections, PruningConfig, Shrinking
from mbagent.models.neural.network_pair import NetworkPair
from mbagent.models.neural.networks import ACTIVATIONS, Affine, Conditioner, DensePredictor, FactorCodec
from mbagent.models.neural.training import Examples, Trainer
from mbagent.models.neural.truth_tables import PARENT
from mbagent.types import Floats, Ints, Progress


@dataclass(frozen=True)
class Influence:
    """Influence on each output factor: product of absolute weights along a path, summed over all paths; 0 without a path.

    Attributes:
        states: influence of each state factor in the predictor, [O, F].
        actions: influence of each action in the predictor, [O, A].
        others: influence of each other output factor in the conditioner, [O, O].
        conditions: influence of each state factor in the conditioner, [O, F].
    """

    states: Floats
    actions: Floats
    others: Floats
    conditions: Floats


@dataclass(frozen=True)
class VariableGroup:
    """A connected component of the dependency graph.

    Attributes:
        outputs: output factors, int64.
        inputs: state factors with a path to these outputs, int64.
        action: whether the action has a path to them in the predictor.
    """

    outputs: Ints
    inputs: Ints
    action: bool

    def text(self, names: Sequence[str]) -> str:
        """The group as one line of text, with the names of the state factors."""
        names = [*names, "terminated"]
        given = [names[i] for i in self.inputs] + ["action"] * self.action
        return f"{', '.join(names[i] for i in self.outputs)} <- {', '.join(given) or 'nothing'}"


def influence(model: NetworkPair, *, effective: bool = False) -> Influence:
    """Computes the sums over paths in both networks.

    Args:
        model: the networks.
        effective: whether to omit dependencies without effect, such as paths that cancel each other; this applies only to a
            pruned model of bits (see ``truth_tables.find_parents``).

    Raises:
        ValueError: the predictor is not dense; weights shared over positions do not belong to single variables.
    """
    if not isinstance(model.predictor, DensePredictor):
        raise ValueError("Sums over paths need networks on flat variables; this model shares its weights over positions.")
    codec, predictor = model.codec, model.predictor
    layers = [_absolute(layer) for layer in (*predictor.layers, predictor.out) if isinstance(layer, Affine)]
    columns = layers[0]
    for layer in layers[1:]:
        columns = layer @ columns
    if predictor.stay is not None:
        n = codec.n_state_columns
        columns[np.arange(n), np.arange(n)] += np.abs(predictor.stay.detach().numpy()).max(axis=0)
    factor = codec.column_factor.numpy()
    n_outputs, n_state = len(codec.outputs), codec.n_state_columns
    of_outputs = (factor == np.arange(n_outputs)[:, None]).astype(np.float64)
    of_states = of_outputs[:-1, :n_state].T
    rows = of_outputs @ columns
    others, conditions = np.zeros((n_outputs, n_outputs)), np.zeros((n_outputs, n_outputs - 1))
    if model.conditioner is not None and len(model.conditioner.members):
        seen = _conditioner_sums(model.conditioner)
        members = model.conditioner.members.numpy()
        others[members] = seen[:, codec.n_inputs :] @ of_outputs.T
        conditions[members] = seen[:, :n_state] @ of_states
    states = rows[:, :n_state] @ of_states
    if effective and len(model.parents):
        matters, n = model.parents == PARENT, states.shape[1]
        states, conditions, others = states * matters[:, :n], conditions * matters[:, :n], others * matters[:, n:]
    return Influence(states, rows[:, n_state:], others, conditions)


def _absolute(layer: Affine) -> Floats:
    absolute: Floats = np.abs(layer.weight.detach().numpy()).astype(np.float64)
    return absolute


def _conditioner_sums(conditioner: Conditioner) -> Floats:
    """Sums over paths from columns of (s, a) and the next factors to each group's output, [g, n_inputs + n_columns]."""
    groups = _absolute(conditioner.groups)
    if conditioner.groups.mask is not None:
        groups *= conditioner.groups.mask.numpy()
    readout = np.abs(conditioner.readout.detach().numpy()).max(axis=2)
    grouped = groups.reshape(len(readout), conditioner.group_size, -1)
    sums: Floats = np.einsum("gh,ghc->gc", readout, grouped)
    return sums


def modules(found: Influence) -> list[VariableGroup]:
    """Independent groups of variables linked by one-step dependencies, largest first; isolated variables are omitted."""
    n = len(found.states)
    links = np.zeros((n, n), dtype=np.bool_)
    links[:, : n - 1] = found.states > 0.0
    return _modules(found, links)


def dependent_groups(found: Influence) -> list[VariableGroup]:
    """Groups of variables whose next values the conditioner links, given state and action; largest first."""
    return _modules(found, found.others > 0.0)


def _modules(found: Influence, links: NDArray[np.bool_]) -> list[VariableGroup]:
    """Connected components with several variables, or with one that depends on itself."""
    _, label = scipy.sparse.csgraph.connected_components(scipy.sparse.csr_matrix(links.astype(np.int64)), directed=False)
    result = []
    for component in range(label.max() + 1):
        members = np.flatnonzero(label == component)
        if not links[np.ix_(members, members)].any():
            continue
        leads = (found.states[members] > 0.0).any(axis=0) | (found.conditions[members] > 0.0).any(axis=0)
        result.append(VariableGroup(members, np.flatnonzero(leads), bool((found.actions[members] > 0.0).any())))
    return sorted(result, key=lambda module: -len(module.outputs))


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
        """Mean loss of a factor, given its columns' ``logits`` [N, its columns]."""
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
        """Removes all paths, direct or through nodes, from input i to column i at once, as they may cancel out.

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
    """Indices of non-zero weights, sorted by the standard deviation of their effect."""
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
    data: tuple[Examples, Examples],
    n_transitions: int,
    seed: int,
    progress: Progress | None,
    config: PruningConfig | None,
) -> float:
    """Prunes the predictor, then the conditioner, which corrects the pruned predictor; returns the number of epochs.

    Args:
        trainer: trainer of the networks.
        connections: connections of "predictor" and, if there is one, "conditioner".
        fraction: minimum share of each network's connections to remove.
        data: training examples, and examples for the selection of the best weights.
        n_transitions: number of transitions that the training examples represent.
        seed: seed of the batches.
        progress: called with the completed share.
        config: see PruningConfig.
    """
    config, generator = config or PruningConfig(), torch.Generator().manual_seed(seed + BATCHES)
    train, held_out = data
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
