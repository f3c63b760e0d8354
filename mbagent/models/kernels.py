"""Compiled inference: the networks of ``networks.py`` evaluated row by row (``samplers.py`` draws with them).

Torch trains; here each row is computed by itself, in one fixed order of operations. So a row's result is the same
to the last bit alone and in any batch, which matrix products do not promise, and inputs that are 0 cost nothing.
Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, G hidden nodes in a group.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.models.arithmetic import (
    LINEAR,
    Floats,
    Floats32,
    Ints,
    activate,
    add_products,
    add_rows,
    add_signed,
    copy_row,
    product,
    softmax,
    write_bits,
)
from mbagent_envs._compiled import compiled, inlined

ROWS = 32
"""Rows of a batch that a predictor's layers are applied to one after another, with the same weights at hand."""


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
    """A ``DensePredictor``: L hidden layers, padded to the widest of them, H; C output columns, padded to a multiple of four.

    Attributes:
        first: from (state, action) columns, [n_inputs, H] (L = 0: [n_inputs, C]).
        inner: to hidden layers 1 ... L - 1 from those before, [max(L - 1, 0), H to, H from].
        bias: of the hidden layers, [L, H].
        sizes: of the hidden layers with padding, a multiple of ``packing.LANES``, int64 [L].
        to_columns: to the output columns, [C, H].
        column_bias: [C].
        stay: the residual path's, [n_steps * A, n_state_columns]; zero where there is none.
        n_columns: output columns without padding.
        activation: one of the codes of ``arithmetic.py``.
    """

    first: Floats32
    inner: Floats32
    bias: Floats32
    sizes: Ints
    to_columns: Floats32
    column_bias: Floats32
    stay: Floats32
    n_columns: int
    activation: int

    @property
    def last(self) -> Floats32:
        """``to_columns`` without padding, [H, n_columns]."""
        return self.to_columns[: self.n_columns].T

    @property
    def last_bias(self) -> Floats32:
        """``column_bias`` without padding, [n_columns]."""
        return self.column_bias[: self.n_columns]


class GroupWeights(NamedTuple):
    """A ``Conditioner`` with g groups.

    Attributes:
        group_of: group of each output factor, -1 where it has none, int64 [O].
        columns: weights from all columns, [g, n_inputs + n_columns + n_state_columns, G]: of state and action, of the next
            factors (zero where pruned), and of the state's columns that are on in the state and in the next one, too. Most
            columns are alike in both: one addition does for two then.
        bias: [g, G].
        to_values: to the logits of the group's factor, [g, K, G]; of a bit, the logit of 0 is 0.
        offset: [g, K].
        next_start: place of the next factors' columns, n_inputs.
        both_start: place of those that are on in both, n_inputs + n_columns.
        activation: one of the codes of ``arithmetic.py``.
        correction: whether the predictor's logits are added.
    """

    group_of: Ints
    columns: Floats32
    bias: Floats32
    to_values: Floats32
    offset: Floats32
    next_start: int
    both_start: int
    activation: int
    correction: bool

    @property
    def inputs(self) -> Floats32:
        """From (state, action) columns, [g, n_inputs, G]."""
        return self.columns[:, : self.next_start]

    @property
    def others(self) -> Floats32:
        """From the next factors' columns, [g, n_columns, G]."""
        return self.columns[:, self.next_start : self.both_start]

    @property
    def readout(self) -> Floats32:
        """``to_values`` as [g, G, K]."""
        return self.to_values.transpose(0, 2, 1)


@inlined
def active_columns(states: Ints, b: int, action: int, layout: Layout, out: Ints) -> int:
    """Writes the input columns of row b that are 1 to ``out`` [F + n_steps]; returns how many; the actions' come last."""
    n = 0
    for factor in range(states.shape[1]):
        value = states[b, factor]
        if layout.outputs[factor] != 2:
            out[n] = layout.start[factor] + value
            n += 1
        else:  # without a branch: bits cannot be foretold
            out[n] = layout.start[factor]
            n += value
    for step in range(layout.n_steps):
        out[n + step] = layout.n_state_columns + step * layout.n_actions + action % layout.n_actions
        action //= layout.n_actions
    return n + layout.n_steps


@inlined
def add_next(
    states: Ints, b: int, i: int, value: int, layout: Layout, group: GroupWeights, columns: Ints, n: int, place: int
) -> int:
    """Adds what a group sees of factor i's next value to the list ``columns`` of ``active_columns``; returns its new length.

    ``place`` is where the list has the state's column of the factor, if that is on. Written without branches: bits cannot be
    foretold.
    """
    column, on = layout.start[i], 1
    if layout.outputs[i] == 2:
        on = value
    else:
        column += value
    same = 0
    if i < states.shape[1]:
        same = on * int(states[b, i] == value)
    columns[place] += same * group.both_start
    columns[n] = group.next_start + column
    return n + on - same


@inlined
def next_place(states: Ints, b: int, i: int, layout: Layout, place: int) -> int:
    """Place among ``active_columns`` of the factor after i, if its column is on, from that of factor i."""
    if i < states.shape[1]:
        place += 1 if layout.outputs[i] != 2 else states[b, i]
    return place


@inlined
def _add_residual(
    states: Ints, b: int, active: Ints, n_active: int, layout: Layout, stay: Floats32, columns: Floats32, r: int
) -> None:
    """Adds what leads each state column to itself: its weight where it is 1, minus its weight where it is 0."""
    n_on = n_active - layout.n_steps
    for step in range(n_on, n_active):
        row = active[step] - layout.n_state_columns
        if layout.n_state_columns == states.shape[1]:  # all are bits
            add_signed(states, b, stay, row, columns, r)
            continue
        for column in range(layout.n_state_columns):
            columns[r, column] -= stay[row, column]
        for a in range(n_on):
            columns[r, active[a]] += np.float32(2.0) * stay[row, active[a]]


@inlined
def _dense_block(
    first: int,
    n_rows: int,
    states: Ints,
    actions: Ints,
    layout: Layout,
    dense: DenseWeights,
    active: Ints,
    now: Floats32,
    after: Floats32,
    columns: Floats32,
) -> None:
    """The output columns [R, C] of rows from ``first`` on; ``active``, ``now`` and ``after`` [R, H] are work space."""
    depth = len(dense.sizes)
    for r in range(n_rows):
        b = first + r
        n_active = active_columns(states, b, actions[b], layout, active)
        for column in range(columns.shape[1]):
            columns[r, column] = dense.column_bias[column]
        _add_residual(states, b, active, n_active, layout, dense.stay, columns, r)
        if depth == 0:
            add_rows(dense.first, active, n_active, columns, r)
            continue
        copy_row(dense.bias, 0, now, r)
        add_rows(dense.first, active, n_active, now, r)
        activate(now, r, dense.sizes[0], dense.activation)
    for level in range(1, depth):
        for r in range(n_rows):
            copy_row(dense.bias, level, after, r)
        add_products(now, n_rows, dense.sizes[level - 1], dense.inner[level - 1], after)
        for r in range(n_rows):
            activate(after, r, dense.sizes[level], dense.activation)
        now[:] = after
    if depth:
        add_products(now, n_rows, dense.sizes[depth - 1], dense.to_columns, columns)


@compiled
def dense_logits(states: Ints, actions: Ints, layout: Layout, dense: DenseWeights) -> Floats32:
    """A dense predictor's logits, float32 [B, O, K]; values a factor lacks are at -1e9."""
    n_outputs, width = len(layout.outputs), layout.outputs.max()
    logits = np.full((len(states), n_outputs, width), np.float32(-1e9), dtype=np.float32)
    rows = min(len(states), ROWS)
    active = np.empty(states.shape[1] + layout.n_steps, dtype=np.int64)
    now = np.empty((rows, dense.to_columns.shape[1]), dtype=np.float32)
    after = np.empty_like(now)
    columns = np.empty((rows, len(dense.column_bias)), dtype=np.float32)
    for first in range(0, len(states), ROWS):
        n_rows = min(ROWS, len(states) - first)
        _dense_block(first, n_rows, states, actions, layout, dense, active, now, after, columns)
        for r in range(n_rows):
            if width == 2:
                write_bits(columns, r, logits, first + r)
                continue
            for i in range(n_outputs):
                start = layout.start[i]
                if layout.outputs[i] == 2:
                    logits[first + r, i, 0] = 0.0
                    logits[first + r, i, 1] = columns[r, start]
                else:
                    for k in range(layout.outputs[i]):
                        logits[first + r, i, k] = columns[r, start + k]
    return logits


@inlined
def largest(probs: Floats, b: int, i: int, n: int) -> int:
    """The likeliest of the ``n`` values of factor i in row b; the lowest of equals."""
    best = 0
    for k in range(1, n):
        if probs[b, i, k] > probs[b, i, best]:
            best = k
    return best


@inlined
def trusted(probs: Floats, b: int, i: int, layout: Layout, group: GroupWeights, certain: float) -> bool:
    """Whether factor i of row b is left to the predictor, which gives it the distributions ``probs`` [B, O, K]."""
    if group.group_of[i] < 0:
        return True
    return bool(probs[b, i, largest(probs, b, i, layout.outputs[i])] >= certain)


@inlined
def finish(
    b: int,
    i: int,
    logits: Floats32,
    layout: Layout,
    group: GroupWeights,
    sums: Floats32,
    row: int,
    hidden: Floats32,
    row_logits: Floats32,
    out: Floats,
) -> None:
    """From the summed input ``sums[row]`` [G] of factor i's group to the factor's distribution ``out`` [K].

    ``logits`` [B, O, K] are the predictor's; ``hidden`` [1, G] and ``row_logits`` [K] are work space.
    """
    n, g, code = layout.outputs[i], group.group_of[i], group.activation
    if n > 2:  # each node once, for all values
        for h in range(hidden.shape[1]):
            hidden[0, h] = sums[row, h]
        activate(hidden, 0, hidden.shape[1], code)
        for k in range(n):
            row_logits[k] = group.offset[g, k] + product(hidden, 0, LINEAR, group.to_values, g, k)
    else:
        row_logits[0] = 0.0
        row_logits[1] = group.offset[g, 1] + product(sums, row, code, group.to_values, g, 1)
    if group.correction:
        for k in range(n):
            row_logits[k] += logits[b, i, k]
    softmax(row_logits, n, out)
