"""Compiled row-by-row inference for the networks of ``networks.py``, and its inner loops.

Networks are trained by torch. Here, each row of a batch is computed separately, in a fixed order of operations, so a row's
result is bitwise the same alone and in any batch. Matrix products do not guarantee this. The first layer skips inputs that are
0.
Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, G hidden nodes in a group, g groups.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mbagent.models.systematic_sampling import largest
from mbagent.types import Floats, Ints
from mbagent_envs.jit import compiled, inlined, vectorised
from mbagent_envs.structs import Struct

Floats32 = NDArray[np.float32]

SIGMOID, RELU, SILU, TANH, LINEAR = 0, 1, 2, 3, 4
ACTIVATION_CODES = {"sigmoid": SIGMOID, "relu": RELU, "silu": SILU, "tanh": TANH}

_PER_LN2 = np.float32(1.44269504)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_HALF, _ONE_32, _TWO_32 = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LOWEST, _HIGHEST = np.float32(-87.0), np.float32(88.0)
_P0, _P1, _P2 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
_P3, _P4, _P5 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)


@compiled
def exp32(x: np.float32) -> np.float32:
    """exp(x) for x clipped to [-87, 88], with relative error 7e-8; unlike the library's function, this one can be vectorised.

    Computed as 2^n times a polynomial (as in ``expf`` of Moshier's Cephes library); n is written directly to the exponent bits.
    """
    x = _LOWEST if x < _LOWEST else x
    x = _HIGHEST if x > _HIGHEST else x
    n = np.floor(x * _PER_LN2 + _HALF)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
    power = np.int32((np.int32(n) + 127) << 23).view(np.float32)
    return np.float32(((series * r) * r + r + _ONE_32) * power)


_T0, _T1, _T2, _T3, _T4, _T5, _T6 = (1.0 / math.factorial(k) for k in range(7))
_T7, _T8, _T9, _T10, _T11, _T12, _T13 = (1.0 / math.factorial(k) for k in range(7, 14))
_WIDE_HIGH, _WIDE_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6


@compiled
def exp64(x: float) -> float:
    """Like ``exp32`` in double precision, only for x <= 0, relative error 4e-16; x below -708 is clipped to -708."""
    x = max(x, -708.0)
    n = np.floor(x * 1.4426950408889634 + 0.5)
    r = (x - n * _WIDE_HIGH) - n * _WIDE_LOW
    small = ((((((_T13 * r + _T12) * r + _T11) * r + _T10) * r + _T9) * r + _T8) * r + _T7) * r
    series = ((((((small + _T6) * r + _T5) * r + _T4) * r + _T3) * r + _T2) * r + _T1) * r + _T0
    return float(series * np.int64((np.int64(n) + 1023) << 52).view(np.float64))


@vectorised
def activate(table: Floats32, row: int, n: int, code: int) -> None:
    """Applies the activation given by ``code`` to the first ``n`` values of ``table[row]``, in place."""
    if code == RELU:
        for h in range(n):
            table[row, h] = max(table[row, h], np.float32(0.0))
    elif code == SILU:
        for h in range(n):
            table[row, h] = table[row, h] / (_ONE_32 + exp32(-table[row, h]))
    elif code == SIGMOID:
        for h in range(n):
            table[row, h] = _ONE_32 / (_ONE_32 + exp32(-table[row, h]))
    else:
        for h in range(n):
            table[row, h] = _ONE_32 - _TWO_32 / (_ONE_32 + exp32(_TWO_32 * table[row, h]))


@vectorised
def add_rows(table: Floats32, rows: Ints, n_rows: int, out: Floats32, row: int) -> None:
    """Adds to ``out[row]`` [G] the rows ``rows[:n_rows]`` of ``table`` [m, G]; see ``add_columns``."""
    c = 0
    while c + 4 <= n_rows:
        c0, c1, c2, c3 = rows[c], rows[c + 1], rows[c + 2], rows[c + 3]
        for h in range(table.shape[1]):
            out[row, h] += (table[c0, h] + table[c1, h]) + (table[c2, h] + table[c3, h])
        c += 4
    while c < n_rows:
        for h in range(table.shape[1]):
            out[row, h] += table[rows[c], h]
        c += 1


@vectorised
def add_products(values: Floats32, n_rows: int, n_values: int, weights: Floats32, out: Floats32) -> None:
    """``out`` [R, 4 * m] += ``values`` [R, H] @ ``weights`` [4 * m, H].T; first ``n_rows`` of R, ``n_values`` of H.

    Computes four sums at a time, so that ``values`` is read a quarter as often. All rows are processed while the weights of
    these sums are cached; a row's result does not depend on the other rows.
    """
    for k in range(0, weights.shape[0], 4):
        for r in range(n_rows):
            s0 = s1 = s2 = s3 = np.float32(0.0)
            for h in range(n_values):
                value = values[r, h]
                s0 += value * weights[k, h]
                s1 += value * weights[k + 1, h]
                s2 += value * weights[k + 2, h]
                s3 += value * weights[k + 3, h]
            out[r, k] += s0
            out[r, k + 1] += s1
            out[r, k + 2] += s2
            out[r, k + 3] += s3


@vectorised
def add_columns(table: Floats32, g: int, columns: Ints, n_columns: int, sums: Floats32, row: int) -> None:
    """Adds ``table[g, c]`` to ``sums[row]`` [G] for c in ``columns[:n_columns]``; ``table``: weights [g, columns, G].

    Processes four columns at a time, so that ``sums`` is read and written a quarter as often; this halves the running time.
    """
    c = 0
    while c + 4 <= n_columns:
        c0, c1, c2, c3 = columns[c], columns[c + 1], columns[c + 2], columns[c + 3]
        for h in range(table.shape[2]):
            sums[row, h] += (table[g, c0, h] + table[g, c1, h]) + (table[g, c2, h] + table[g, c3, h])
        c += 4
    while c < n_columns:
        column = columns[c]
        for h in range(table.shape[2]):
            sums[row, h] += table[g, column, h]
        c += 1


@vectorised
def add_scaled(table: Floats32, g: int, column: int, scale: np.float32, sums: Floats32, row: int) -> None:
    """Adds ``scale * table[g, column]`` to ``sums[row]`` [G]; ``table`` [g, columns, G] holds the groups' weights."""
    for h in range(table.shape[2]):
        sums[row, h] += scale * table[g, column, h]


@vectorised
def copy_row(table: Floats32, row: int, out: Floats32, out_row: int) -> None:
    """Copies ``table[row]`` to ``out[out_row]``, without slices, which are slower."""
    for h in range(table.shape[1]):
        out[out_row, h] = table[row, h]


@vectorised
def count_below(values: Floats, begin: int, end: int, limit: float, or_equal: bool) -> int:
    """Number of ``values[begin:end]`` that are < ``limit``, or <= ``limit`` if ``or_equal``."""
    n = 0
    if or_equal:
        for i in range(begin, end):
            n += int(values[i] <= limit)
    else:
        for i in range(begin, end):
            n += int(values[i] < limit)
    return n


@vectorised
def product(sums: Floats32, row: int, code: int, table: Floats32, g: int, k: int) -> np.float32:
    """Scalar product of the activated ``sums[row]`` [G] with ``table[g, k]`` [G]; ``code`` selects the activation."""
    total = np.float32(0.0)
    if code == RELU:
        for h in range(table.shape[2]):
            total += max(sums[row, h], np.float32(0.0)) * table[g, k, h]
    elif code == SILU:
        for h in range(table.shape[2]):
            total += sums[row, h] / (_ONE_32 + exp32(-sums[row, h])) * table[g, k, h]
    elif code == SIGMOID:
        for h in range(table.shape[2]):
            total += table[g, k, h] / (_ONE_32 + exp32(-sums[row, h]))
    elif code == TANH:
        for h in range(table.shape[2]):
            total += (_ONE_32 - _TWO_32 / (_ONE_32 + exp32(_TWO_32 * sums[row, h]))) * table[g, k, h]
    else:
        for h in range(table.shape[2]):
            total += sums[row, h] * table[g, k, h]
    return total


@inlined
def softmax(logits: Floats32, n: int, out: Floats) -> None:
    """Writes the softmax of the first ``n`` logits to ``out``."""
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


@vectorised
def write_bits(columns: Floats32, row: int, logits: Floats32, b: int) -> None:
    """Writes row b of ``logits`` [B, O, 2] from ``columns[row]``, if all factors are bits; the logit of value 0 is 0."""
    for i in range(logits.shape[1]):
        logits[b, i, 0] = np.float32(0.0)
        logits[b, i, 1] = columns[row, i]


@vectorised
def add_signed(states: Ints, b: int, weights: Floats32, row: int, out: Floats32, out_row: int) -> None:
    """For i < F, adds ``weights[row, i]`` to ``out[out_row, i]`` if bit ``states[b, i]`` is 1, else subtracts it."""
    for i in range(states.shape[1]):
        out[out_row, i] += np.float32(2 * states[b, i] - 1) * weights[row, i]


@vectorised
def _bit_probabilities(logits: Floats32, b: int, out: Floats) -> None:
    """Computes row b of ``probabilities`` if all factors are bits."""
    for i in range(logits.shape[1]):
        difference = np.float64(logits[b, i, 1]) - np.float64(logits[b, i, 0])
        small = exp64(-abs(difference))
        large = 1.0 / (1.0 + small)
        small *= large
        out[b, i, 0] = small if difference > 0 else large
        out[b, i, 1] = large if difference > 0 else small


@compiled
def probabilities(logits: Floats32, outputs: Ints) -> Floats:
    """Each factor's distribution, float64 [B, O, K], from logits [B, O, K]; 0 for values that a factor does not have."""
    out = np.zeros(logits.shape, dtype=np.float64)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    row = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(logits.shape[0]):
        if logits.shape[2] == 2:
            _bit_probabilities(logits, b, out)
            continue
        for i in range(logits.shape[1]):
            n = outputs[i]
            for k in range(n):
                row_logits[k] = logits[b, i, k]
            softmax(row_logits, n, row)
            for k in range(n):
                out[b, i, k] = row[k]
    return out


KERNEL_ROWS = 32
"""Rows of a batch to which each layer of a predictor is applied while its weights are cached."""


class Layout(Struct):
    """Layout of factors among columns.

    Attributes:
        outputs: cardinalities of the output factors, int64 [O]; the first F are those of the state factors.
        start: first column of each output factor, int64 [O].
        n_state_columns: number of columns of the state; those of the action follow.
        n_actions: number of actions A of a single step.
        n_steps: number of actions in a string; see ``FactorCodec``.
    """

    outputs: Ints
    start: Ints
    n_state_columns: int
    n_actions: int
    n_steps: int


class DenseWeights(Struct):
    """A ``DensePredictor``'s arrays: L hidden layers of padded size <= H; C output columns, padded to a multiple of 4.

    Attributes:
        layout: the factors.
        first: weights from the (state, action) columns, [n_inputs, H]; if L = 0, [n_inputs, C].
        inner: weights between successive hidden layers, [max(L - 1, 0), H, H]; axis 1: nodes of the later layer.
        bias: biases of the hidden layers, [L, H].
        sizes: padded sizes of the hidden layers, multiples of ``export.LANES``, int64 [L].
        to_columns: weights to the output columns, [C, H].
        column_bias: [C].
        stay: weights of the residual path, [n_steps * A, n_state_columns]; zero if there is none.
        n_columns: number of output columns without padding.
        activation: one of the codes in ACTIVATION_CODES.
    """

    layout: Layout
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
        """Transpose of ``to_columns`` without padded rows, [H, n_columns]."""
        return self.to_columns[: self.n_columns].T

    @property
    def last_bias(self) -> Floats32:
        """``column_bias`` without padding, [n_columns]."""
        return self.column_bias[: self.n_columns]


class GroupWeights(Struct):
    """A ``Conditioner`` with g groups.

    Attributes:
        layout: the factors.
        group_of: group of each output factor, -1 if it has none, int64 [O].
        columns: weights from all columns, [g, n_inputs + n_columns + n_state_columns, G]: first those from state and action,
            then those from the next factors (zero where masked or pruned), then the sum of each state column's two weights, used
            if the column is 1 in both the state and the next state. Most columns are equal in the two states, so these sums save
            additions.
        bias: [g, G].
        to_values: weights to the logits of the group's factor, [g, K, G]; the logit of a bit's value 0 is 0.
        offset: [g, K].
        next_start: index of the first column of the next factors, n_inputs.
        both_start: index of the first of the summed weights in ``columns``, n_inputs + n_columns.
        activation: one of the codes in ACTIVATION_CODES.
        correction: whether the predictor's logits are added.
    """

    layout: Layout
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
        """Weights from (state, action) columns, [g, n_inputs, G]."""
        return self.columns[:, : self.next_start]

    @property
    def others(self) -> Floats32:
        """Weights from the next factors' columns, [g, n_columns, G]."""
        return self.columns[:, self.next_start : self.both_start]

    @property
    def readout(self) -> Floats32:
        """``to_values`` as [g, G, K]."""
        return self.to_values.transpose(0, 2, 1)


class Rows(Struct):
    """A batch, with the predictor's results.

    Attributes:
        states: int64 [B, F].
        actions: int64 [B].
        logits: float32 [B, O, K].
        probs: float64 [B, O, K].
    """

    states: Ints
    actions: Ints
    logits: Floats32
    probs: Floats


@inlined
def active_columns(states: Ints, b: int, action: int, layout: Layout, out: Ints) -> int:
    """Writes to ``out`` [F + n_steps] indices of row b's input columns that are 1, actions last; returns the count."""
    n = 0
    for factor in range(states.shape[1]):
        value = states[b, factor]
        if layout.outputs[factor] != 2:
            out[n] = layout.start[factor] + value
            n += 1
        else:  # without a branch, which would be unpredictable
            out[n] = layout.start[factor]
            n += value
    for step in range(layout.n_steps):
        out[n + step] = layout.n_state_columns + step * layout.n_actions + action % layout.n_actions
        action //= layout.n_actions
    return n + layout.n_steps


@inlined
def add_next(states: Ints, b: int, i: int, value: int, group: GroupWeights, columns: Ints, n: int, place: int) -> int:
    """Adds factor i's next-value column to ``columns``, the list from ``active_columns``; returns its new length.

    ``place`` is the list index of the factor's state column that is 1, if any; if the value is unchanged, only this entry
    changes. Uses no branches, since they would be unpredictable.
    """
    column, on = group.layout.start[i], 1
    if group.layout.outputs[i] == 2:
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
    """Index of factor i + 1 in the ``active_columns`` list if it has a column that is 1; ``place``: factor i's index."""
    if i < states.shape[1]:
        place += 1 if layout.outputs[i] != 2 else states[b, i]
    return place


@inlined
def _add_residual(states: Ints, b: int, active: Ints, n_active: int, dense: DenseWeights, columns: Floats32, r: int) -> None:
    """Adds the residual path: for each state column, plus its weight if the column is 1, minus its weight if the column is 0."""
    layout, stay, n_on = dense.layout, dense.stay, n_active - dense.layout.n_steps
    for step in range(n_on, n_active):
        row = active[step] - layout.n_state_columns
        if layout.n_state_columns == states.shape[1]:  # all are bits
            add_signed(states, b, stay, row, columns, r)
            continue
        for column in range(layout.n_state_columns):
            columns[r, column] -= stay[row, column]
        for a in range(n_on):
            columns[r, active[a]] += np.float32(2.0) * stay[row, active[a]]


class DenseWork(Struct):
    """Work space for a block of R rows.

    Attributes:
        active: indices of one row's input columns that are 1, int64 [F + n_steps].
        now: values of a hidden layer, [R, H].
        after: values of the next layer, [R, H].
        columns: output columns, [R, C].
    """

    active: Ints
    now: Floats32
    after: Floats32
    columns: Floats32


@inlined
def _dense_block(first: int, n_rows: int, states: Ints, actions: Ints, dense: DenseWeights, work: DenseWork) -> None:
    """Computes ``work.columns`` of ``n_rows`` rows from ``first``."""
    depth, now, after, columns = len(dense.sizes), work.now, work.after, work.columns
    for r in range(n_rows):
        b = first + r
        n_active = active_columns(states, b, actions[b], dense.layout, work.active)
        for column in range(columns.shape[1]):
            columns[r, column] = dense.column_bias[column]
        _add_residual(states, b, work.active, n_active, dense, columns, r)
        if depth == 0:
            add_rows(dense.first, work.active, n_active, columns, r)
            continue
        copy_row(dense.bias, 0, now, r)
        add_rows(dense.first, work.active, n_active, now, r)
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


def dense_logits(states: Ints, actions: Ints, dense: DenseWeights) -> Floats32:
    """A dense predictor's logits, float32 [B, O, K]; -1e9 for values that a factor does not have."""
    outputs, rows = dense.layout.outputs, min(len(states), KERNEL_ROWS)
    logits = np.full((len(states), len(outputs), outputs.max()), np.float32(-1e9), dtype=np.float32)
    now = np.empty((rows, dense.to_columns.shape[1]), dtype=np.float32)
    work = DenseWork(
        np.empty(states.shape[1] + dense.layout.n_steps, dtype=np.int64),
        now,
        np.empty_like(now),
        np.empty((rows, len(dense.column_bias)), dtype=np.float32),
    )
    _write_logits(states, actions, dense, work, logits)
    return logits


@compiled
def _write_logits(states: Ints, actions: Ints, dense: DenseWeights, work: DenseWork, logits: Floats32) -> None:
    layout, columns = dense.layout, work.columns
    for first in range(0, len(states), KERNEL_ROWS):
        n_rows = min(KERNEL_ROWS, len(states) - first)
        _dense_block(first, n_rows, states, actions, dense, work)
        for r in range(n_rows):
            if logits.shape[2] == 2:
                write_bits(columns, r, logits, first + r)
                continue
            for i in range(logits.shape[1]):
                start = layout.start[i]
                if layout.outputs[i] == 2:
                    logits[first + r, i, 0] = 0.0
                    logits[first + r, i, 1] = columns[r, start]
                else:
                    for k in range(layout.outputs[i]):
                        logits[first + r, i, k] = columns[r, start + k]


@inlined
def trusted(rows: Rows, b: int, i: int, group: GroupWeights, certain: float) -> bool:
    """Whether to trust the predictor for row b's factor i: it has no group, or a value of probability at least ``certain``."""
    if group.group_of[i] < 0:
        return True
    return bool(rows.probs[b, i, largest(rows.probs, b, i, group.layout.outputs[i])] >= certain)


class FactorWork(Struct):
    """Work space for one factor.

    Attributes:
        hidden: values of its group's hidden nodes, [1, G].
        logits: its logits, [K].
        given: its distribution, [K].
    """

    hidden: Floats32
    logits: Floats32
    given: Floats


def factor_work(group: GroupWeights) -> FactorWork:
    """Work space for a factor of any group."""
    _, n_values, size = group.to_values.shape
    return FactorWork(np.empty((1, size), dtype=np.float32), np.empty(n_values, dtype=np.float32), np.empty(n_values))


@inlined
def finish(b: int, i: int, rows: Rows, group: GroupWeights, sums: Floats32, row: int, work: FactorWork) -> None:
    """Computes the distribution ``work.given`` of row b's factor i from the summed input ``sums[row]`` [G] of its group."""
    n, g, code, hidden, logits = group.layout.outputs[i], group.group_of[i], group.activation, work.hidden, work.logits
    if n > 2:  # each node's activation once, for all values
        for h in range(hidden.shape[1]):
            hidden[0, h] = sums[row, h]
        activate(hidden, 0, hidden.shape[1], code)
        for k in range(n):
            logits[k] = group.offset[g, k] + product(hidden, 0, LINEAR, group.to_values, g, k)
    else:
        logits[0] = 0.0
        logits[1] = group.offset[g, 1] + product(sums, row, code, group.to_values, g, 1)
    if group.correction:
        for k in range(n):
            logits[k] += rows.logits[b, i, k]
    softmax(logits, n, work.given)
