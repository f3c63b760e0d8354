"""The samplers made of predictor and conditioner (paper 3.1 and 3.2), compiled; every row draws from its own key.

Three ways to an outcome: each factor by itself (no conditioner), ancestral (conditioner masked to y_<i; exact), and
the paper's sweeps (conditioner masked to all but y_i; in ``sweeps.py``). Shapes: B batch, F state factors, O output
factors, K largest cardinality. Array rows are addressed by index, not sliced: a slice costs more than what is done with it here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.arithmetic import Floats, Floats32, Ints, add_columns, copy_row
from mbagent.models.kernels import (
    GroupWeights,
    Layout,
    active_columns,
    add_next,
    finish,
    largest,
    next_place,
    trusted,
)
from mbagent_envs._compiled import borrowed, compiled, inlined
from mbagent_envs.random_keys import fill_row, uniform_at

Keys = NDArray[np.uint64]


class Work(NamedTuple):
    """Work space for one row.

    Attributes:
        columns: those that are on, int64 [2 * O + n_steps].
        luck: a number for each factor, [O].
        sums: input of one group, [1, G].
        row_logits: of one factor, [K].
        given: its distribution, [K].
    """

    columns: Ints
    luck: Floats
    sums: Floats32
    row_logits: Floats32
    given: Floats


@compiled
def work_space(layout: Layout, group: GroupWeights) -> Work:
    """Room for one row of a model of this shape."""
    n_outputs, size, n_values = len(layout.outputs), group.bias.shape[1], group.offset.shape[1]
    return Work(
        np.empty(2 * n_outputs + layout.n_steps, dtype=np.int64),
        np.empty(n_outputs, dtype=np.float64),
        np.empty((1, size), dtype=np.float32),
        np.empty(n_values, dtype=np.float32),
        np.empty(n_values, dtype=np.float64),
    )


@inlined
def draw(values: Floats, n: int, u: float) -> int:
    """Index drawn from the first ``n`` values, which sum to one: the inverse of their running sum at ``u`` in [0, 1)."""
    chosen = 0
    for k in range(n):
        if values[k] > 0.0:
            chosen = k
            u -= values[k]
            if u < 0.0:
                break
    return chosen


@inlined
def draw_at(probs: Floats, b: int, i: int, n: int, u: float) -> int:
    """As ``draw``, from ``probs[b, i]``."""
    chosen = 0
    for k in range(n):
        if probs[b, i, k] > 0.0:
            chosen = k
            u -= probs[b, i, k]
            if u < 0.0:
                break
    return chosen


@inlined
def _likeliest(values: Floats, n: int) -> int:
    """Index of the largest of the first ``n`` values; the lowest of equals."""
    best = 0
    for k in range(1, n):
        if values[k] > values[best]:
            best = k
    return best


@compiled
def sample_independent(probs: Floats, outputs: Ints, keys: Keys) -> Ints:
    """Draws int64 [B, O]: factor i of row b at number i of key b."""
    factors = np.empty(probs.shape[:2], dtype=np.int64)
    for b in range(probs.shape[0]):
        for i in range(probs.shape[1]):
            u = uniform_at(keys[b], i)
            if outputs[i] == 2:  # written out: bits are the common case
                factors[b, i] = 1 if u >= probs[b, i, 0] and probs[b, i, 1] > 0.0 else 0
            else:
                factors[b, i] = draw_at(probs, b, i, outputs[i], u)
    return factors


@compiled
def sample_causal(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    keys: Keys,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    greedy: bool,
) -> Ints:
    """Ancestral draws int64 [B, O]: y_0, then y_1 given it, and so on; ``greedy`` takes the likeliest each time instead.

    A factor whose likeliest value has at least ``certain`` in the predictor's eyes, or that has no group in the
    conditioner, is drawn from the predictor. This is part of the model: ``log_prob_causal`` follows the same rule, so
    both stay exact.

    Args:
        states: int64 [B, F].
        actions: int64 [B].
        logits: the predictor's, float32 [B, O, K].
        probs: the predictor's, float64 [B, O, K].
        keys: uint64 [B].
        layout: the factors.
        group: the conditioner, masked "causal".
        certain: as said above.
        greedy: as said above.
    """
    factors = np.empty((len(states), len(layout.outputs)), dtype=np.int64)
    work = work_space(layout, group)
    for b in range(len(states)):
        _causal_row(b, states, actions[b], logits, probs, keys[b], layout, group, certain, greedy, work, factors)
    return factors


@compiled
def _causal_row(
    b: int,
    states: Ints,
    action: int,
    logits: Floats32,
    probs: Floats,
    key: np.uint64,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    greedy: bool,
    work: Work,
    factors: Ints,
) -> None:
    """Row b of ``sample_causal``, to ``factors`` [B, O]."""
    # The caller keeps all of this alive: no references need be counted for every factor.
    states, logits, probs, factors = borrowed(states), borrowed(logits), borrowed(probs), borrowed(factors)
    layout, group, w = borrowed(layout), borrowed(group), borrowed(work)
    fill_row(key, w.luck)
    n_columns, place = active_columns(states, b, action, layout, w.columns), 0
    for i in range(len(layout.outputs)):
        n, u = layout.outputs[i], w.luck[i]
        if trusted(probs, b, i, layout, group, certain):
            if n == 2:  # written out, as in sample_independent
                value = int((0.5 if greedy else u) >= probs[b, i, 0] and probs[b, i, 1] > 0.0)
            else:
                value = largest(probs, b, i, n) if greedy else draw_at(probs, b, i, n, u)
        else:
            _condition(b, i, logits, layout, group, n_columns, w)
            value = _likeliest(w.given, n) if greedy else draw(w.given, n, u)
        factors[b, i] = value
        n_columns = add_next(states, b, i, value, layout, group, w.columns, n_columns, place)
        place = next_place(states, b, i, layout, place)


@inlined
def _condition(b: int, i: int, logits: Floats32, layout: Layout, group: GroupWeights, n_columns: int, w: Work) -> None:
    """Writes factor i's distribution, given the columns that are on, to ``w.given``."""
    g = group.group_of[i]
    copy_row(group.bias, g, w.sums, 0)
    add_columns(group.columns, g, w.columns, n_columns, w.sums, 0)
    finish(b, i, logits, layout, group, w.sums, 0, w.sums, w.row_logits, w.given)


@compiled
def log_prob_causal(
    states: Ints,
    actions: Ints,
    factors: Ints,
    logits: Floats32,
    probs: Floats,
    layout: Layout,
    group: GroupWeights,
    certain: float,
) -> Floats:
    """Log-probability [B] of the outcomes ``factors`` [B, O] under exactly what ``sample_causal`` draws."""
    result, work = np.zeros(len(states), dtype=np.float64), work_space(layout, group)
    for b in range(len(states)):
        n_columns, place = active_columns(states, b, actions[b], layout, work.columns), 0
        for i in range(len(layout.outputs)):
            value = factors[b, i]
            probability = probs[b, i, value]
            if not trusted(probs, b, i, layout, group, certain):
                _condition(b, i, logits, layout, group, n_columns, work)
                probability = work.given[value]
            result[b] += math.log(probability) if probability > 0.0 else -np.inf
            n_columns = add_next(states, b, i, value, layout, group, work.columns, n_columns, place)
            place = next_place(states, b, i, layout, place)
    return result
