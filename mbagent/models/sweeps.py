"""The paper's way to an outcome (3.2), compiled: sweeps that redraw each factor given all others. See ``samplers.py``."""

from __future__ import annotations

import numpy as np

from mbagent.models.arithmetic import Floats, Floats32, Ints, add_scaled, count_below
from mbagent.models.kernels import GroupWeights, Layout, finish
from mbagent.models.samplers import Keys, draw
from mbagent.models.sweep_blocks import Block, SweepWork, begin_block, list_columns, sum_columns, sum_up, work_space
from mbagent_envs._compiled import borrowed, compiled, inlined
from mbagent_envs.random_keys import derive_one, fill_row

_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the numbers of the factors, which are smaller."""


@inlined
def _shuffle(n: int, key: np.uint64, w: SweepWork) -> None:
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
        certain: a factor whose likeliest value has this probability in the predictor's eyes takes that value in every sweep,
            without the conditioner, unless the number drawn for it lies so far out that the conditioner could say otherwise
            by raising the odds ``LEEWAY`` times. Where it never raises them more, the draws are those of the full sweep.
        sweeps: passes; each in a random order of its own.
        real_guess: the first guess is the predictor's probabilities; else bits drawn from them.

    Returns:
        Draws int64 [B, O].
    """
    factors = np.empty((len(states), len(layout.outputs)), dtype=np.int64)
    block, work = work_space(len(states), layout, group)
    first = 0
    while first < len(states):
        n_rows = begin_block(first, states, actions, probs, keys, layout, group, certain, real_guess, block, work, factors)
        sum_up(n_rows, layout, group, real_guess, block)
        for r in range(n_rows):
            b = first + r
            _sweep_row(b, r, states, actions[b], logits, keys[b], layout, group, sweeps, real_guess, block, work, factors)
        first += n_rows
    return factors


@compiled
def _sweep_row(
    b: int,
    r: int,
    states: Ints,
    action: int,
    logits: Floats32,
    row_key: np.uint64,
    layout: Layout,
    group: GroupWeights,
    sweeps: int,
    real_guess: bool,
    block: Block,
    work: SweepWork,
    factors: Ints,
) -> None:
    """The sweeps of row b, r of its block, to ``factors`` [B, O]."""
    states, logits, factors = borrowed(states), borrowed(logits), borrowed(factors)
    layout, group, k, w = borrowed(layout), borrowed(group), borrowed(block), borrowed(work)
    for sweep in range(sweeps):
        key, anew = derive_one(row_key, np.uint64(sweep)), real_guess and sweep == 0
        fill_row(key, w.luck)
        n = _choose(b, r, k, w, factors)
        _shuffle(n, derive_one(key, _ORDER), w)
        for step in range(n):
            i = w.order[step]
            u, value, slot = w.luck[i], k.top[r, i], k.slot[r, i]
            if u < k.low[r, i] or u >= k.high[r, i]:
                if slot < 0:
                    slot = len(k.sums) - 1
                    n_columns = list_columns(b, r, states, action, layout, k, w, w.columns)
                    sum_columns(i, r, w.columns, n_columns, group, anew, k, slot)
                finish(b, i, logits, layout, group, k.sums, slot, w.hidden, w.row_logits, w.given)
                value = draw(w.given, layout.outputs[i], u)
            if value != factors[b, i] or anew:
                factors[b, i] = value
                _change(r, i, value, step + 1 if sweep == sweeps - 1 else 0, n, layout, group, k, w)


@inlined
def _choose(b: int, r: int, k: Block, w: SweepWork, factors: Ints) -> int:
    """Writes the factors that this sweep may change to ``w.chosen``; returns how many."""
    n = 0
    for i in range(len(w.luck)):
        w.chosen[n] = i
        n += int((w.luck[i] < k.low[r, i]) | (w.luck[i] >= k.high[r, i]) | (factors[b, i] != k.top[r, i]))
    return n


@inlined
def _change(
    r: int, i: int, value: int, begin: int, end: int, layout: Layout, group: GroupWeights, k: Block, w: SweepWork
) -> None:
    """Writes factor i's value to its columns, and what that changes to the sums of the open factors from ``begin`` on."""
    n = layout.outputs[i]
    for v in range(1 if n == 2 else 0, n):
        column = layout.start[i] + (0 if n == 2 else v)
        difference = np.float32(int(value == v)) - k.guess[r, column]
        k.guess[r, column] = float(int(value == v))
        if difference != 0.0:
            for step in range(begin, end):
                slot = k.slot[r, w.order[step]]
                if slot >= 0:
                    g = group.group_of[w.order[step]]
                    add_scaled(group.columns, g, group.next_start + column, difference, k.sums, slot)
