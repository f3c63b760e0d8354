"""A pruned predictor and causal conditioner of bits as lists of connections instead of matrices.

Only hidden nodes with a path to one of the requested bits are included; each input bit that is 1 adds its few weights.
Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions, H hidden nodes of the predictor, G of all
groups of the conditioner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from torch import Tensor

from mbagent.models.neural.bit_kernels import activate
from mbagent.models.neural.kernels import ACTIVATION_CODES, Floats32
from mbagent.models.neural.networks import Affine, Conditioner, DensePredictor
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled, inlined

SURE_LOGIT = math.log(1e6)
"""A logit with a larger absolute value is treated as certain."""


class Links(NamedTuple):
    """Connections grouped by one of their ends (a compressed sparse row matrix).

    Attributes:
        begin: index of the first connection of each row, and the end of the last row, int64 [rows + 1].
        other: the other end of each connection, int64.
        weight: weight of each connection.
    """

    begin: Ints
    other: Ints
    weight: Floats32


class SparseGroups(NamedTuple):
    """The conditioner's connections.

    Attributes:
        begin: index of the first node of each outcome bit's group, int64 [O + 1].
        links: into each node, from columns: state bits, actions, outcome bits.
        bias: bias of the nodes, [G].
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
        asked: whether each outcome bit is predicted by the networks, bool [O].
        inputs: from each state bit and action to hidden nodes.
        bias: bias of the hidden nodes, [H].
        outputs: into each outcome bit, from hidden nodes.
        output_bias: [O].
        stay: weights of the residual path, [A, F].
        activation: code of the activation of all nodes; see ``kernels``.
        groups: the conditioner.
        certain: a bit whose logit has at least this absolute value is sampled from the predictor.
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
    """The connections required for the requested bits; None unless the predictor has exactly one hidden layer.

    Args:
        predictor: a predictor of bits and single actions.
        conditioner: a causal conditioner, or None.
        certain: probability from which on the predictor is trusted.
        asked: requested outcome bits, bool [O].
    """
    layers = [layer for layer in predictor.layers if isinstance(layer, Affine)]
    if len(layers) != 1:
        return None
    codec, out = predictor.codec, _array(predictor.out.weight) * asked[:, None]
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


def n_links(k: SparseNetworks) -> int:
    """Number of connections."""
    return sum(len(links.weight) for links in (k.inputs, k.outputs, k.groups.links))


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
    """The non-zero weights, row by row."""
    matrix = csr_matrix(weight)
    return Links(matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), matrix.data.astype(np.float32))


def _array(tensor: Tensor) -> Floats32:
    array: Floats32 = np.array(tensor.detach().numpy(), dtype=np.float32)
    return array


class Room(NamedTuple):
    """Work space.

    Attributes:
        sums: the state's contribution to the hidden nodes, [H].
        hidden: their values, [H].
        logits: the predictor's, [O].
        chances: the predictor's P(bit = 1), [O].
        conditioned: whether the bit is predicted by its group, which must then be evaluated, bool [O].
        nodes: values of a group's nodes.
    """

    sums: Floats32
    hidden: Floats32
    logits: Floats
    chances: Floats
    conditioned: Bools
    nodes: Floats32


@compiled
def room_for(k: SparseNetworks | None) -> Room:
    """Work space for networks; empty for None. Here and below, numba removes the branches for None at compile time."""
    n_hidden, n_outputs, n_nodes = 0, 0, 0
    if k is not None:
        n_hidden, n_outputs, n_nodes = len(k.bias), len(k.asked), len(k.groups.readout)
    return Room(
        np.empty(n_hidden, dtype=np.float32),
        np.empty(n_hidden, dtype=np.float32),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(n_outputs, dtype=np.bool_),
        np.empty(n_nodes, dtype=np.float32),
    )


@inlined
def _add_input(column: int, sums: Floats32, begin: Ints, other: Ints, weight: Floats32) -> None:
    """Adds the weights of a state bit that is 1, or of an action, to the hidden nodes' sums [H]."""
    for v in range(begin[column], begin[column + 1]):
        sums[other[v]] += weight[v]


@compiled
def see_state(k: SparseNetworks | None, room: Room, state: Ints) -> None:
    """Computes the contribution of a state int64 [F] to the hidden nodes."""
    if k is None:
        return
    sums, bias = room.sums, k.bias
    begin, other, weight = k.inputs
    for h in range(len(sums)):
        sums[h] = bias[h]
    for bit in range(len(state)):
        if state[bit] == 1:
            _add_input(bit, sums, begin, other, weight)


@inlined
def _chance(logit: float) -> float:
    """The logistic function, in double precision; rounded to 0 or 1 beyond ``SURE_LOGIT``."""
    if abs(logit) > SURE_LOGIT:
        return 1.0 if logit > 0.0 else 0.0
    return 1.0 / (1.0 + math.exp(-logit))


@compiled
def see_action(k: SparseNetworks | None, room: Room, state: Ints, action: int) -> None:
    """Writes the predictor's output for the requested bits, after ``see_state``."""
    if k is None:
        return
    sums, hidden, logits, bias, stay, asked = room.sums, room.hidden, room.logits, k.output_bias, k.stay, k.asked
    chances, conditioned, grouped, certain = room.chances, room.conditioned, k.groups.grouped, k.certain
    begin, other, weight = k.inputs
    for h in range(len(sums)):
        hidden[h] = sums[h]
    _add_input(len(state) + action, hidden, begin, other, weight)
    activate(hidden, k.activation)
    begin, other, weight = k.outputs
    for i in range(len(asked)):
        if asked[i]:
            logit = np.float64(bias[i])
            if i < len(state):
                logit += stay[action, i] * np.float64(2 * state[i] - 1)
            for v in range(begin[i], begin[i + 1]):
                logit += weight[v] * np.float64(hidden[other[v]])
            logits[i], chances[i] = logit, _chance(logit)
            conditioned[i] = grouped[i] and abs(logit) < certain


@compiled
def leans_on_open(k: SparseNetworks | None, i: int, base: Ints) -> bool:
    """Whether the prediction of bit i's group depends on an open outcome bit, which is -1 in ``base`` int64 [O]."""
    found = False
    if k is None:
        return found
    n_inputs, group = len(k.inputs.begin) - 1, k.groups.begin
    begin, other, _ = k.groups.links
    for v in range(begin[group[i]], begin[group[i + 1]]):
        found = found or (other[v] >= n_inputs and base[other[v] - n_inputs] < 0)
    return found


@compiled
def ask(
    k: SparseNetworks | None,
    room: Room,
    i: int,
    action: int,
    q: int,
    state: Ints,
    base: Ints,
    slot: Ints,
    factors: Ints,
) -> float:
    """P(bit i = 1) by its group, given a particle's earlier outcome bits, after ``see_action``.

    Args:
        k: the networks.
        room: work space.
        i: the bit.
        action: the action.
        q: the particle, which has values of the open bits.
        state: bits of the state, int64 [F].
        base: bits of the outcome, -1 if open, int64 [O].
        slot: index of each open bit among the open bits, int64 [O].
        factors: values of the open bits of each particle, int64 [n, O].
    """
    if k is None:
        return 0.5
    logit, groups, nodes = room.logits[i], k.groups, room.nodes
    n_bits, n_inputs = len(state), len(k.inputs.begin) - 1
    first, last, readout, bias = groups.begin[i], groups.begin[i + 1], groups.readout, groups.bias
    begin, other, weight = groups.links
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
    own = np.float64(groups.offset[i]) + (logit if groups.correction else 0.0)
    for node in range(first, last):
        own += readout[node] * np.float64(nodes[node - first])
    return _chance(own)
