"""Compiled sampling from predictor and conditioner (paper 3.1 and 3.2); every row uses its own key.

Three samplers: each factor independently (no conditioner), ancestral (conditioner masked to y_<i; exact), and the paper's sweeps
(conditioner masked to all but y_i; in ``gibbs.py``). For planning, all successors are listed if there are few; otherwise
systematic sampling is used. Main particles contain the grid points (j + offset) / n of [0, 1). At each factor a particle's
interval is split in proportion to P(y_i | s, a, y_<i) and its points are distributed to the parts; parts without a point are
dropped. So the work grows with the number of distinct outcomes, not with n. All rows share the offset, so actions or states
differ only in their effects, not by chance. A particle with a single point continues with new random numbers, hashed from (seed,
point, factor), since its interval would soon be too narrow for a float.
Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, n points per row, M successors. Array rows are
indexed, not sliced, since creating a slice would take longer than the work done on it here.
"""

from __future__ import annotations

import math

import numpy as np

from mbagent.models.kernel import Outcomes
from mbagent.models.neural.kernels import (
    FactorWork,
    Floats32,
    GroupWeights,
    Rows,
    active_columns,
    add_columns,
    add_next,
    copy_row,
    factor_work,
    finish,
    next_place,
    trusted,
)
from mbagent.models.protocol import Successors
from mbagent.models.systematic_sampling import (
    MAIN,
    NEGLIGIBLE,
    STRATA,
    Grid,
    Particles,
    begin,
    draw,
    largest,
    listed,
    new_particles,
    place_of,
    prune,
    settle,
    share_out,
    write,
)
from mbagent.types import Floats, Ints, Keys
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.random_keys import fill_row, uniform_at
from mbagent_envs.structs import Struct


class Work(Struct):
    """Work space for one row.

    Attributes:
        columns: indices of ones, int64 [2 * O + n_steps].
        noise: random number of each factor, [O].
        sums: input of one group, [1, G].
        factor: of one factor.
    """

    columns: Ints
    noise: Floats
    sums: Floats32
    factor: FactorWork


def work_space(group: GroupWeights) -> Work:
    """Work space for one row of a model."""
    n_outputs, size = len(group.group_of), group.bias.shape[1]
    columns = np.empty(2 * n_outputs + group.layout.n_steps, dtype=np.int64)
    return Work(columns, np.empty(n_outputs), np.empty((1, size), dtype=np.float32), factor_work(group))


@inlined
def draw_at(probs: Floats, b: int, i: int, n: int, u: float) -> int:
    """As ``systematic_sampling.draw``, from ``probs[b, i]``."""
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
    """Index of the largest of the first ``n`` values; the lowest index in a tie."""
    best = 0
    for k in range(1, n):
        if values[k] > values[best]:
            best = k
    return best


@compiled
def sample_independent(probs: Floats, outputs: Ints, keys: Keys) -> Ints:
    """Samples int64 [B, O]: factor i of row b uses number i of key b."""
    factors = np.empty(probs.shape[:2], dtype=np.int64)
    for b in range(probs.shape[0]):
        for i in range(probs.shape[1]):
            u = uniform_at(keys[b], i)
            if outputs[i] == 2:  # special case for bits, the most common factors
                factors[b, i] = 1 if u >= probs[b, i, 0] and probs[b, i, 1] > 0.0 else 0
            else:
                factors[b, i] = draw_at(probs, b, i, outputs[i], u)
    return factors


def sample_causal(rows: Rows, keys: Keys, group: GroupWeights, certain: float, greedy: bool) -> Ints:
    """Ancestral samples int64 [B, O]: y_0, then y_1 given y_0, and so on; ``greedy`` takes the most likely values instead.

    A factor is sampled from the predictor if its most likely value has predicted probability at least ``certain``, or if it has
    no group in the conditioner. This is part of the model: ``log_prob_causal`` follows the same rule, so both are exact.

    Args:
        rows: the batch.
        keys: uint64 [B].
        group: the conditioner, masked "causal".
        certain: see above.
        greedy: see above.
    """
    factors = np.empty(rows.probs.shape[:2], dtype=np.int64)
    _sample_causal(rows, keys, group, certain, greedy, work_space(group), factors)
    return factors


@compiled
def _sample_causal(rows: Rows, keys: Keys, group: GroupWeights, certain: float, greedy: bool, work: Work, factors: Ints) -> None:
    states, probs, layout, columns = rows.states, rows.probs, group.layout, work.columns
    for b in range(len(states)):
        fill_row(keys[b], work.noise)
        n_columns, place = active_columns(states, b, rows.actions[b], layout, columns), 0
        for i in range(len(layout.outputs)):
            n, u = layout.outputs[i], work.noise[i]
            if trusted(rows, b, i, group, certain):
                if n == 2:  # special case, as in sample_independent
                    value = int((0.5 if greedy else u) >= probs[b, i, 0] and probs[b, i, 1] > 0.0)
                else:
                    value = largest(probs, b, i, n) if greedy else draw_at(probs, b, i, n, u)
            else:
                _condition(b, i, rows, group, n_columns, work)
                value = _likeliest(work.factor.given, n) if greedy else draw(work.factor.given, n, u)
            factors[b, i] = value
            n_columns = add_next(states, b, i, value, group, columns, n_columns, place)
            place = next_place(states, b, i, layout, place)


@inlined
def _condition(b: int, i: int, rows: Rows, group: GroupWeights, n_columns: int, w: Work) -> None:
    """Writes factor i's distribution, given the columns that are 1, to ``w.factor.given``."""
    g = group.group_of[i]
    copy_row(group.bias, g, w.sums, 0)
    add_columns(group.columns, g, w.columns, n_columns, w.sums, 0)
    finish(b, i, rows, group, w.sums, 0, w.factor)


def log_prob_causal(rows: Rows, factors: Ints, group: GroupWeights, certain: float) -> Floats:
    """Log-probability [B] of the outcomes ``factors`` [B, O] under the distribution of ``sample_causal``."""
    result = np.zeros(len(factors))
    _add_log_probs(rows, factors, group, certain, work_space(group), result)
    return result


@compiled
def _add_log_probs(rows: Rows, factors: Ints, group: GroupWeights, certain: float, work: Work, result: Floats) -> None:
    states, layout, columns = rows.states, group.layout, work.columns
    for b in range(len(states)):
        n_columns, place = active_columns(states, b, rows.actions[b], layout, columns), 0
        for i in range(len(layout.outputs)):
            value = factors[b, i]
            probability = rows.probs[b, i, value]
            if not trusted(rows, b, i, group, certain):
                _condition(b, i, rows, group, n_columns, work)
                probability = work.factor.given[value]
            result[b] += math.log(probability) if probability > 0.0 else -np.inf
            n_columns = add_next(states, b, i, value, group, columns, n_columns, place)
            place = next_place(states, b, i, layout, place)


@compiled
def _independent(probs: Floats, outputs: Ints, p: Particles, grid: Grid, out: Outcomes) -> int:
    n_rows, n_outputs, n_grid = probs.shape[0], probs.shape[1], grid[0]
    base, still_open = np.empty(n_outputs, dtype=np.int64), np.empty(n_outputs, dtype=np.int64)
    values = np.empty(probs.shape[2], dtype=np.float64)
    total = 0
    for b in range(n_rows):
        n_open = 0
        settle(probs, b, outputs, base)
        begin(p, n_grid, _fits(probs, b, outputs, base, n_grid), 0)  # no state is known
        for i in range(n_outputs):
            if base[i] >= 0:
                continue
            for k in range(outputs[i]):
                values[k] = probs[b, i, k]
            prune(values, outputs[i])
            still_open[n_open] = i
            share_out(p, -1, i, n_open, values, outputs[i], i == n_outputs - 1, grid)
            n_open += 1
        out.counts[b] = write(p, base, still_open, n_open, n_grid, total, out)
        total += out.counts[b]
    return total


@compiled
def _fits(probs: Floats, b: int, outputs: Ints, base: Ints, n_grid: int) -> bool:
    """Whether all outcomes of row b can be listed, given the factors that are open in ``base`` [O]."""
    n = 1
    for i in range(len(outputs)):
        if base[i] < 0:
            top, possible = probs[b, i].max(), 0
            for k in range(outputs[i]):
                possible += int(probs[b, i, k] >= NEGLIGIBLE * top)
            n *= possible
            if n > n_grid:
                return False
    return True


class CausalWork(Struct):
    """Work space for the successors of one row.

    Attributes:
        p: particles.
        base: value of each factor if it is the only possible one, else -1, int64 [O].
        open: the other factors, int64 [O].
        active: indices of the input columns that are 1, int64 [O + n_steps].
        columns: indices of further columns that are 1, int64 [O].
        sums: input of one group, shared by all particles; and of one particle, [2, G].
        factor: of one factor.
    """

    p: Particles
    base: Ints
    open: Ints
    active: Ints
    columns: Ints
    sums: Floats32
    factor: FactorWork


@compiled
def _causal(rows: Rows, group: GroupWeights, certain: float, work: CausalWork, grid: Grid, out: Outcomes) -> int:
    """Writes the successors of all rows to ``out``; returns their number."""
    layout, probs, p, base, values = group.layout, rows.probs, work.p, work.base, work.factor.given
    n_outputs, n_grid, total = probs.shape[1], grid[0], 0
    for b in range(len(rows.states)):
        n_active = active_columns(rows.states, b, rows.actions[b], layout, work.active)
        n_open, possible = 0, 1
        settle(probs, b, layout.outputs, base)
        for i in range(n_outputs):
            if not trusted(rows, b, i, group, certain):
                base[i] = -1
            possible = min(possible * (layout.outputs[i] if base[i] < 0 else 1), n_grid + 1)
        begin(p, n_grid, possible <= n_grid, place_of(rows.states[b]))
        for i in range(n_outputs):
            n, trust = layout.outputs[i], trusted(rows, b, i, group, certain)
            if base[i] >= 0:
                continue
            work.open[n_open] = i
            if trust:
                values[:] = probs[b, i]
                prune(values, n)
                share_out(p, -1, i, n_open, values, n, i == n_outputs - 1, grid)
            else:
                _known_input(i, n_active, group, work)
            n_main, n_strata = p.state[MAIN], p.state[STRATA]
            for j in range(0 if trust else n_main + n_strata):
                slot = n_grid + j if j < n_strata else j - n_strata  # strata first
                copy_row(work.sums, 0, work.sums, 1)
                n_columns = _open_columns(slot, n_open, group, work)
                add_columns(group.columns, group.group_of[i], work.columns, n_columns, work.sums, 1)
                finish(b, i, rows, group, work.sums, 1, work.factor)
                prune(values, n)
                share_out(p, slot, i, n_open, values, n, i == n_outputs - 1, grid)
            n_open += 1
        out.counts[b] = write(p, base, work.open, n_open, n_grid, total, out)
        total += out.counts[b]
    return total


@compiled
def _known_input(i: int, n_active: int, group: GroupWeights, work: CausalWork) -> None:
    """Writes to ``sums[0]`` the input to factor i's group that a row's particles share, from (s, a) and settled factors."""
    layout, base, columns, g, n = group.layout, work.base, work.columns, group.group_of[i], 0
    for j in range(i):
        if base[j] >= 0 and (layout.outputs[j] != 2 or base[j] == 1):
            columns[n] = group.next_start + layout.start[j] + (0 if layout.outputs[j] == 2 else base[j])
            n += 1
    copy_row(group.bias, g, work.sums, 0)
    add_columns(group.columns, g, work.active, n_active, work.sums, 0)
    add_columns(group.columns, g, columns, n, work.sums, 0)


@compiled
def _open_columns(slot: int, n_open: int, group: GroupWeights, work: CausalWork) -> int:
    """Writes the columns that are 1 for the open factors of the particle in ``slot``; returns their number."""
    layout, n = group.layout, 0
    for w in range(n_open):
        j, value = work.open[w], work.p.factors[slot, w]
        if layout.outputs[j] != 2 or value == 1:
            work.columns[n] = group.next_start + layout.start[j] + (0 if layout.outputs[j] == 2 else value)
            n += 1
    return n


def independent_successors(probs: Floats, outputs: Ints, n_samples: int, seed: int) -> Successors:
    """Successors under independent factors.

    Args:
        probs: float64 [B, O, K], each factor's distribution.
        outputs: int64 [O], cardinalities; the last factor is ``terminated``.
        n_samples: grid points n per row.
        seed: seed of the grid's offset and of new random numbers.
    """
    p = new_particles(n_samples, probs.shape[1], probs.shape[2])

    def write_rows(rows: slice, grid: Grid, out: Outcomes) -> int:
        return _independent(probs[rows], outputs, p, grid, out)

    return listed(len(probs), n_samples, len(outputs), seed, write_rows)


def causal_successors(rows: Rows, group: GroupWeights, certain: float, n_samples: int, seed: int) -> Successors:
    """Successors under a compiled causal conditioner.

    Arguments as in ``sample_causal``; ``n_samples`` and ``seed`` as in ``independent_successors``.
    """
    n_outputs, n_values = rows.probs.shape[1:]
    work = CausalWork(
        new_particles(n_samples, n_outputs, n_values),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs + group.layout.n_steps, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty((2, group.bias.shape[1]), dtype=np.float32),
        factor_work(group),
    )

    def write_rows(some: slice, grid: Grid, out: Outcomes) -> int:
        part = Rows(rows.states[some], rows.actions[some], rows.logits[some], rows.probs[some])
        return _causal(part, group, certain, work, grid, out)

    return listed(len(rows.states), n_samples, n_outputs, seed, write_rows)
