"""Compiled inference: the networks of ``networks.py`` evaluated row by row (``samplers.py`` draws with them).

Torch trains; here each row is computed by itself, in one fixed order of operations. So a row's result is the same to
the
last bit alone and in any batch, which matrix products do not promise, and inputs that are 0 cost nothing. Shapes: B
batch, F
state factors, O = F + 1 output factors, K largest cardinality, G hidden nodes in a group.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent_envs._compiled import compiled

Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIGMOID, RELU, SILU, TANH = 0, 1, 2, 3
ACTIVATION_CODES = {"sigmoid": SIGMOID, "relu": RELU, "silu": SILU, "tanh": TANH}


class Layout(NamedTuple):
    """Where factors lie among columns.

    Attributes:
        outputs: cardinalities of the output factors, int64 [O]; the first F are the state's.
        start: first column of each output factor, int64 [O].
        n_state_columns: columns of the state; those of the action follow.
    """

    outputs: Ints
    start: Ints
    n_state_columns: int


class DenseWeights(NamedTuple):
    """A ``DensePredictor``: weights are [from, to], padded to the widest layer H; L hidden layers.

    Attributes:
        first: of (state, action) columns, [n_inputs, H] (L = 0: [n_inputs, n_columns]).
        inner: of hidden layers 1 ... L - 1, [max(L - 1, 0), H, H].
        bias: of the hidden layers, [L, H].
        sizes: of the hidden layers, int64 [L].
        last: of the output columns, [H, n_columns].
        last_bias: [n_columns].
        stay: the residual path's, [A, n_state_columns]; zero where there is none.
        activation: one of the codes above.
    """

    first: Floats32
    inner: Floats32
    bias: Floats32
    sizes: Ints
    last: Floats32
    last_bias: Floats32
    stay: Floats32
    activation: int


class GroupWeights(NamedTuple):
    """A ``Conditioner`` with g groups.

    Attributes:
        group_of: group of each output factor, -1 where it has none, int64 [O].
        inputs: from (state, action) columns, [g, n_inputs, G].
        others: from the next factors' columns, zero where pruned, [g, n_columns, G].
        bias: [g, G].
        readout: to the logits of the group's factor, [g, G, K].
        offset: [g, K].
        activation: one of the codes above.
        correction: whether the predictor's logits are added.
    """

    group_of: Ints
    inputs: Floats32
    others: Floats32
    bias: Floats32
    readout: Floats32
    offset: Floats32
    activation: int
    correction: bool


@compiled
def _activate(values: Floats32, n: int, code: int) -> None:
    for h in range(n):
        value = values[h]
        if code == RELU:
            values[h] = max(value, np.float32(0.0))
        elif code == TANH:
            values[h] = math.tanh(value)
        else:
            gate = np.float32(1.0) / (np.float32(1.0) + np.float32(math.exp(-max(value, np.float32(-80.0)))))
            values[h] = gate if code == SIGMOID else value * gate


@compiled
def active_columns(state: Ints, action: int, layout: Layout, out: Ints) -> int:
    """Writes the input columns that are 1 to ``out`` and returns how many there are."""
    n = 0
    for factor in range(len(state)):
        value = state[factor]
        if layout.outputs[factor] != 2:
            out[n] = layout.start[factor] + value
            n += 1
        elif value == 1:
            out[n] = layout.start[factor]
            n += 1
    out[n] = layout.n_state_columns + action
    return n + 1


@compiled
def _add_products(values: Floats32, n_values: int, weights: Floats32, out: Floats32, n_out: int) -> None:
    for h in range(n_values):
        value = values[h]
        row = weights[h]
        for k in range(n_out):
            out[k] += value * row[k]


@compiled
def dense_logits(states: Ints, actions: Ints, layout: Layout, dense: DenseWeights) -> Floats32:
    """A dense predictor's logits, float32 [B, O, K]; values a factor lacks are at -1e9."""
    n_columns, n_outputs, depth = len(dense.last_bias), len(layout.outputs), len(dense.sizes)
    width, n_hidden = layout.outputs.max(), dense.bias.shape[1]
    logits = np.full((len(states), n_outputs, width), np.float32(-1e9), dtype=np.float32)
    active = np.empty(states.shape[1] + 1, dtype=np.int64)
    now, after = np.empty(n_hidden, dtype=np.float32), np.empty(n_hidden, dtype=np.float32)
    columns = np.empty(n_columns, dtype=np.float32)
    for b in range(len(states)):
        n_active = active_columns(states[b], actions[b], layout, active)
        columns[:] = dense.last_bias
        if depth == 0:
            for a in range(n_active):
                columns += dense.first[active[a]]
        else:
            now[:] = dense.bias[0]
            for a in range(n_active):
                now += dense.first[active[a]]
            _activate(now, dense.sizes[0], dense.activation)
            for level in range(1, depth):
                after[:] = dense.bias[level]
                _add_products(now, dense.sizes[level - 1], dense.inner[level - 1], after, dense.sizes[level])
                _activate(after, dense.sizes[level], dense.activation)
                now, after = after, now
            _add_products(now, dense.sizes[depth - 1], dense.last, columns, n_columns)
        stay = dense.stay[actions[b]]
        columns[: layout.n_state_columns] -= stay
        for a in range(n_active - 1):
            columns[active[a]] += np.float32(2.0) * stay[active[a]]
        for i in range(n_outputs):
            if layout.outputs[i] == 2:
                logits[b, i, 0] = 0.0
                logits[b, i, 1] = columns[layout.start[i]]
            else:
                for k in range(layout.outputs[i]):
                    logits[b, i, k] = columns[layout.start[i] + k]
    return logits


@compiled
def softmax(logits: Floats32, n: int, out: Floats) -> None:
    """Writes the distribution of a factor with ``n`` values to ``out`` [K], from its logits [K]."""
    if n == 2:  # one exponential instead of two: bits are the common case
        difference = np.float64(logits[1]) - np.float64(logits[0])
        small = math.exp(-abs(difference))
        out[0 if difference > 0 else 1] = small / (1.0 + small)
        out[1 if difference > 0 else 0] = 1.0 / (1.0 + small)
        return
    top = np.float64(logits[0])
    for k in range(1, n):
        top = max(top, np.float64(logits[k]))
    total = 0.0
    for k in range(n):
        out[k] = math.exp(np.float64(logits[k]) - top)
        total += out[k]
    for k in range(n):
        out[k] /= total


@compiled
def probabilities(logits: Floats32, outputs: Ints) -> Floats:
    """Each factor's distribution, float64 [B, O, K], from logits [B, O, K]; 0 for values a factor lacks."""
    out = np.zeros(logits.shape, dtype=np.float64)
    if logits.shape[2] == 2:  # written out, since slices of arrays cost more than the arithmetic
        for b in range(logits.shape[0]):
            for i in range(logits.shape[1]):
                difference = np.float64(logits[b, i, 1]) - np.float64(logits[b, i, 0])
                small = math.exp(-abs(difference))
                large = 1.0 / (1.0 + small)
                out[b, i, 1] = large if difference > 0 else small * large
                out[b, i, 0] = small * large if difference > 0 else large
        return out
    for b in range(logits.shape[0]):
        for i in range(logits.shape[1]):
            softmax(logits[b, i], outputs[i], out[b, i])
    return out


@compiled
def conditional(
    i: int,
    base: Floats32,
    active: Ints,
    n_active: int,
    factors: Ints,
    layout: Layout,
    group: GroupWeights,
    hidden: Floats32,
    logits: Floats32,
    out: Floats,
) -> None:
    """Writes P(y_i | s, a, y_<i) to ``out``, for a factor that has a group.

    ``base`` [K] are the predictor's logits, ``factors`` [O] holds y_<i, ``hidden`` [G] and ``logits`` [K] are work
    space.
    """
    g = group.group_of[i]
    hidden[:] = group.bias[g]
    for a in range(n_active):
        hidden += group.inputs[g, active[a]]
    for j in range(i):
        if layout.outputs[j] != 2:
            hidden += group.others[g, layout.start[j] + factors[j]]
        elif factors[j] == 1:
            hidden += group.others[g, layout.start[j]]
    finish(i, base, layout, group, hidden, logits, out)


@compiled
def finish(
    i: int,
    base: Floats32,
    layout: Layout,
    group: GroupWeights,
    hidden: Floats32,
    logits: Floats32,
    out: Floats,
) -> None:
    """From the summed input of factor i's group (overwritten) to the factor's distribution."""
    n, g = layout.outputs[i], group.group_of[i]
    _activate(hidden, len(hidden), group.activation)
    for k in range(n):
        logits[k] = group.offset[g, k] + (base[k] if group.correction else np.float32(0.0))
    for h in range(len(hidden)):
        value = hidden[h]
        for k in range(n):
            logits[k] += value * group.readout[g, h, k]
    softmax(logits, n, out)


@compiled
def largest(values: Floats, n: int) -> int:
    """Index of the largest of the first ``n`` values."""
    best = 0
    for k in range(1, n):
        if values[k] > values[best]:
            best = k
    return best


@compiled
def trusted(i: int, values: Floats, layout: Layout, group: GroupWeights, certain: float) -> bool:
    """Whether factor i is left to the predictor, which gives it the distribution ``values``."""
    return bool(group.group_of[i] < 0 or values[largest(values, layout.outputs[i])] >= certain)
