"""The samplers made of predictor and conditioner (paper 3.1 and 3.2), compiled; every row draws from its own key.

Three ways to an outcome: each factor by itself (no conditioner), ancestral (conditioner masked to y_<i; exact), and
the paper's sweeps (conditioner masked to all but y_i). Shapes: B batch, F state factors, O output factors, K largest
cardinality. Array rows are addressed by index, not sliced: a slice costs more than what is done with it here.
"""

from __future__ import annotations

import math

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
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import derive_one, uniform_at

Keys = NDArray[np.uint64]

_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the numbers of the factors, which are smaller."""


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
def _draw_at(probs: Floats, b: int, i: int, n: int, u: float) -> int:
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
def sample_independent(probs: Floats, outputs: Ints, keys: Keys) -> Ints:
    """Draws int64 [B, O]: factor i of row b at number i of key b."""
    factors = np.empty(probs.shape[:2], dtype=np.int64)
    for b in range(probs.shape[0]):
        for i in range(probs.shape[1]):
            u = uniform_at(keys[b], i)
            if outputs[i] == 2:  # written out: bits are the common case
                factors[b, i] = 1 if u >= probs[b, i, 0] and probs[b, i, 1] > 0.0 else 0
            else:
                factors[b, i] = _draw_at(probs, b, i, outputs[i], u)
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
    n_outputs = len(layout.outputs)
    factors = np.empty((len(states), n_outputs), dtype=np.int64)
    active, shown = np.empty(n_outputs + layout.n_steps, dtype=np.int64), np.empty(n_outputs, dtype=np.int64)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given = np.empty((1, 1, logits.shape[2]), dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states, b, actions[b], layout, active)
        n_shown = 0
        for i in range(n_outputs):
            n, u = layout.outputs[i], uniform_at(keys[b], i)
            if group.group_of[i] < 0 or trusted(probs, b, i, layout, group, certain):
                if n == 2:  # written out, as in sample_independent
                    value = int((0.5 if greedy else u) >= probs[b, i, 0] and probs[b, i, 1] > 0.0)
                else:
                    value = largest(probs, b, i, n) if greedy else _draw_at(probs, b, i, n, u)
            else:
                g = group.group_of[i]
                hidden[:] = group.bias[g]
                add_columns(group.inputs, g, active, n_active, hidden)
                add_columns(group.others, g, shown, n_shown, hidden)
                finish(b, i, logits, layout, group, hidden, row_logits, given[0, 0])
                value = largest(given, 0, 0, n) if greedy else _draw_at(given, 0, 0, n, u)
            factors[b, i] = value
            if n != 2 or value == 1:  # a bit that is 0 has no column
                shown[n_shown] = layout.start[i] + (0 if n == 2 else value)
                n_shown += 1
    return factors


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


@compiled
def _shuffle(order: Ints, key: np.uint64) -> None:
    for i in range(len(order)):
        order[i] = i
    for i in range(len(order) - 1, 0, -1):
        j = int(uniform_at(key, i) * (i + 1))
        order[i], order[j] = order[j], order[i]


@compiled
def _show(guess: Floats32, i: int, value: int, layout: Layout) -> None:
    """Writes factor i's value to the columns that the conditioner sees."""
    if layout.outputs[i] == 2:
        guess[layout.start[i]] = float(value)
        return
    for k in range(layout.outputs[i]):
        guess[layout.start[i] + k] = 1.0 if k == value else 0.0


@compiled
def _show_real(guess: Floats32, b: int, i: int, probs: Floats, layout: Layout) -> None:
    """Writes the probabilities of factor i's values to the columns that the conditioner sees."""
    if layout.outputs[i] == 2:
        guess[layout.start[i]] = probs[b, i, 1]
        return
    for k in range(layout.outputs[i]):
        guess[layout.start[i] + k] = probs[b, i, k]


@compiled
def _add_guess(table: Floats32, g: int, guess: Floats32, hidden: Floats32) -> None:
    """Adds to ``hidden`` [G] what group g gets from the guess [n_columns]; ``table`` is [g, n_columns, G]."""
    for column in range(len(guess)):
        if guess[column] != 0.0:
            for h in range(len(hidden)):
                hidden[h] += guess[column] * table[g, column, h]


@compiled
def sample_sweeps(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    keys: Keys,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    sweeps: int,
    real_guess: bool,
) -> Ints:
    """The paper's procedure: the predictor's guess, then ``sweeps`` passes that redraw each factor given all others.

    Args:
        states: int64 [B, F].
        actions: int64 [B].
        logits: the predictor's, float32 [B, O, K].
        probs: the predictor's, float64 [B, O, K].
        keys: uint64 [B].
        layout: the factors.
        group: the conditioner, masked "others".
        certain: factors are left to the predictor as in ``sample_causal``: drawn once, then left alone.
        sweeps: passes; each in a random order of its own.
        real_guess: the first guess is the predictor's probabilities; else bits drawn from them.

    Returns:
        Draws int64 [B, O].
    """
    n_outputs, size = len(layout.outputs), group.bias.shape[1]
    factors = np.empty((len(states), n_outputs), dtype=np.int64)
    active, order = np.empty(n_outputs + layout.n_steps, dtype=np.int64), np.empty(n_outputs, dtype=np.int64)
    guess = np.empty(group.others.shape[1], dtype=np.float32)
    hidden, known = np.empty(size, dtype=np.float32), np.empty((n_outputs, size), dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states, b, actions[b], layout, active)
        for i in range(n_outputs):
            factors[b, i] = _draw_at(probs, b, i, layout.outputs[i], uniform_at(keys[b], i))
            _show(guess, i, factors[b, i], layout)
            if not trusted(probs, b, i, layout, group, certain):
                if real_guess:
                    _show_real(guess, b, i, probs, layout)
                known[i] = group.bias[group.group_of[i]]
                add_columns(group.inputs, group.group_of[i], active, n_active, known[i])
        for sweep in range(sweeps):
            key = derive_one(keys[b], np.uint64(sweep))
            _shuffle(order, derive_one(key, _ORDER))
            for step in range(n_outputs):
                i = int(order[step])
                if trusted(probs, b, i, layout, group, certain):
                    continue
                hidden[:] = known[i]
                _add_guess(group.others, group.group_of[i], guess, hidden)
                finish(b, i, logits, layout, group, hidden, row_logits, given)
                factors[b, i] = draw(given, layout.outputs[i], uniform_at(key, i))
                _show(guess, i, factors[b, i], layout)
    return factors
