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

from mbagent.models.kernels import (
    Floats,
    Floats32,
    GroupWeights,
    Ints,
    Layout,
    active_columns,
    add_columns,
    finish,
    largest,
    trusted,
)
from mbagent_envs._compiled import borrowed, compiled
from mbagent_envs.random_keys import uniform_at

Keys = NDArray[np.uint64]


class Work(NamedTuple):
    """Work space for one row.

    Attributes:
        active: input columns that are 1, int64 [O + n_steps].
        shown: columns of the next factors that are not 0, int64 [n_columns].
        chosen: factors that are not left to the predictor, int64 [O].
        guess: the next factors' columns, [n_columns].
        luck: a number for each factor, [O].
        known: what each factor's group gets from state and action, [O, G].
        hidden: of one group, [G].
        row_logits: of one factor, [K].
        given: its distribution, [K].
    """

    active: Ints
    shown: Ints
    chosen: Ints
    guess: Floats32
    luck: Floats
    known: Floats32
    hidden: Floats32
    row_logits: Floats32
    given: Floats


@compiled
def work_space(layout: Layout, group: GroupWeights) -> Work:
    """Room for one row of a model of this shape."""
    n_outputs, n_columns, size, n_values = len(layout.outputs), group.others.shape[1], group.bias.shape[1], group.offset.shape[1]
    return Work(
        np.empty(n_outputs + layout.n_steps, dtype=np.int64),
        np.empty(n_columns, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_columns, dtype=np.float32),
        np.empty(n_outputs, dtype=np.float64),
        np.empty((n_outputs, size), dtype=np.float32),
        np.empty(size, dtype=np.float32),
        np.empty(n_values, dtype=np.float32),
        np.empty(n_values, dtype=np.float64),
    )


@compiled
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


@compiled
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


@compiled
def _likeliest(values: Floats, n: int) -> int:
    """Index of the largest of the first ``n`` values; the lowest of equals."""
    best = 0
    for k in range(1, n):
        if values[k] > values[best]:
            best = k
    return best


@compiled
def copy_row(table: Floats32, row: int, out: Floats32) -> None:
    """Copies ``table[row]`` to ``out``, without the slice."""
    for h in range(len(out)):
        out[h] = table[row, h]


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
    n_active, n_shown = active_columns(states, b, action, layout, w.active), 0
    for i in range(len(layout.outputs)):
        n, u = layout.outputs[i], uniform_at(key, i)
        if trusted(probs, b, i, layout, group, certain):
            if n == 2:  # written out, as in sample_independent
                value = int((0.5 if greedy else u) >= probs[b, i, 0] and probs[b, i, 1] > 0.0)
            else:
                value = largest(probs, b, i, n) if greedy else draw_at(probs, b, i, n, u)
        else:
            g = group.group_of[i]
            copy_row(group.bias, g, w.hidden)
            add_columns(group.inputs, g, w.active, n_active, w.hidden)
            add_columns(group.others, g, w.shown, n_shown, w.hidden)
            finish(b, i, logits, layout, group, w.hidden, w.row_logits, w.given)
            value = _likeliest(w.given, n) if greedy else draw(w.given, n, u)
        factors[b, i] = value
        if n != 2 or value == 1:  # a bit that is 0 has no column
            w.shown[n_shown] = layout.start[i] + (0 if n == 2 else value)
            n_shown += 1


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
    n_outputs = len(layout.outputs)
    result = np.zeros(len(states), dtype=np.float64)
    active, shown = np.empty(n_outputs + layout.n_steps, dtype=np.int64), np.empty(n_outputs, dtype=np.int64)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states, b, actions[b], layout, active)
        n_shown = 0
        for i in range(n_outputs):
            n, value = layout.outputs[i], factors[b, i]
            probability = probs[b, i, value]
            if group.group_of[i] >= 0 and not trusted(probs, b, i, layout, group, certain):
                g = group.group_of[i]
                hidden[:] = group.bias[g]
                add_columns(group.inputs, g, active, n_active, hidden)
                add_columns(group.others, g, shown, n_shown, hidden)
                finish(b, i, logits, layout, group, hidden, row_logits, given)
                probability = given[value]
            result[b] += math.log(probability) if probability > 0.0 else -np.inf
            if n != 2 or value == 1:  # a bit that is 0 has no column
                shown[n_shown] = layout.start[i] + (0 if n == 2 else value)
                n_shown += 1
    return result
