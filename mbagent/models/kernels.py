"""Compiled inference: the networks of ``networks.py`` evaluated row by row (``samplers.py`` draws with them).

Torch trains; here each row is computed by itself, in one fixed order of operations. So a row's result is the same
to the last bit alone and in any batch, which matrix products do not promise, and inputs that are 0 cost nothing.
Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, G hidden nodes in a group.
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
        n_actions: actions A of a single step.
        n_steps: actions in a string, see ``FactorCodec``.
    """

    outputs: Ints
    start: Ints
    n_state_columns: int
    n_actions: int
    n_steps: int


class DenseWeights(NamedTuple):
    """A ``DensePredictor``: weights are [from, to], padded to the widest layer H; L hidden layers.

    Attributes:
        first: of (state, action) columns, [n_inputs, H] (L = 0: [n_inputs, n_columns]).
        inner: of hidden layers 1 ... L - 1, [max(L - 1, 0), H, H].
        bias: of the hidden layers, [L, H].
        sizes: of the hidden layers, int64 [L].
        last: of the output columns, [H, n_columns].
        last_bias: [n_columns].
        stay: the residual path's, [n_steps * A, n_state_columns]; zero where there is none.
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
    if code == RELU:  # in a loop of its own: several values at once then
        for h in range(n):
            values[h] = max(values[h], np.float32(0.0))
    elif code == TANH:
        for h in range(n):
            values[h] = math.tanh(values[h])
    else:
        for h in range(n):
            value = values[h]
            gate = np.float32(1.0) / (np.float32(1.0) + math.exp(-max(value, np.float32(-80.0))))
            values[h] = gate if code == SIGMOID else value * gate


@compiled
def active_columns(states: Ints, b: int, action: int, layout: Layout, out: Ints) -> int:
    """Writes the input columns of row b that are 1 to ``out`` [F + n_steps]; returns how many; the actions' come last."""
    n = 0
    for factor in range(states.shape[1]):
        value = states[b, factor]
        if layout.outputs[factor] != 2:
            out[n] = layout.start[factor] + value
            n += 1
        elif value == 1:
            out[n] = layout.start[factor]
            n += 1
    for step in range(layout.n_steps):
        out[n + step] = layout.n_state_columns + step * layout.n_actions + action % layout.n_actions
        action //= layout.n_actions
    return n + layout.n_steps


@compiled
def _add_residual(active: Ints, n_active: int, layout: Layout, stay: Floats32, columns: Floats32) -> None:
    """Adds what leads each state column to itself: its weight where it is 1, minus its weight where it is 0."""
    n_on = n_active - layout.n_steps
    for step in range(n_on, n_active):
        row = stay[active[step] - layout.n_state_columns]
        for column in range(layout.n_state_columns):
            columns[column] -= row[column]
        for a in range(n_on):
            columns[active[a]] += np.float32(2.0) * row[active[a]]


@compiled
def _add_row(table: Floats32, row: int, out: Floats32) -> None:
    for h in range(table.shape[1]):
        out[h] += table[row, h]


@compiled
def _add_products(values: Floats32, n_values: int, weights: Floats32, out: Floats32) -> None:
    """Adds ``values`` [n_values] times ``weights`` [n_values, K] to ``out`` [K]; four rows at a time, as ``add_columns``."""
    h = 0
    while h + 4 <= n_values:
        v0, v1, v2, v3 = values[h], values[h + 1], values[h + 2], values[h + 3]
        for k in range(weights.shape[1]):
            out[k] += (v0 * weights[h, k] + v1 * weights[h + 1, k]) + (v2 * weights[h + 2, k] + v3 * weights[h + 3, k])
        h += 4
    while h < n_values:
        for k in range(weights.shape[1]):
            out[k] += values[h] * weights[h, k]
        h += 1


@compiled
def _dense_columns(active: Ints, n_active: int, dense: DenseWeights, now: Floats32, after: Floats32, columns: Floats32) -> None:
    """The output columns of one row, without the residual path; ``now`` and ``after`` are work space [H]."""
    depth = len(dense.sizes)
    columns[:] = dense.last_bias
    if depth == 0:
        for a in range(n_active):
            _add_row(dense.first, active[a], columns)
        return
    now[:] = dense.bias[0]
    for a in range(n_active):
        _add_row(dense.first, active[a], now)
    _activate(now, dense.sizes[0], dense.activation)
    for level in range(1, depth):
        after[:] = dense.bias[level]
        _add_products(now, dense.sizes[level - 1], dense.inner[level - 1], after)
        _activate(after, dense.sizes[level], dense.activation)
        now[:] = after
    _add_products(now, dense.sizes[depth - 1], dense.last, columns)


@compiled
def dense_logits(states: Ints, actions: Ints, layout: Layout, dense: DenseWeights) -> Floats32:
    """A dense predictor's logits, float32 [B, O, K]; values a factor lacks are at -1e9."""
    n_outputs, width = len(layout.outputs), layout.outputs.max()
    logits = np.full((len(states), n_outputs, width), np.float32(-1e9), dtype=np.float32)
    active = np.empty(states.shape[1] + layout.n_steps, dtype=np.int64)
    now = np.empty(dense.last.shape[0], dtype=np.float32)
    after = np.empty_like(now)
    columns = np.empty(len(dense.last_bias), dtype=np.float32)
    for b in range(len(states)):
        n_active = active_columns(states, b, actions[b], layout, active)
        _dense_columns(active, n_active, dense, now, after, columns)
        _add_residual(active, n_active, layout, dense.stay, columns)
        for i in range(n_outputs):
            start = layout.start[i]
            if layout.outputs[i] == 2:
                logits[b, i, 0] = 0.0
                logits[b, i, 1] = columns[start]
            else:
                for k in range(layout.outputs[i]):
                    logits[b, i, k] = columns[start + k]
    return logits


@compiled
def probabilities(logits: Floats32, outputs: Ints) -> Floats:
    """Each factor's distribution, float64 [B, O, K], from logits [B, O, K]; 0 for values a factor lacks."""
    out = np.zeros(logits.shape, dtype=np.float64)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    row = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(logits.shape[0]):
        for i in range(logits.shape[1]):
            n = outputs[i]
            if n == 2:  # written out: a call costs ten times as much, and bits are the common case
                difference = np.float64(logits[b, i, 1]) - np.float64(logits[b, i, 0])
                small = math.exp(-abs(difference))
                large = 1.0 / (1.0 + small)
                out[b, i, 0] = small * large if difference > 0 else large
                out[b, i, 1] = large if difference > 0 else small * large
                continue
            for k in range(n):
                row_logits[k] = logits[b, i, k]
            softmax(row_logits, n, row)
            for k in range(n):
                out[b, i, k] = row[k]
    return out


@compiled
def softmax(logits: Floats32, n: int, out: Floats) -> None:
    """Writes the distribution over the first ``n`` values to ``out``."""
    if n == 2:  # one exponential instead of two: bits are the common case
        difference = np.float64(logits[1]) - np.float64(logits[0])
        small = math.exp(-abs(difference))
        large = 1.0 / (1.0 + small)
        out[0] = small * large if difference > 0 else large
        out[1] = large if difference > 0 else small * large
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
def largest(probs: Floats, b: int, i: int, n: int) -> int:
    """The likeliest of the ``n`` values of factor i in row b; the lowest of equals."""
    best = 0
    for k in range(1, n):
        if probs[b, i, k] > probs[b, i, best]:
            best = k
    return best


@compiled
def trusted(probs: Floats, b: int, i: int, layout: Layout, group: GroupWeights, certain: float) -> bool:
    """Whether factor i of row b is left to the predictor, which gives it the distributions ``probs`` [B, O, K]."""
    if group.group_of[i] < 0:
        return True
    return bool(probs[b, i, largest(probs, b, i, layout.outputs[i])] >= certain)


@compiled
def add_columns(table: Floats32, g: int, columns: Ints, n_columns: int, hidden: Floats32) -> None:
    """Adds to ``hidden`` [G] what group g gets from the first ``n_columns`` of ``columns``; ``table`` is [g, columns, G].

    Four columns at a time, which halves the time: ``hidden`` is read and written a quarter as often.
    """
    c = 0
    while c + 4 <= n_columns:
        c0, c1, c2, c3 = columns[c], columns[c + 1], columns[c + 2], columns[c + 3]
        for h in range(table.shape[2]):
            hidden[h] += (table[g, c0, h] + table[g, c1, h]) + (table[g, c2, h] + table[g, c3, h])
        c += 4
    while c < n_columns:
        column = columns[c]
        for h in range(table.shape[2]):
            hidden[h] += table[g, column, h]
        c += 1


@compiled
def add_weighted(table: Floats32, g: int, columns: Ints, n_columns: int, weights: Floats32, hidden: Floats32) -> None:
    """As ``add_columns``, each column times its entry of ``weights`` [columns]."""
    c = 0
    while c + 4 <= n_columns:
        c0, c1, c2, c3 = columns[c], columns[c + 1], columns[c + 2], columns[c + 3]
        w0, w1, w2, w3 = weights[c0], weights[c1], weights[c2], weights[c3]
        for h in range(table.shape[2]):
            hidden[h] += (w0 * table[g, c0, h] + w1 * table[g, c1, h]) + (w2 * table[g, c2, h] + w3 * table[g, c3, h])
        c += 4
    while c < n_columns:
        column = columns[c]
        for h in range(table.shape[2]):
            hidden[h] += weights[column] * table[g, column, h]
        c += 1


@compiled
def _product(hidden: Floats32, readout: Floats32, g: int, k: int) -> np.float32:
    """``hidden`` [G] times ``readout[g, :, k]``, in four sums, none of which waits for the others."""
    s0 = s1 = s2 = s3 = np.float32(0.0)
    h = 0
    while h + 4 <= len(hidden):
        s0 += hidden[h] * readout[g, h, k]
        s1 += hidden[h + 1] * readout[g, h + 1, k]
        s2 += hidden[h + 2] * readout[g, h + 2, k]
        s3 += hidden[h + 3] * readout[g, h + 3, k]
        h += 4
    while h < len(hidden):
        s0 += hidden[h] * readout[g, h, k]
        h += 1
    return (s0 + s1) + (s2 + s3)


@compiled
def finish(
    b: int,
    i: int,
    logits: Floats32,
    layout: Layout,
    group: GroupWeights,
    hidden: Floats32,
    row_logits: Floats32,
    out: Floats,
) -> None:
    """From the summed input of factor i's group (overwritten) to the factor's distribution ``out`` [K].

    ``logits`` [B, O, K] are the predictor's, ``row_logits`` [K] is work space.
    """
    n, g = layout.outputs[i], group.group_of[i]
    _activate(hidden, len(hidden), group.activation)
    for k in range(n):
        row_logits[k] = group.offset[g, k] + (logits[b, i, k] if group.correction else np.float32(0.0))
    for k in range(n):
        row_logits[k] += _product(hidden, group.readout, g, k)
    softmax(row_logits, n, out)
