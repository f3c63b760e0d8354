"""The paper's way to an outcome (3.2), compiled: sweeps that redraw each factor given all others. See ``samplers.py``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.arithmetic import Floats, Floats32, Ints, add_columns, add_scaled, copy_row, count_below
from mbagent.models.kernels import GroupWeights, Layout, active_columns, finish, largest, trusted
from mbagent.models.samplers import Keys, draw, draw_at
from mbagent_envs._compiled import borrowed, compiled, inlined
from mbagent_envs.random_keys import derive_one, fill_row, uniform_at

Bools = NDArray[np.bool_]

_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the numbers of the factors, which are smaller."""

LEEWAY = 10.0
"""The conditioner is taken to raise the odds of an unlikely value of a trusted factor at most so many times."""

_ALWAYS = 2.0
"""A bound that no random number reaches."""


class _Work(NamedTuple):
    """Work space for one row; C columns of the next factors.

    Attributes:
        active: input columns that are on, int64 [O + n_steps].
        on: 1 where a column is on in the state, int64 [C].
        guess: the next factors' columns, [C].
        columns: all columns that are on, int64 [C + O + n_steps].
        shift: from a column to its place among a group's, by whether it is on in the state and in the next one, int64 [4].
        low: the conditioner is asked about a factor when its number is below this, [O].
        high: or at least this, [O]; in between the factor is what the predictor thinks likeliest.
        top: which value that is, int64 [O].
        chosen: factors that this sweep may change, int64 [O].
        luck: a number for each factor, [O].
        rank: another number for each factor, which orders them, [O].
        ranks: that of the chosen ones, [O].
        order: the chosen ones in that order, int64 [O].
        known: each open factor's summed input, [O, G].
        ready: whether that is there, [O].
        hidden: nodes of one group, [1, G].
        row_logits: of one factor, [K].
        given: its distribution, [K].
    """

    active: Ints
    on: Ints
    guess: Floats32
    columns: Ints
    shift: Ints
    low: Floats
    high: Floats
    top: Ints
    chosen: Ints
    luck: Floats
    rank: Floats
    ranks: Floats
    order: Ints
    known: Floats32
    ready: Bools
    hidden: Floats32
    row_logits: Floats32
    given: Floats


@compiled
def _work_space(layout: Layout, group: GroupWeights) -> _Work:
    n_outputs, size, n_values = len(layout.outputs), group.bias.shape[1], group.offset.shape[1]
    n_columns, n_active = group.both_start - group.next_start, n_outputs + layout.n_steps
    top, chosen, order = np.empty((3, n_outputs), dtype=np.int64)
    low, high, luck, rank, ranks = np.empty((5, n_outputs), dtype=np.float64)
    return _Work(
        np.empty(n_active, dtype=np.int64),
        np.empty(n_columns, dtype=np.int64),
        np.empty(n_columns, dtype=np.float32),
        np.empty(n_columns + n_active, dtype=np.int64),
        np.array((0, 0, group.next_start, group.both_start), dtype=np.int64),
        low,
        high,
        top,
        chosen,
        luck,
        rank,
        ranks,
        order,
        np.empty((n_outputs, size), dtype=np.float32),
        np.empty(n_outputs, dtype=np.bool_),
        np.empty((1, size), dtype=np.float32),
        np.empty(n_values, dtype=np.float32),
        np.empty(n_values, dtype=np.float64),
    )


@inlined
def _shuffle(n: int, key: np.uint64, w: _Work) -> None:
    """Lists the first ``n`` of ``w.chosen`` in a random order, in ``w.order``.

    Any two come in the same order whichever others are there: sweeps over some of the factors are like those over all. Each one's
    place is how many come before it, counted without branches: those of a sort could not be foretold.
    """
    fill_row(key, w.rank)
    for step in range(n):
        w.ranks[step] = w.rank[w.chosen[step]]
    for step in range(n):
        place = count_below(w.ranks, 0, step, w.ranks[step], True) + count_below(w.ranks, step + 1, n, w.ranks[step], False)
        w.order[place] = w.chosen[step]


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
    work = _work_space(layout, group)
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
    work: _Work,
    factors: Ints,
) -> None:
    """Row b of ``sample_sweeps``, to ``factors`` [B, O]."""
    # The caller keeps all of this alive: no references need be counted for every factor.
    states, logits, probs, factors = borrowed(states), borrowed(logits), borrowed(probs), borrowed(factors)
    layout, group, w = borrowed(layout), borrowed(group), borrowed(work)
    n_active = active_columns(states, b, action, layout, w.active)
    _begin(b, n_active, probs, row_key, layout, group, certain, real_guess, w, factors)
    n_columns = -1  # not listed
    for sweep in range(sweeps):
        key, last = derive_one(row_key, np.uint64(sweep)), sweep == sweeps - 1
        fill_row(key, w.luck)
        n = _choose(b, w, factors)
        _shuffle(n, derive_one(key, _ORDER), w)
        for step in range(n):
            i = w.order[step]
            u, value = w.luck[i], w.top[i]
            if u < w.low[i] or u >= w.high[i]:
                if not w.ready[i]:
                    if n_columns < 0:
                        n_columns = _list_columns(n_active, layout, w)
                    _sum_up(i, n_columns, group, real_guess and sweep == 0, w)
                finish(b, i, logits, layout, group, w.known, i, w.hidden, w.row_logits, w.given)
                value = draw(w.given, layout.outputs[i], u)
            if value != factors[b, i] or (real_guess and sweep == 0):
                factors[b, i], n_columns = value, -1
                _change(i, value, step + 1 if last else 0, n, layout, group, w)


@inlined
def _begin(
    b: int,
    n_active: int,
    probs: Floats,
    key: np.uint64,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    real_guess: bool,
    w: _Work,
    factors: Ints,
) -> None:
    """Draws the first guess of row b, and says of each factor when the conditioner is to be asked about it."""
    w.on[:] = 0
    for a in range(n_active - layout.n_steps):
        w.on[w.active[a]] = 1
    fill_row(key, w.luck)
    for i in range(len(layout.outputs)):
        if layout.outputs[i] == 2:
            _begin_bit(b, i, probs, layout.start[i], group.group_of[i] >= 0, certain, real_guess, w, factors)
            continue
        n, start, top = layout.outputs[i], layout.start[i], largest(probs, b, i, layout.outputs[i])
        value = draw_at(probs, b, i, n, w.luck[i])
        trust = trusted(probs, b, i, layout, group, certain)
        below = 0.0
        for k in range(top):
            below += probs[b, i, k]
        above = max(1.0 - probs[b, i, top] - below, 0.0)
        factors[b, i], w.top[i], w.ready[i] = value, top, False
        w.low[i], w.high[i] = (LEEWAY * below, 1.0 - LEEWAY * above) if trust else (_ALWAYS, _ALWAYS)
        if group.group_of[i] < 0:
            w.top[i], w.low[i], w.high[i] = value, 0.0, _ALWAYS
        for k in range(n):
            w.guess[start + k] = probs[b, i, k] if real_guess and not trust else float(int(value == k))


@inlined
def _begin_bit(
    b: int, i: int, probs: Floats, column: int, grouped: bool, certain: float, real_guess: bool, w: _Work, factors: Ints
) -> None:
    """As ``_begin``, for a factor with two values: without branches."""
    p0, p1 = probs[b, i, 0], probs[b, i, 1]
    value, top = int((w.luck[i] >= p0) & (p1 > 0.0)), int(p1 > p0)
    trust = (max(p0, p1) >= certain) | (not grouped)
    factors[b, i], w.top[i], w.ready[i] = value, top if grouped else value, False
    w.low[i] = (LEEWAY * p0 * top * grouped) if trust else _ALWAYS
    w.high[i] = 1.0 - LEEWAY * p1 * (1 - top) * grouped
    w.guess[column] = p1 if real_guess and not trust else float(value)


@inlined
def _choose(b: int, w: _Work, factors: Ints) -> int:
    """Writes the factors that this sweep may change to ``w.chosen``; returns how many."""
    n = 0
    for i in range(len(w.low)):
        w.chosen[n] = i
        n += int((w.luck[i] < w.low[i]) | (w.luck[i] >= w.high[i]) | (factors[b, i] != w.top[i]))
    return n


@inlined
def _list_columns(n_active: int, layout: Layout, w: _Work) -> int:
    """Lists the columns that are on in ``w.columns`` and returns how many; without branches, since bits cannot be foretold."""
    n = 0
    for column in range(len(w.guess)):
        kind = w.on[column] + 2 * int(w.guess[column] == 1.0)
        w.columns[n] = column + w.shift[kind]
        n += int(kind > 0)
    for a in range(n_active - layout.n_steps, n_active):
        w.columns[n] = w.active[a]
        n += 1
    return n


@inlined
def _sum_up(i: int, n_columns: int, group: GroupWeights, real_guess: bool, w: _Work) -> None:
    """Writes the summed input of factor i's group to ``w.known[i]``; that of an open factor is kept up to date from then on."""
    g = group.group_of[i]
    copy_row(group.bias, g, w.known, i)
    add_columns(group.columns, g, w.columns, n_columns, w.known, i)
    if real_guess:
        for column in range(len(w.guess)):
            if 0.0 < w.guess[column] < 1.0:
                add_scaled(group.columns, g, group.next_start + column, w.guess[column], w.known, i)
    w.ready[i] = w.low[i] == _ALWAYS


@inlined
def _change(i: int, value: int, begin: int, end: int, layout: Layout, group: GroupWeights, w: _Work) -> None:
    """Writes factor i's value to its columns, and what that changes to the summed inputs of those chosen from ``begin`` on."""
    n = layout.outputs[i]
    for k in range(1 if n == 2 else 0, n):
        column = layout.start[i] + (0 if n == 2 else k)
        difference = np.float32(int(value == k)) - w.guess[column]
        w.guess[column] = float(int(value == k))
        if difference != 0.0:
            for step in range(begin, end):
                j = w.order[step]
                if w.ready[j]:
                    add_scaled(group.columns, group.group_of[j], group.next_start + column, difference, w.known, j)
