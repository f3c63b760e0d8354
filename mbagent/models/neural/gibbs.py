"""Compiled Gibbs sampling of outcomes: the paper's sweeps (3.2), which resample each factor given all others.

Each block of rows is initialised with samples from the predictor and with the summed inputs of the uncertain factors.
"""

from __future__ import annotations

import numpy as np

from mbagent.models.neural.kernels import (
    FactorWork,
    Floats32,
    GroupWeights,
    Rows,
    active_columns,
    add_columns,
    add_scaled,
    copy_row,
    count_below,
    factor_work,
    finish,
    trusted,
)
from mbagent.models.neural.sampling import draw_at
from mbagent.models.systematic_sampling import draw, largest
from mbagent.types import Floats, Ints, Keys
from mbagent_envs.jit import compiled, inlined, vectorised
from mbagent_envs.random_keys import derive_one, fill_row
from mbagent_envs.structs import Struct

LEEWAY = 2.0
"""Assumed largest factor by which the conditioner raises the odds of an unlikely value of a trusted factor."""

GIBBS_ROWS = 64
"""Largest number of rows in a block."""

MOST_SUMS = 2**15
"""Largest number of values in the summed inputs of all open factors of a block, so that they fit into the processor's cache."""

ALWAYS = 2.0
"""A bound above all random numbers: as ``low`` it marks an open factor."""


class Block(Struct):
    """Data of R rows; the next factors have C columns.

    Attributes:
        guess: values of the next factors' columns, [R, C].
        low: the conditioner is evaluated for a factor if the factor's random number is below this bound, [R, O];
        high: also at or above this one, [R, O]. In between, the factor takes the predictor's most likely value (if it has no
            group, its sample).
        top: that value, int64 [R, O].
        slot: row of ``sums`` for an open factor, -1 if the factor is not open, int64 [R, O].
        columns: indices of all columns that are 1 initially, int64 [R, C + O + n_steps].
        n_columns: number of these columns, int64 [R].
        sums: summed inputs of open factors' groups, [slots, G]; the last slot is for any factor that is not open.
    """

    guess: Floats32
    low: Floats
    high: Floats
    top: Ints
    slot: Ints
    columns: Ints
    n_columns: Ints
    sums: Floats32


class SweepWork(Struct):
    """Work space for one row.

    Attributes:
        active: indices of the input columns that are 1, int64 [O + n_steps].
        on: whether a column is 1 in the state, int64 [C].
        columns: indices of all columns that are 1 at present, int64 [C + O + n_steps].
        shift: number added to a column to get its index among a group's weight columns, int64 [4]; entry s + 2 n: s = 1 if the
            column is 1 in the state, n = 1 if in the next state.
        chosen: factors that this sweep may change, int64 [O].
        noise: random number of each factor, [O].
        rank: second random number of each factor, which determines the order of resampling, [O].
        ranks: ``rank`` of each chosen factor, [O].
        order: the chosen factors in order of resampling, int64 [O].
        factor: of one factor.
    """

    active: Ints
    on: Ints
    columns: Ints
    shift: Ints
    chosen: Ints
    noise: Floats
    rank: Floats
    ranks: Floats
    order: Ints
    factor: FactorWork


class Sweeps(Struct):
    """A batch to sample, the parameters, and the work space.

    Attributes:
        rows: the batch.
        keys: uint64 [B].
        group: the conditioner, masked "others".
        certain, sweeps, real_guess: see ``sample_sweeps``.
        block: data of the rows that are sampled at once.
        work: for one row.
        factors: the samples, int64 [B, O].
    """

    rows: Rows
    keys: Keys
    group: GroupWeights
    certain: float
    sweeps: int
    real_guess: bool
    block: Block
    work: SweepWork
    factors: Ints


def work_space(n_rows: int, group: GroupWeights) -> tuple[Block, SweepWork]:
    """Work space for a block of up to ``n_rows`` rows, and for one row."""
    n_outputs, size = len(group.group_of), group.bias.shape[1]
    n_columns, n_active, rows = group.both_start - group.next_start, n_outputs + group.layout.n_steps, min(n_rows, GIBBS_ROWS)
    n_slots = 1 + max(n_outputs, min(rows * n_outputs, MOST_SUMS // size))
    block = Block(
        np.empty((rows, n_columns), dtype=np.float32),
        np.empty((rows, n_outputs), dtype=np.float64),
        np.empty((rows, n_outputs), dtype=np.float64),
        np.empty((rows, n_outputs), dtype=np.int64),
        np.empty((rows, n_outputs), dtype=np.int64),
        np.empty((rows, n_columns + n_active), dtype=np.int64),
        np.empty(rows, dtype=np.int64),
        np.empty((n_slots, size), dtype=np.float32),
    )
    work = SweepWork(
        np.empty(n_active, dtype=np.int64),
        np.empty(n_columns, dtype=np.int64),
        np.empty(n_columns + n_active, dtype=np.int64),
        np.array((0, 0, group.next_start, group.both_start), dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(n_outputs, dtype=np.int64),
        factor_work(group),
    )
    return block, work


@compiled
def _begin_block(first: int, s: Sweeps) -> int:
    """Initialises rows from ``first`` on while the block can hold them and their open factors' sums; returns how many."""
    probs, k, w, factors, group_of, n_slots = s.rows.probs, s.block, s.work, s.factors, s.group.group_of, 0
    for r in range(min(len(probs) - first, len(k.low))):
        b, n_open = first + r, 0
        fill_row(s.keys[b], w.noise)
        if probs.shape[2] == 2:
            _draw_bits(probs, b, w.noise, factors)
            _bound_bits(probs, b, r, group_of, s.certain, k.low, k.high)
            _likeliest_bits(probs, b, r, group_of, factors, k.top)
            _show_bits(probs, b, r, factors, k.low, s.real_guess != 0, k.guess)
        else:
            for i in range(len(group_of)):
                _begin_factor(b, r, i, s)
        for i in range(len(group_of)):
            is_open = k.low[r, i] == ALWAYS
            k.slot[r, i] = n_slots + n_open if is_open else -1
            n_open += int(is_open)
        if n_slots + n_open >= len(k.sums):
            return r  # this row is initialised again in the next block
        n_slots += n_open
        k.n_columns[r] = _list_columns(b, r, s, k.columns[r])
    return min(len(probs) - first, len(k.low))


@vectorised
def _draw_bits(probs: Floats, b: int, noise: Floats, factors: Ints) -> None:
    """Draws row b's initial sample if all factors are bits; separate from the next three functions to vectorise each."""
    for i in range(len(noise)):
        factors[b, i] = int((noise[i] >= probs[b, i, 0]) & (probs[b, i, 1] > 0.0))


@vectorised
def _bound_bits(probs: Floats, b: int, r: int, group_of: Ints, certain: float, low: Floats, high: Floats) -> None:
    """Sets ``low`` and ``high`` as ``_begin_factor`` does."""
    for i in range(low.shape[1]):
        p0, p1 = probs[b, i, 0], probs[b, i, 1]
        trust = (max(p0, p1) >= certain) | (group_of[i] < 0)
        below = LEEWAY * p0 if (p1 > p0) & (group_of[i] >= 0) else 0.0
        above = LEEWAY * p1 if (p1 <= p0) & (group_of[i] >= 0) else 0.0
        low[r, i] = below if trust else ALWAYS
        high[r, i] = 1.0 - above if trust else ALWAYS


@vectorised
def _likeliest_bits(probs: Floats, b: int, r: int, group_of: Ints, factors: Ints, top: Ints) -> None:
    """Sets ``top`` as ``_begin_factor`` does."""
    for i in range(top.shape[1]):
        likeliest = int(probs[b, i, 1] > probs[b, i, 0])
        top[r, i] = likeliest if group_of[i] >= 0 else factors[b, i]


@vectorised
def _show_bits(probs: Floats, b: int, r: int, factors: Ints, low: Floats, real_guess: bool, guess: Floats32) -> None:
    """Sets ``guess`` as ``_begin_factor`` does."""
    for i in range(guess.shape[1]):
        real = real_guess & (low[r, i] == ALWAYS)
        guess[r, i] = np.float32(probs[b, i, 1] if real else float(factors[b, i]))


@inlined
def _begin_factor(b: int, r: int, i: int, s: Sweeps) -> None:
    """Draws factor i's initial value; sets bounds: only random numbers outside them require the conditioner's output."""
    probs, k, n, start = s.rows.probs, s.block, s.group.layout.outputs[i], s.group.layout.start[i]
    top = largest(probs, b, i, n)
    value = draw_at(probs, b, i, n, s.work.noise[i])
    trust = trusted(s.rows, b, i, s.group, s.certain)
    below = 0.0
    for v in range(top):
        below += probs[b, i, v]
    above = max(1.0 - probs[b, i, top] - below, 0.0)
    s.factors[b, i], k.top[r, i] = value, top
    k.low[r, i], k.high[r, i] = (LEEWAY * below, 1.0 - LEEWAY * above) if trust else (ALWAYS, ALWAYS)
    if s.group.group_of[i] < 0:
        k.top[r, i], k.low[r, i], k.high[r, i] = value, 0.0, ALWAYS
    for v in range(1 if n == 2 else 0, n):  # a bit has one column
        column = start + (0 if n == 2 else v)
        k.guess[r, column] = probs[b, i, v] if s.real_guess and not trust else float(int(value == v))


@inlined
def _list_columns(b: int, r: int, s: Sweeps, columns: Ints) -> int:
    """Writes to ``columns`` the indices of row b's columns that are 1; returns the count. No unpredictable branches."""
    k, w, layout = s.block, s.work, s.group.layout
    n_active, n = active_columns(s.rows.states, b, s.rows.actions[b], layout, w.active), 0
    w.on[:] = 0
    for a in range(n_active - layout.n_steps):
        w.on[w.active[a]] = 1
    for column in range(len(w.on)):
        kind = w.on[column] + 2 * int(k.guess[r, column] == 1.0)
        columns[n] = column + w.shift[kind]
        n += int(kind > 0)
    for a in range(n_active - layout.n_steps, n_active):
        columns[n] = w.active[a]
        n += 1
    return n


@inlined
def _sum_columns(i: int, r: int, columns: Ints, n_columns: int, real_guess: bool, s: Sweeps, slot: int) -> None:
    """Writes the summed input of factor i's group to row ``slot`` of the block's ``sums``.

    Args:
        i: the factor.
        r: row of the block.
        columns: the columns that are 1.
        n_columns: number of these columns.
        real_guess: whether columns of the next factors may lie between 0 and 1.
        s: the batch.
        slot: see above.
    """
    k, group, g = s.block, s.group, s.group.group_of[i]
    copy_row(group.bias, g, k.sums, slot)
    add_columns(group.columns, g, columns, n_columns, k.sums, slot)
    if real_guess:
        for column in range(k.guess.shape[1]):
            if 0.0 < k.guess[r, column] < 1.0:
                add_scaled(group.columns, g, group.next_start + column, k.guess[r, column], k.sums, slot)


@compiled
def _sum_up(n_rows: int, s: Sweeps) -> None:
    """Sums open factors' inputs at the initial values, one group at a time for all rows, so that weights stay cached."""
    k = s.block
    for i in range(len(s.group.group_of)):
        for r in range(n_rows):
            if k.slot[r, i] >= 0:
                _sum_columns(i, r, k.columns[r], k.n_columns[r], s.real_guess != 0, s, k.slot[r, i])


_ORDER = np.uint64(1 << 32)
"""Salt of a sweep's random order; its draws use the numbers of the factors, which are smaller."""


@inlined
def _shuffle(n: int, key: np.uint64, w: SweepWork) -> None:
    """Writes the first ``n`` factors of ``w.chosen`` to ``w.order`` in a random order.

    The relative order of two factors does not depend on the other factors, so a sweep over some factors visits them in the order
    of a full sweep. A factor's position is the number of factors that precede it. Counting uses no branches, since they would be
    unpredictable.
    """
    fill_row(key, w.rank)
    for step in range(n):
        w.ranks[step] = w.rank[w.chosen[step]]
    for step in range(n):
        place = count_below(w.ranks, 0, step, w.ranks[step], True) + count_below(w.ranks, step + 1, n, w.ranks[step], False)
        w.order[place] = w.chosen[step]


def sample_sweeps(rows: Rows, keys: Keys, group: GroupWeights, certain: float, sweeps: int, real_guess: bool) -> Ints:
    """The paper's method: samples from the predictor, then resamples every factor given the others, ``sweeps`` times.

    Args:
        rows: the batch.
        keys: uint64 [B].
        group: the conditioner, masked "others".
        certain: a factor is trusted if the predictor gives its most likely value at least this probability. In every sweep it
            takes that value, and the conditioner is not evaluated, unless the factor's random number is so extreme that raising
            the odds of another value by the factor ``LEEWAY`` could change the result. If the conditioner never raises odds by
            more, the samples equal those of full sweeps.
        sweeps: number of passes, each in a new random order.
        real_guess: True: open factors start from the predictor's probabilities; False: all factors start from values drawn from
            them.

    Returns:
        Samples int64 [B, O].
    """
    factors = np.empty(rows.probs.shape[:2], dtype=np.int64)
    _sample(Sweeps(rows, keys, group, certain, sweeps, real_guess, *work_space(len(factors), group), factors))
    return factors


@compiled
def _sample(s: Sweeps) -> None:
    first = 0
    while first < len(s.factors):
        n_rows = _begin_block(first, s)
        _sum_up(n_rows, s)
        for r in range(n_rows):
            _sweep_row(first + r, r, s)
        first += n_rows


@compiled
def _sweep_row(b: int, r: int, s: Sweeps) -> None:
    """Performs the sweeps of row b, which is row r of its block; updates its samples in place."""
    k, w, factors = s.block, s.work, s.factors
    for sweep in range(s.sweeps):
        key, anew = derive_one(s.keys[b], np.uint64(sweep)), s.real_guess != 0 and sweep == 0
        fill_row(key, w.noise)
        n = _choose(b, r, k, w, factors)
        _shuffle(n, derive_one(key, _ORDER), w)
        for step in range(n):
            i = w.order[step]
            u, value, slot = w.noise[i], k.top[r, i], k.slot[r, i]
            if u < k.low[r, i] or u >= k.high[r, i]:
                if slot < 0:
                    slot = len(k.sums) - 1
                    n_columns = _list_columns(b, r, s, w.columns)
                    _sum_columns(i, r, w.columns, n_columns, anew, s, slot)
                finish(b, i, s.rows, s.group, k.sums, slot, w.factor)
                value = draw(w.factor.given, s.group.layout.outputs[i], u)
            if value != factors[b, i] or anew:
                factors[b, i] = value
                _change(r, i, value, step + 1 if sweep == s.sweeps - 1 else 0, n, s)


@inlined
def _choose(b: int, r: int, k: Block, w: SweepWork, factors: Ints) -> int:
    """Writes to ``w.chosen`` the factors that this sweep may change; returns their number."""
    n = 0
    for i in range(len(w.noise)):
        w.chosen[n] = i
        n += int((w.noise[i] < k.low[r, i]) | (w.noise[i] >= k.high[r, i]) | (factors[b, i] != k.top[r, i]))
    return n


@inlined
def _change(r: int, i: int, value: int, begin: int, end: int, s: Sweeps) -> None:
    """Writes factor i's value to its columns; updates the sums of the open factors among ``order[begin:end]``."""
    k, order, group, n, start = s.block, s.work.order, s.group, s.group.layout.outputs[i], s.group.layout.start[i]
    for v in range(1 if n == 2 else 0, n):
        column = start + (0 if n == 2 else v)
        difference = np.float32(int(value == v)) - k.guess[r, column]
        k.guess[r, column] = float(int(value == v))
        if difference != 0.0:
            for step in range(begin, end):
                slot = k.slot[r, order[step]]
                if slot >= 0:
                    g = group.group_of[order[step]]
                    add_scaled(group.columns, g, group.next_start + column, difference, k.sums, slot)
