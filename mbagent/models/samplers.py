"""The samplers made of predictor and conditioner (paper 3.1 and 3.2), compiled; every row draws from its own key.

Three ways to an outcome: each factor by itself (no conditioner), ancestral (conditioner masked to y_<i; exact), and the
paper's sweeps (conditioner masked to all but y_i). Shapes: B batch, O output factors, K largest cardinality.
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
    conditional,
    finish,
    largest,
    trusted,
)
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import derive_one, uniform_at

Keys = NDArray[np.uint64]

_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the indices of the factors, which are smaller."""


@compiled
def draw(values: Floats, n: int, u: float) -> int:
    """Index drawn from the first ``n`` values, which sum to one, by the inverse of their running sum at ``u`` in [0, 1)."""
    chosen = 0
    for k in range(n):
        if values[k] > 0.0:
            chosen = k
            u -= values[k]
            if u < 0.0:
                break
    return chosen


@compiled
def sample_independent(probs: Floats, outputs: Ints, keys: Keys) -> Ints:
    """Draws int64 [B, O]: factor i of row b at number i of key b."""
    factors = np.empty(probs.shape[:2], dtype=np.int64)
    for b in range(probs.shape[0]):
        for i in range(probs.shape[1]):
            factors[b, i] = draw(probs[b, i], outputs[i], uniform_at(keys[b], i))
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
    """Ancestral draws int64 [B, O]: y_0, then y_1 given it, and so on; ``greedy`` takes the likeliest instead.

    A factor whose likeliest value has at least ``certain`` in the predictor's eyes, or that has no group in the
    conditioner,
    is drawn from the predictor. This is part of the model: ``log_prob_causal`` follows the same rule, so both stay
    exact.
    """
    n_outputs = len(layout.outputs)
    factors = np.empty((len(states), n_outputs), dtype=np.int64)
    active = np.empty(states.shape[1] + 1, dtype=np.int64)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states[b], actions[b], layout, active)
        for i in range(n_outputs):
            n, values = layout.outputs[i], probs[b, i]
            if not trusted(i, values, layout, group, certain):
                conditional(i, logits[b, i], active, n_active, factors[b], layout, group, hidden, row_logits, given)
                values = given
            factors[b, i] = largest(values, n) if greedy else draw(values, n, uniform_at(keys[b], i))
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
    result = np.zeros(len(states), dtype=np.float64)
    active = np.empty(states.shape[1] + 1, dtype=np.int64)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given = np.empty(logits.shape[2], dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states[b], actions[b], layout, active)
        for i in range(len(layout.outputs)):
            values = probs[b, i]
            if not trusted(i, values, layout, group, certain):
                conditional(i, logits[b, i], active, n_active, factors[b], layout, group, hidden, row_logits, given)
                values = given
            value = values[factors[b, i]]
            result[b] += math.log(value) if value > 0.0 else -np.inf
    return result


@compiled
def _shuffle(order: Ints, key: np.uint64) -> None:
    for i in range(len(order)):
        order[i] = i
    for i in range(len(order) - 1, 0, -1):
        j = int(uniform_at(key, i) * (i + 1))
        order[i], order[j] = order[j], order[i]


@compiled
def _show(guess: Floats32, i: int, values: Floats, layout: Layout) -> None:
    """Writes factor i to the columns that the conditioner sees, as the probabilities of its values (a draw: 0s and a 1)."""
    if layout.outputs[i] == 2:
        guess[layout.start[i]] = values[1]
        return
    for k in range(layout.outputs[i]):
        guess[layout.start[i] + k] = values[k]


@compiled
def _settle(guess: Floats32, i: int, values: Floats, u: float, layout: Layout, bits: Floats) -> int:
    """Draws factor i from ``values``, shows the draw to the conditioner, and returns it."""
    value = draw(values, layout.outputs[i], u)
    bits[:] = 0.0
    bits[value] = 1.0
    _show(guess, i, bits, layout)
    return value


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
        certain: a factor whose likeliest value has at least this in the predictor's eyes is drawn once and left alone.
        sweeps: passes; each in a random order of its own.
        real_guess: the first guess is the predictor's probabilities; else bits drawn from them.

    Returns:
        Draws int64 [B, O].
    """
    n_outputs = len(layout.outputs)
    factors = np.empty((len(states), n_outputs), dtype=np.int64)
    active = np.empty(states.shape[1] + 1, dtype=np.int64)
    order = np.empty(n_outputs, dtype=np.int64)
    guess = np.empty(group.others.shape[1], dtype=np.float32)
    known = np.empty((n_outputs, group.bias.shape[1]), dtype=np.float32)
    hidden = np.empty(group.bias.shape[1], dtype=np.float32)
    row_logits = np.empty(logits.shape[2], dtype=np.float32)
    given, bits = np.empty(logits.shape[2], dtype=np.float64), np.empty(logits.shape[2], dtype=np.float64)
    for b in range(len(states)):
        n_active = active_columns(states[b], actions[b], layout, active)
        for i in range(n_outputs):
            values = probs[b, i]
            factors[b, i] = _settle(guess, i, values, uniform_at(keys[b], i), layout, bits)
            if not trusted(i, values, layout, group, certain):
                if real_guess:
                    _show(guess, i, values, layout)
                known[i] = group.bias[group.group_of[i]]
                for a in range(n_active):
                    known[i] += group.inputs[group.group_of[i], active[a]]
        for sweep in range(sweeps):
            key = derive_one(keys[b], np.uint64(sweep))
            _shuffle(order, derive_one(key, _ORDER))
            for i in order:
                values = probs[b, i]
                if trusted(i, values, layout, group, certain):
                    continue
                hidden[:] = known[i]
                for column in range(len(guess)):
                    if guess[column] != 0.0:
                        hidden += guess[column] * group.others[group.group_of[i], column]
                finish(i, logits[b, i], layout, group, hidden, row_logits, given)
                factors[b, i] = _settle(guess, i, given, uniform_at(key, i), layout, bits)
    return factors
