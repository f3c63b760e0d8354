"""The paper's way to an outcome (3.2), compiled: sweeps that redraw each factor given all others. See ``samplers.py``."""

from __future__ import annotations

import numpy as np

from mbagent.models.kernels import (
    Floats,
    Floats32,
    GroupWeights,
    Ints,
    Layout,
    active_columns,
    add_columns,
    add_weighted,
    finish,
    trusted,
)
from mbagent.models.samplers import Keys, Work, copy_row, draw, draw_at, work_space
from mbagent_envs._compiled import borrowed, compiled
from mbagent_envs.random_keys import derive_one, uniform_at

_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the numbers of the factors, which are smaller."""


@compiled
def _shuffle(factors: Ints, n: int, key: np.uint64, luck: Floats) -> None:
    """Puts the first ``n`` of ``factors`` into a random order; ``luck`` is work space for a number a factor.

    Any two come in the same order whichever others are there: sweeps over some of the factors are like those over all.
    """
    for step in range(n):
        factor = factors[step]
        u = luck[factor] = uniform_at(key, factor)
        place = step
        while place > 0 and luck[factors[place - 1]] > u:
            factors[place] = factors[place - 1]
            place -= 1
        factors[place] = factor


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
def _add_guess(table: Floats32, g: int, guess: Floats32, shown: Ints, hidden: Floats32) -> None:
    """Adds to ``hidden`` [G] what group g gets from the guess [n_columns]; ``table`` is [g, n_columns, G].

    ``shown`` [n_columns] is work space: the columns that are not 0, listed without a branch, since bits cannot be foretold.
    """
    n = 0
    for column in range(len(guess)):
        shown[n] = column
        n += guess[column] != 0.0
    add_weighted(table, g, shown, n, guess, hidden)


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
    factors = np.empty((len(states), len(layout.outputs)), dtype=np.int64)
    work = work_space(layout, group)
    for b in range(len(states)):
        _sweep_row(b, states, actions[b], logits, probs, keys[b], layout, group, certain, sweeps, real_guess, work, factors)
    return factors


@compiled
def _sweep_row(
    b: int,
    states: Ints,
    action: int,
    logits: Floats32,
    probs: Floats,
    row_key: np.uint64,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    sweeps: int,
    real_guess: bool,
    work: Work,
    factors: Ints,
) -> None:
    """Row b of ``sample_sweeps``, to ``factors`` [B, O]."""
    # The caller keeps all of this alive: no references need be counted for every factor.
    states, logits, probs, factors = borrowed(states), borrowed(logits), borrowed(probs), borrowed(factors)
    layout, group, w = borrowed(layout), borrowed(group), borrowed(work)
    n_active, n_open = active_columns(states, b, action, layout, w.active), 0
    for i in range(len(layout.outputs)):
        factors[b, i] = draw_at(probs, b, i, layout.outputs[i], uniform_at(row_key, i))
        _show(w.guess, i, factors[b, i], layout)
        if not trusted(probs, b, i, layout, group, certain):
            if real_guess:
                _show_real(w.guess, b, i, probs, layout)
            g = group.group_of[i]
            copy_row(group.bias, g, w.hidden)
            add_columns(group.inputs, g, w.active, n_active, w.hidden)
            for h in range(len(w.hidden)):
                w.known[i, h] = w.hidden[h]
            w.chosen[n_open] = i
            n_open += 1
    for sweep in range(sweeps):
        key = derive_one(row_key, np.uint64(sweep))
        _shuffle(w.chosen, n_open, derive_one(key, _ORDER), w.luck)
        for step in range(n_open):
            i = w.chosen[step]
            copy_row(w.known, i, w.hidden)
            _add_guess(group.others, group.group_of[i], w.guess, w.shown, w.hidden)
            finish(b, i, logits, layout, group, w.hidden, w.row_logits, w.given)
            factors[b, i] = draw(w.given, layout.outputs[i], uniform_at(key, i))
            _show(w.guess, i, factors[b, i], layout)
