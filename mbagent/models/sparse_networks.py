"""What is left of a pruned predictor and causal conditioner of bits, as lists of connections instead of matrices of zeros.

Only hidden nodes that lead to one of the bits asked for are there; a bit that is set adds the few weights that lead from it.
Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions, H hidden nodes of the predictor, G of all
groups of the conditioner.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from mbagent.models.arithmetic import ACTIVATION_CODES, Floats, Floats32, Ints
from mbagent.models.bit_networks import activate
from mbagent.models.networks import Affine, Conditioner, DensePredictor
from mbagent_envs._compiled import compiled, inlined

Bools: TypeAlias = NDArray[np.bool_]


class Links(NamedTuple):
    """Connections of some things, one thing's after the other's.

    Attributes:
        begin: where those of each thing begin, and at last where all end, int64 [things + 1].
        other: what each of them leads to or comes from, int64.
        weight: of each of them.
    """

    begin: Ints
    other: Ints
    weight: Floats32


class SparseGroups(NamedTuple):
    """The conditioner's connections.

    Attributes:
        begin: where the nodes of each outcome bit's group begin, int64 [O + 1].
        links: into each node, from columns: state bits, actions, outcome bits.
        bias: of the nodes, [G].
        readout: from each node to its group's bit, [G].
        offset: of each bit's group, [O].
        grouped: whether an outcome bit has a group, bool [O].
        correction: whether the predictor's logits are added to the conditioner's.
    """

    begin: Ints
    links: Links
    bias: Floats32
    readout: Floats32
    offset: Floats32
    grouped: Bools
    correction: bool


class SparseNetworks(NamedTuple):
    """The two networks' connections.

    Attributes:
        asked: whether each outcome bit is the networks' to tell, bool [O].
        inputs: from each state bit and action to hidden nodes.
        bias: of the hidden nodes, [H].
        outputs: into each outcome bit, from hidden nodes.
        output_bias: [O].
        stay: the residual path's weight, [A, F].
        activation: of all nodes; see ``arithmetic``.
        groups: the conditioner.
        certain: a bit whose logit is at least this far from 0 is left to the predictor.
    """

    asked: Bools
    inputs: Links
    bias: Floats32
    outputs: Links
    output_bias: Floats32
    stay: Floats32
    activation: int
    groups: SparseGroups
    certain: float


def pack_sparse(
    predictor: DensePredictor, conditioner: Conditioner | None, certain: float, asked: Bools
) -> SparseNetworks | None:
    """The connections that the bits ``asked`` for need; None where that is any, and the predictor has not one hidden layer.

    Args:
        predictor: of bits and single actions.
        conditioner: causal, or none.
        certain: from which probability on the predictor is trusted.
        asked: bool [O].
    """
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    if len(layers) != 1 and asked.any():
        return None
    codec = predictor.codec
    first, bias = np.zeros((0, codec.n_inputs), dtype=np.float32), np.zeros(0, dtype=np.float32)
    out = np.zeros((len(asked), 0), dtype=np.float32)
    if asked.any():
        out = _array(predictor.out.weight) * asked[:, None]
        needed = np.flatnonzero((out != 0.0).any(axis=0))
        first, bias, out = _array(layers[0].weight)[needed], _array(layers[0].bias)[needed], out[:, needed]
    stay = np.zeros((codec.n_actions, codec.n_state_columns), dtype=np.float32)
    if predictor.stay is not None:
        stay = _array(predictor.stay)
    p = min(max(certain, 0.5), 1.0)
    return SparseNetworks(
        asked,
        _links(first.T),
        bias,
        _links(out),
        _array(predictor.out.bias),
        np.ascontiguousarray(stay),
        ACTIVATION_CODES[predictor.activation],
        _groups(conditioner, asked, codec.n_inputs + codec.n_columns),
        math.log(p / (1.0 - p)) if p < 1.0 else math.inf,
    )


def _groups(conditioner: Conditioner | None, asked: Bools, n_columns: int) -> SparseGroups:
    counts, offset, grouped = np.zeros(len(asked), np.int64), np.zeros(len(asked), np.float32), np.zeros_like(asked)
    weight, bias, readout = np.zeros((0, n_columns), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32)
    if conditioner is not None and len(conditioner.members):
        members, groups = conditioner.members.numpy(), conditioner.groups
        grouped[members], offset[members] = asked[members], _array(conditioner.offset)[:, 0, 0]
        readout = _array(conditioner.readout)[:, :, 0].ravel()
        used = (readout != 0.0) & np.repeat(asked[members], conditioner.group_size)
        weight = _array(groups.weight if groups.mask is None else groups.weight * groups.mask)[used]
        bias, readout = _array(groups.bias)[used], readout[used]
        counts[members] = used.reshape(len(members), -1).sum(axis=1)
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return SparseGroups(begin, _links(weight), bias, readout, offset, grouped, conditioner is not None and conditioner.correction)


def _links(weight: Floats32) -> Links:
    """The weights that are not 0, row after row."""
    matrix = csr_matrix(weight)
    return Links(matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), matrix.data.astype(np.float32))


def _array(tensor: Tensor) -> Floats32:
    array: Floats32 = np.array(tensor.detach().numpy(), dtype=np.float32)
    return array


@inlined
def add_input(column: int, sums: Floats32, links: Links) -> None:
    """Adds to the hidden nodes' sums [H] what a state bit that is 1, or an action, gives them."""
    begin, other, weight = links
    for v in range(begin[column], begin[column + 1]):
        sums[other[v]] += weight[v]


@inlined
def predicted(i: int, hidden: Floats32, begin: Ints, other: Ints, weight: Floats32, logit: float) -> float:
    """The predictor's logit of outcome bit i, from the hidden nodes' values [H], their links, and what it is without them."""
    for v in range(begin[i], begin[i + 1]):
        logit += weight[v] * np.float64(hidden[other[v]])
    return logit


@compiled
def predict_bits(state: Ints, action: int, hidden: Floats32, bits: Ints, logits: Floats, k: SparseNetworks) -> None:
    """Writes the predictor's logits [O] of some outcome bits of state int64 [F], from the hidden nodes' values [H]."""
    begin, other, weight = k.outputs
    bias, stay, asked = k.output_bias, k.stay, k.asked
    for i in bits:
        if asked[i]:
            logit = np.float64(bias[i])
            if i < len(state):
                logit += stay[action, i] * np.float64(2 * state[i] - 1)
            logits[i] = predicted(i, hidden, begin, other, weight, logit)


@compiled
def conditioned(
    i: int,
    prior: float,
    action: int,
    q: int,
    state: Ints,
    base: Ints,
    slot: Ints,
    factors: Ints,
    nodes: Floats32,
    k: SparseNetworks,
) -> float:
    """The logit of bit i in the eyes of its group, given the outcome bits before it.

    Args:
        i: the bit.
        prior: the predictor's logit.
        action: taken.
        q: the particle that knows the open bits.
        state: bits, int64 [F].
        base: of the outcome, -1 where open, int64 [O].
        slot: the number of each open bit among them, int64 [O].
        factors: values of the open bits, int64 [n, O].
        nodes: work space, float32, for the group's nodes.
        k: the networks.
    """
    n_bits, n_inputs, groups = len(state), len(k.inputs.begin) - 1, k.groups
    first, last = groups.begin[i], groups.begin[i + 1]
    begin, other, weight = groups.links
    bias, readout = groups.bias, groups.readout
    for node in range(first, last):
        total = bias[node]
        for v in range(begin[node], begin[node + 1]):
            column = other[v]
            if column < n_bits:
                value = state[column]
            elif column < n_inputs:
                value = np.int64(column - n_bits == action)
            else:
                value = base[column - n_inputs]
                if value < 0:
                    value = factors[q, slot[column - n_inputs]]
            total += weight[v] * np.float32(value)
        nodes[node - first] = total
    activate(nodes[: last - first], k.activation)
    logit = np.float64(groups.offset[i]) + (prior if groups.correction else 0.0)
    for node in range(first, last):
        logit += readout[node] * np.float64(nodes[node - first])
    return logit


@inlined
def leans_on_open(i: int, base: Ints, k: SparseNetworks) -> bool:
    """Whether the group of bit i sees an outcome bit that is open."""
    n_inputs, group = len(k.inputs.begin) - 1, k.groups.begin
    begin, other, _ = k.groups.links
    found = False
    for v in range(begin[group[i]], begin[group[i + 1]]):
        found = found or (other[v] >= n_inputs and base[other[v] - n_inputs] < 0)
    return found
