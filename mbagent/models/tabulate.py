"""From a pruned predictor and causal conditioner of bits to truth tables (see ``bit_rules.py``).

What a bit hangs on is what a path of connections leads from and what makes a difference: a bit that always has the same value,
or whose paths are too weak to matter, is taken for its usual value. How much that changes is measured on transitions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbagent.models.bit_rules import Table
from mbagent.models.networks import ACTIVATIONS, Affine, Conditioner, DensePredictor
from mbagent.models.training import Examples

MOST_PARENTS = 12
"""A table has at most two to this power of entries for each action."""

TOLERANCE = 0.002
"""What taking bits for their usual values may change in all, in total variation summed over variables."""

PARENT = 2
"""Marks a bit that matters; 0 and 1 are values that a bit is taken for."""

ROWS = 8192
"""Transitions that differences are measured on, at most."""

Marks = NDArray[np.int8]


class Pair(NamedTuple):
    """The two networks and from which probability on the predictor is trusted."""

    predictor: DensePredictor
    conditioner: Conditioner | None
    certain: float


def _predicted(pair: Pair, inputs: Tensor, outputs: slice) -> Tensor:
    """The predictor's logits of some outcome bits, from columns [N, n_inputs]."""
    predictor, values = pair.predictor, inputs
    for layer in predictor.layers:
        values = ACTIVATIONS[predictor.activation](layer(values))
    logits = values @ predictor.out.weight[outputs].T + predictor.out.bias[outputs]
    if predictor.stay is not None:
        n = predictor.codec.n_state_columns
        signed = (2.0 * inputs[:, :n] - 1.0) * (inputs[:, n:] @ predictor.stay)
        logits = logits + torch.cat((signed, signed.new_zeros(len(signed), 1)), dim=1)[:, outputs]
    return logits


def chances(pair: Pair, columns: Tensor, i: int) -> Tensor:
    """P(bit i = 1) [N] from columns of state, action and outcome [N, n_inputs + O], as ``samplers.sample_causal`` has it."""
    n_inputs, conditioner = pair.predictor.codec.n_inputs, pair.conditioner
    logit = _predicted(pair, columns[:, :n_inputs], slice(i, i + 1))[:, 0]
    chance = torch.sigmoid(logit.double())
    if conditioner is None or not bool(conditioner.grouped[i]):
        return chance
    g, size = int(conditioner.grouped[:i].sum()), conditioner.group_size
    groups, rows = conditioner.groups, slice(g * size, (g + 1) * size)
    weight = groups.weight[rows] if groups.mask is None else groups.weight[rows] * groups.mask[rows]
    hidden = ACTIVATIONS[conditioner.activation](columns @ weight.T + groups.bias[rows])
    own = (hidden @ conditioner.readout[g] + conditioner.offset[g])[:, 0]
    asked = torch.sigmoid((own + logit if conditioner.correction else own).double())
    return torch.where(torch.maximum(chance, 1.0 - chance) >= pair.certain, chance, asked)


def _paths(layers: list[Tensor]) -> NDArray[np.bool_]:
    """Which inputs [outputs, inputs] a path leads from, through weights [to, from]."""
    reach = (layers[0] != 0.0).double()
    for weight in layers[1:]:
        reach = ((weight != 0.0).double() @ reach > 0.0).double()
    found: NDArray[np.bool_] = reach.numpy() > 0.0
    return found


def paths(pair: Pair) -> NDArray[np.bool_]:
    """Which columns of state, action and outcome a path leads from to each outcome bit, bool [O, n_inputs + O]."""
    predictor, conditioner, codec = pair.predictor, pair.conditioner, pair.predictor.codec
    n_outputs, n_inputs = len(codec.outputs), codec.n_inputs
    reach = np.zeros((n_outputs, n_inputs + n_outputs), dtype=np.bool_)
    layers = [layer.weight.detach() for layer in (*predictor.layers, predictor.out) if isinstance(layer, Affine)]
    reach[:, :n_inputs] = _paths(layers)
    if predictor.stay is not None:
        left = predictor.stay.detach().numpy() != 0.0
        bits = np.arange(codec.n_state_columns)
        reach[bits, bits] |= left.any(axis=0)
        reach[bits, codec.n_state_columns : n_inputs] |= left.T
    if conditioner is not None and len(conditioner.members):
        weight = conditioner.groups.weight.detach()
        weight = weight if conditioner.groups.mask is None else weight * conditioner.groups.mask
        read = (conditioner.readout.detach() != 0.0).any(dim=2).double()
        grouped = (weight != 0.0).double().view(len(read), conditioner.group_size, -1)
        reach[conditioner.members.numpy()] |= torch.einsum("gh,ghc->gc", read, grouped).numpy() > 0.0
    return reach


@torch.no_grad()
def find_parents(pair: Pair, rows: Examples) -> Marks:
    """What each outcome bit hangs on: int8 [O, F + O], PARENT or the value that a bit is taken for; of state and outcome."""
    codec, rows = pair.predictor.codec, rows.spread(ROWS)
    columns = torch.cat((codec.inputs(rows.states, rows.actions), codec.targets(rows.outcomes)), dim=1)
    usual, reach, n_bits = (columns.mean(dim=0) > 0.5).float(), paths(pair), codec.n_state_columns
    bits = np.concatenate([np.arange(n_bits), np.arange(codec.n_inputs, columns.shape[1])])
    marks = np.tile(usual.numpy().astype(np.int8)[bits], (len(reach), 1))
    sample = Sample(columns, usual, rows.weights.double() / rows.weights.sum())
    for i in range(len(reach)):
        places = np.flatnonzero(reach[i, bits])
        marks[i, places[sample.needed(pair, i, bits[places], TOLERANCE / len(reach))]] = PARENT
    return marks


class Sample(NamedTuple):
    """Transitions that differences are measured on.

    Attributes:
        columns: of state, action and outcome, [N, n_inputs + O].
        usual: the value that each of them has most often.
        weights: of the transitions, double [N], sum 1.
    """

    columns: Tensor
    usual: Tensor
    weights: Tensor

    def needed(self, pair: Pair, i: int, columns: NDArray[np.int64], tolerance: float) -> NDArray[np.int64]:
        """Places of the columns that outcome bit i hangs on: to take all others for their usual values changes less than this."""
        known = chances(pair, self.columns, i)
        alone = np.array([self._changed(pair, i, known, columns[place : place + 1]) for place in range(len(columns))])
        order, few, many = np.argsort(alone, kind="stable"), 0, int((alone <= tolerance).sum())
        while few < many:  # how many go together, at most
            middle = (few + many + 1) // 2
            if self._changed(pair, i, known, columns[order[:middle]]) <= tolerance:
                few = middle
            else:
                many = middle - 1
        return order[few:]

    def _changed(self, pair: Pair, i: int, known: Tensor, columns: NDArray[np.int64]) -> float:
        """How far the chance of bit i moves if these columns are taken for their usual values, mean over transitions."""
        differs = torch.nonzero((self.columns[:, columns] != self.usual[columns]).any(dim=1))[:, 0]
        if not len(differs):
            return 0.0
        changed = self.columns[differs]
        changed[:, columns] = self.usual[columns]
        return float(torch.dot((chances(pair, changed, i) - known[differs]).abs(), self.weights[differs]))


def tabulable(marks: Marks) -> NDArray[np.bool_]:
    """Which outcome bits have few enough parents for a table, bool [O]."""
    few: NDArray[np.bool_] = (marks == PARENT).sum(axis=1) <= MOST_PARENTS
    return few


@torch.no_grad()
def tabulate(pair: Pair, marks: Marks, which: NDArray[np.bool_]) -> list[Table | None]:
    """Tables over what ``marks`` names, of the bits ``which``; None for all others."""
    codec, reach = pair.predictor.codec, paths(pair)
    acts = [bool(row[codec.n_state_columns : codec.n_inputs].any()) for row in reach]
    return [_table(pair, marks[i], acts[i], i) if which[i] else None for i in range(len(marks))]


def _table(pair: Pair, marks: Marks, acts: bool, i: int) -> Table:
    """P(bit i = 1) for each value of its parents, and for each action where it ``acts``."""
    codec, mine = pair.predictor.codec, np.flatnonzero(marks == PARENT)
    n_bits, n_actions, size = codec.n_state_columns, codec.n_actions, 1 << len(mine)
    fixed = torch.from_numpy(np.where(marks == PARENT, 0, marks).astype(np.float32))
    columns = torch.zeros(size * n_actions if acts else size, codec.n_inputs + len(codec.outputs))
    columns[:, :n_bits], columns[:, codec.n_inputs :] = fixed[:n_bits], fixed[n_bits:]
    number = torch.arange(len(columns))
    for power, j in enumerate(mine):
        columns[:, j if j < n_bits else j + n_actions] = (number % size >> power & 1).float()
    columns[number, n_bits + number // size] = 1.0
    table: NDArray[np.float64] = chances(pair, columns, i).numpy().reshape(-1, *(2,) * len(mine))
    return Table(tuple(mine[mine < n_bits].tolist()), tuple((mine[mine >= n_bits] - n_bits).tolist()), table)
