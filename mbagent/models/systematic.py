"""Successors for planning: systematic draws through the ancestral inverse distribution function, equal ones merged.

A row starts as one *particle* that holds the n grid points (j + offset) / n of [0, 1). At each factor the
particle's interval is split in proportion to P(y_i | s, a, y_<i) and its points go to the parts; parts without a
point are dropped. So work grows with the number of different outcomes and not with n, no outcome of probability 2 /
n or more is missed, and an outcome's expected share of the points is its probability. The offset is the same for
all rows: two actions, or two states, differ by their effects and not by luck. A particle down to a single point
goes on with fresh numbers, hashed from (seed, point, factor), for its interval would soon be too narrow for a
float. Shapes: B batch, F state factors, O = F + 1 output factors, K largest cardinality, n points a row, M
successors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from mbagent.models.arithmetic import Floats, Floats32, Ints, add_columns, copy_row
from mbagent.models.base import Successors
from mbagent.models.kernels import (
    GroupWeights,
    Layout,
    active_columns,
    finish,
    trusted,
)
from mbagent.models.particles import (
    NEGLIGIBLE,
    Found,
    assemble,
    begin,
    new_particles,
    prune,
    room,
    rows_at_once,
    settle,
    split,
    start,
    used,
    write,
)
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import derive, uniforms

Conditional: TypeAlias = Callable[[int, Ints, Ints], Floats]
"""(factor i, row of each particle [P], outcomes so far [P, O]) -> P(y_i | s, a, y_<i), float64 [P, cardinality of i]."""


@compiled
def _independent(probs: Floats, outputs: Ints, n_grid: int, key: np.uint64, offset: float) -> Found:
    n_rows, n_outputs = probs.shape[0], probs.shape[1]
    p, found = new_particles(n_grid, n_outputs), room(n_rows, n_grid, n_outputs)
    base, still_open = np.empty(n_outputs, dtype=np.int64), np.empty(n_outputs, dtype=np.int64)
    values = np.empty(probs.shape[2], dtype=np.float64)
    total = 0
    for b in range(n_rows):
        n_live, n_open = begin(p, n_grid), 0
        settle(probs, b, outputs, base)
        for i in range(n_outputs):
            if base[i] >= 0:
                continue
            for k in range(outputs[i]):
                values[k] = probs[b, i, k]
            prune(values, outputs[i])
            still_open[n_open] = i
            for q in range(n_live):
                n_live = split(p, q, n_live, i, n_open, values, outputs[i], n_grid, key, offset)
            n_open += 1
        found[0][b] = n_live
        write(p, n_live, base, still_open, n_open, total, found)
        total += n_live
    return used(found, total)


@compiled
def _causal(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    n_grid: int,
    key: np.uint64,
    offset: float,
) -> Found:
    n_outputs = probs.shape[1]
    p, found = new_particles(n_grid, n_outputs), room(len(states), n_grid, n_outputs)
    base, still_open, columns = np.empty((3, n_outputs), dtype=np.int64)
    active = np.empty(n_outputs + layout.n_steps, dtype=np.int64)
    sums = np.empty((2, group.bias.shape[1]), dtype=np.float32)  # of what all particles share; of one particle
    row_logits, hidden = np.empty(probs.shape[2], dtype=np.float32), np.empty((1, group.bias.shape[1]), dtype=np.float32)
    values, total = np.empty(probs.shape[2], dtype=np.float64), 0
    for b in range(len(states)):
        n_active = active_columns(states, b, actions[b], layout, active)
        n_live, n_open = begin(p, n_grid), 0
        settle(probs, b, layout.outputs, base)
        for i in range(n_outputs):
            n, trust = layout.outputs[i], group.group_of[i] < 0 or trusted(probs, b, i, layout, group, certain)
            if trust and base[i] >= 0:
                continue
            base[i], still_open[n_open] = -1, i
            if not trust:
                _known_input(i, base, active, n_active, layout, group, columns, sums)
            for q in range(n_live):
                if trust:
                    values[:] = probs[b, i]
                else:
                    copy_row(sums, 0, sums, 1)
                    n_columns = _open_columns(p.factors, q, still_open, n_open, layout, group, columns)
                    add_columns(group.columns, group.group_of[i], columns, n_columns, sums, 1)
                    finish(b, i, logits, layout, group, sums, 1, hidden, row_logits, values)
                prune(values, n)
                n_live = split(p, q, n_live, i, n_open, values, n, n_grid, key, offset)
            n_open += 1
        found[0][b] = n_live
        write(p, n_live, base, still_open, n_open, total, found)
        total += n_live
    return used(found, total)


@compiled
def _known_input(
    i: int, base: Ints, active: Ints, n_active: int, layout: Layout, group: GroupWeights, columns: Ints, sums: Floats32
) -> None:
    """Writes to ``sums[0]`` what factor i's group gets in all particles of a row: from (s, a), and earlier factors they share."""
    g, n = group.group_of[i], 0
    for j in range(i):
        if base[j] >= 0 and (layout.outputs[j] != 2 or base[j] == 1):
            columns[n] = group.next_start + layout.start[j] + (0 if layout.outputs[j] == 2 else base[j])
            n += 1
    copy_row(group.bias, g, sums, 0)
    add_columns(group.columns, g, active, n_active, sums, 0)
    add_columns(group.columns, g, columns, n, sums, 0)


@compiled
def _open_columns(
    factors: Ints, q: int, still_open: Ints, n_open: int, layout: Layout, group: GroupWeights, columns: Ints
) -> int:
    """Writes the columns that are 1 by the open factors of particle ``q``; returns how many."""
    n = 0
    for w in range(n_open):
        j, value = still_open[w], factors[q, w]
        if layout.outputs[j] != 2 or value == 1:
            columns[n] = group.next_start + layout.start[j] + (0 if layout.outputs[j] == 2 else value)
            n += 1
    return n


def independent_successors(probs: Floats, outputs: Ints, n_samples: int, seed: int) -> Successors:
    """Successors under independent factors.

    Args:
        probs: float64 [B, O, K], each factor's distribution.
        outputs: int64 [O], cardinalities; the last factor is ``terminated``.
        n_samples: grid points n a row.
        seed: which grid offset and fresh numbers.
    """
    key, offset = start(seed)
    step = rows_at_once(n_samples, len(outputs))
    parts = [_independent(probs[b : b + step], outputs, n_samples, key, offset) for b in range(0, len(probs), step)]
    return assemble(parts, n_samples, len(outputs))


def causal_successors(
    states: Ints,
    actions: Ints,
    logits: Floats32,
    probs: Floats,
    layout: Layout,
    group: GroupWeights,
    certain: float,
    n_samples: int,
    seed: int,
) -> Successors:
    """Successors under a compiled causal conditioner.

    Arguments are those of ``samplers.sample_causal``, and ``n_samples`` and ``seed`` as above.
    """
    key, offset = start(seed)
    step = rows_at_once(n_samples, len(layout.outputs))
    parts = []
    for b in range(0, len(states), step):
        given = (states[b : b + step], actions[b : b + step], logits[b : b + step], probs[b : b + step])
        parts.append(_causal(*given, layout, group, certain, n_samples, key, offset))
    return assemble(parts, n_samples, len(layout.outputs))


def ancestral_successors(n_rows: int, outputs: Ints, conditional: Conditional, n_samples: int, seed: int) -> Successors:
    """Successors under any conditioner with exact ancestral probabilities, factor by factor for all rows at once.

    Args:
        n_rows: number of rows B.
        outputs: int64 [O], cardinalities; the last factor is ``terminated``.
        conditional: the distribution of a factor given those before it.
        n_samples: grid points n a row.
        seed: which grid offset and fresh numbers.
    """
    key, offset = start(seed)
    row, first = np.arange(n_rows), np.zeros(n_rows, dtype=np.int64)
    points, mass = np.full(n_rows, n_samples, dtype=np.int64), np.ones(n_rows)
    low, high = np.zeros(n_rows), np.ones(n_rows)
    factors = np.zeros((n_rows, len(outputs)), dtype=np.int64)
    for i in range(len(outputs)):
        probs = conditional(i, row, factors)
        probs = np.where(probs < NEGLIGIBLE * probs.max(axis=1, keepdims=True), 0.0, probs)
        probs /= probs.sum(axis=1, keepdims=True)
        ends = low[:, None] + (high - low)[:, None] * np.cumsum(probs, axis=1)
        last = outputs[i] - 1 - np.argmax(probs[:, ::-1] > 0.0, axis=1)
        upto = np.clip(np.ceil(ends * n_samples - offset).astype(np.int64) - first[:, None], 0, points[:, None])
        upto[np.arange(int(outputs[i])) >= last[:, None]] = np.repeat(points, outputs[i] - last)
        taken = np.diff(upto, axis=1, prepend=0)
        fresh = uniforms(derive(np.full(len(row), key), first), len(outputs))[:, i]
        drawn = np.minimum((np.cumsum(probs, axis=1) <= fresh[:, None]).sum(axis=1), last)
        taken[points == 1] = np.arange(int(outputs[i])) == drawn[points == 1, None]
        q, value = np.nonzero(taken)
        single = points[q] == 1
        low, high = ends[q, value] - (high - low)[q] * probs[q, value], ends[q, value]
        first = np.where(single, first[q], first[q] + upto[q, value] - taken[q, value])
        row, points, mass, factors = row[q], taken[q, value], mass[q] * probs[q, value], factors[q]
        factors[:, i] = value
    counts = np.bincount(row, minlength=n_rows)
    return assemble([(counts, factors[:, :-1], factors[:, -1] == 1, mass, points)], n_samples, len(outputs))
