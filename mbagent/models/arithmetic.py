"""The small loops that compiled inference spends its time in, on several numbers at once.

Each works on one row of a batch, always in the same order of operations: so a row's result is the same to the last bit alone and
in any batch, which matrix products do not promise. Shapes: K values, G hidden nodes, g groups.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mbagent_envs._compiled import compiled, inlined, vectorised

Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIGMOID, RELU, SILU, TANH, LINEAR = 0, 1, 2, 3, 4
ACTIVATION_CODES = {"sigmoid": SIGMOID, "relu": RELU, "silu": SILU, "tanh": TANH}

_PER_LN2 = np.float32(1.44269504)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LOWEST, _HIGHEST = np.float32(-87.0), np.float32(88.0)
_P0, _P1, _P2 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
_P3, _P4, _P5 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)


@compiled
def exp32(x: np.float32) -> np.float32:
    """e^x to 7e-8 of its size, for x from -87 to 88 and as at these ends beyond: of the library's function no vectors are made.

    2^n times a polynomial (Moshier's Cephes library, ``expf``); n goes straight to the exponent's place among the bits.
    """
    x = _LOWEST if x < _LOWEST else x
    x = _HIGHEST if x > _HIGHEST else x
    n = np.floor(x * _PER_LN2 + _HALF)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
    power = np.int32((np.int32(n) + 127) << 23).view(np.float32)
    return np.float32(((series * r) * r + r + _ONE) * power)


_T0, _T1, _T2, _T3, _T4, _T5, _T6 = (1.0 / math.factorial(k) for k in range(7))
_T7, _T8, _T9, _T10, _T11, _T12, _T13 = (1.0 / math.factorial(k) for k in range(7, 14))
_WIDE_HIGH, _WIDE_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6


@compiled
def exp64(x: float) -> float:
    """As ``exp32`` in double precision, to 4e-16 of its size, for x from -708 to 0; below as at -708."""
    x = max(x, -708.0)
    n = np.floor(x * 1.4426950408889634 + 0.5)
    r = (x - n * _WIDE_HIGH) - n * _WIDE_LOW
    small = ((((((_T13 * r + _T12) * r + _T11) * r + _T10) * r + _T9) * r + _T8) * r + _T7) * r
    series = ((((((small + _T6) * r + _T5) * r + _T4) * r + _T3) * r + _T2) * r + _T1) * r + _T0
    return float(series * np.int64((np.int64(n) + 1023) << 52).view(np.float64))


@vectorised
def activate(table: Floats32, row: int, n: int, code: int) -> None:
    """Applies the activation of this code to the first ``n`` values of ``table[row]``, in place."""
    if code == RELU:
        for h in range(n):
            table[row, h] = max(table[row, h], np.float32(0.0))
    elif code == SILU:
        for h in range(n):
            table[row, h] = table[row, h] / (_ONE + exp32(-table[row, h]))
    elif code == SIGMOID:
        for h in range(n):
            table[row, h] = _ONE / (_ONE + exp32(-table[row, h]))
    else:
        for h in range(n):
            table[row, h] = _ONE - _TWO / (_ONE + exp32(_TWO * table[row, h]))


@vectorised
def add_rows(table: Floats32, rows: Ints, n_rows: int, out: Floats32, row: int) -> None:
    """Adds the first ``n_rows`` of ``rows`` of ``table`` [rows, G] to ``out[row]`` [G]; see ``add_columns``."""
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
    """Adds ``weights`` [4 * m, H] times the first ``n_values`` of ``values`` [R, H] to ``n_rows`` rows of ``out`` [R, 4 * m].

    Four sums at a time: each of ``values`` is read a quarter as often. All rows one after another with the same weights, while
    these are at hand; what is computed of a row does not depend on that.
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
    """Adds to ``sums[row]`` [G] what group g gets from the first ``n_columns`` of ``columns``; ``table`` is [g, columns, G].

    Four columns at a time, which halves the time: ``sums`` is read and written a quarter as often.
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
    """Adds to ``sums[row]`` [G] what group g gets from one column of ``table`` [g, columns, G], times ``scale``."""
    for h in range(table.shape[2]):
        sums[row, h] += scale * table[g, column, h]


@vectorised
def copy_row(table: Floats32, row: int, out: Floats32, out_row: int) -> None:
    """Copies ``table[row]`` to ``out[out_row]``, without slices, which cost more."""
    for h in range(table.shape[1]):
        out[out_row, h] = table[row, h]


@vectorised
def count_below(values: Floats, begin: int, end: int, limit: float, or_equal: bool) -> int:
    """How many of ``values[begin:end]`` are below a limit, or equal to it."""
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
    """The activations of ``sums[row]`` [G] times ``table[g, k]`` [G]."""
    total = np.float32(0.0)
    if code == RELU:
        for h in range(table.shape[2]):
            total += max(sums[row, h], np.float32(0.0)) * table[g, k, h]
    elif code == SILU:
        for h in range(table.shape[2]):
            total += sums[row, h] / (_ONE + exp32(-sums[row, h])) * table[g, k, h]
    elif code == SIGMOID:
        for h in range(table.shape[2]):
            total += table[g, k, h] / (_ONE + exp32(-sums[row, h]))
    elif code == TANH:
        for h in range(table.shape[2]):
            total += (_ONE - _TWO / (_ONE + exp32(_TWO * sums[row, h]))) * table[g, k, h]
    else:
        for h in range(table.shape[2]):
            total += sums[row, h] * table[g, k, h]
    return total


@inlined
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


@vectorised
def write_bits(columns: Floats32, row: int, logits: Floats32, b: int) -> None:
    """Writes row b of ``logits`` [B, O, 2] where all factors are bits, from ``columns[row]`` [O or more]; the logit of 0 is 0."""
    for i in range(logits.shape[1]):
        logits[b, i, 0] = np.float32(0.0)
        logits[b, i, 1] = columns[row, i]


@vectorised
def add_signed(states: Ints, b: int, weights: Floats32, row: int, out: Floats32, out_row: int) -> None:
    """Adds ``weights[row]`` [F] to ``out[out_row]`` where the bits ``states[b]`` [F] are 1, and subtracts it where they are 0."""
    for i in range(states.shape[1]):
        out[out_row, i] += np.float32(2 * states[b, i] - 1) * weights[row, i]


@vectorised
def _bit_probabilities(logits: Floats32, b: int, out: Floats) -> None:
    """Row b of ``probabilities`` where all factors are bits."""
    for i in range(logits.shape[1]):
        difference = np.float64(logits[b, i, 1]) - np.float64(logits[b, i, 0])
        small = exp64(-abs(difference))
        large = 1.0 / (1.0 + small)
        small *= large
        out[b, i, 0] = small if difference > 0 else large
        out[b, i, 1] = large if difference > 0 else small


@compiled
def probabilities(logits: Floats32, outputs: Ints) -> Floats:
    """Each factor's distribution, float64 [B, O, K], from logits [B, O, K]; 0 for values a factor lacks."""
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
