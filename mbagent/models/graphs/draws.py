"""Drawing from decision graphs, compiled: next states, probabilities, and successors for planning.

Shapes: B batch, F factors, U units (the last two are ``terminated`` and the event), Q couplings, D columns.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.compiled import Bools, Floats, Graphs, Ints, distribution, n_columns, read, show, write
from mbagent.models.graphs.couplings import chances, couple, settle, which, widest
from mbagent.models.graphs.units import Layout
from mbagent.models.particles import NEGLIGIBLE, Found, begin, new_particles, prune, room, split, used
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import uniform_at

Keys: TypeAlias = NDArray[np.uint64]


@compiled
def event_rates(states: Ints, actions: Ints, layout: Layout, graphs: Graphs) -> Floats:
    """Probability of the event, [B]."""
    rates = np.empty(len(states), dtype=np.float64)
    on, out = np.empty(n_columns(layout), dtype=np.bool_), np.empty(2, dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        distribution(len(layout.outputs) - 1, 0, actions[b], layout, graphs, on, out)
        rates[b] = out[1]
    return rates


@compiled
def _pick(probs: Floats, n: int, u: float, start: int) -> int:
    """Index drawn from the first ``n`` of ``probs``, or the likeliest where ``u`` is negative; ``start`` where all are 0."""
    if u < 0.0:
        return int(np.argmax(probs[:n]))
    chosen = start
    for k in range(n):
        if probs[k] > 0.0:
            chosen = k
            u -= probs[k]
            if u < 0.0:
                break
    return chosen


@compiled
def sample(
    states: Ints, actions: Ints, keys: Keys, greedy: bool, layout: Layout, graphs: Graphs, following: Ints, terminated: Bools
) -> None:
    """Draws next states into ``following`` [B, F] and ``terminated`` [B], unit u of row b at number u of key b.

    ``following`` holds a copy of ``states``; ``greedy`` takes the likeliest value each time instead.
    """
    n_units, n_couplings = len(layout.outputs), len(layout.exactly)
    on, rates = np.empty(n_columns(layout), dtype=np.bool_), np.empty(n_units, dtype=np.float64)
    probs = np.empty(widest(layout), dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        terminated[b] = False
        for unit in graphs.changing:
            if layout.coupling_of[unit] >= 0:
                continue
            value = read(states[b], unit, layout)
            distribution(unit, value, actions[b], layout, graphs, on, probs)
            chosen = _pick(probs, layout.outputs[unit], -1.0 if greedy else uniform_at(keys[b], unit), value)
            if unit == n_units - 2:
                terminated[b] = chosen == 1
            elif chosen != value:
                write(following[b], unit, chosen, layout)
        chances(states[b], actions[b], layout, graphs, on, rates)
        for q in range(n_couplings):
            n = couple(q, rates, layout, probs)
            settle(following[b], q, _pick(probs, n + 1, -1.0 if greedy else uniform_at(keys[b], n_units + q), n), layout)


@compiled
def log_prob(states: Ints, actions: Ints, following: Ints, terminated: Bools, layout: Layout, graphs: Graphs) -> Floats:
    """Log-probability [B] of next states [B, F] and ends [B]."""
    n_units = len(layout.outputs)
    result = np.zeros(len(states), dtype=np.float64)
    on, rates = np.empty(n_columns(layout), dtype=np.bool_), np.empty(n_units, dtype=np.float64)
    probs = np.empty(widest(layout), dtype=np.float64)
    other = np.empty(states.shape[1], dtype=np.int64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        other[:] = states[b]
        for unit in range(n_units - 1):
            if layout.coupling_of[unit] >= 0:
                continue
            now = read(states[b], unit, layout)
            then = int(terminated[b]) if unit == n_units - 2 else read(following[b], unit, layout)
            distribution(unit, now, actions[b], layout, graphs, on, probs)
            result[b] += math.log(probs[then]) if probs[then] > 0.0 else -math.inf
            if unit < n_units - 2:
                write(other, unit, then, layout)
        chances(states[b], actions[b], layout, graphs, on, rates)
        for q in range(len(layout.exactly)):
            couple(q, rates, layout, probs)
            then = which(following[b], q, layout)
            result[b] += math.log(probs[then]) if then >= 0 and probs[then] > 0.0 else -math.inf
            settle(other, q, then, layout)
        if not (other == following[b]).all():  # a group with no bit on, or with several
            result[b] = -math.inf
    return result


@compiled
def marginals(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, start: Ints, out: Floats) -> None:
    """Writes each factor's distribution to ``out`` [B, sum of cardinalities]; factor f's begins at ``start[f]``."""
    n_units = len(layout.outputs)
    on, rates = np.empty(n_columns(layout), dtype=np.bool_), np.empty(n_units, dtype=np.float64)
    probs = np.empty(widest(layout), dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        for unit in range(n_units - 2):
            if layout.coupling_of[unit] >= 0:
                continue
            first, last = layout.first[unit], layout.first[unit + 1]
            distribution(unit, read(states[b], unit, layout), actions[b], layout, graphs, on, probs)
            for k in range(layout.outputs[unit]):
                if last - first == 1:
                    out[b, start[layout.members[first]] + k] = probs[k]
                else:
                    _write_bit(out[b], start[layout.members[first + k]], probs[k])
        chances(states[b], actions[b], layout, graphs, on, rates)
        for q in range(len(layout.exactly)):
            n = couple(q, rates, layout, probs)
            for k in range(n):
                factor = layout.members[layout.first[layout.coupled[layout.coupled_first[q] + k]]]
                _write_bit(out[b], start[factor], probs[k])


@compiled
def _write_bit(out: Floats, start: int, p: float) -> None:
    out[start], out[start + 1] = 1.0 - p, p


@compiled
def successors(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, n_grid: int, key: np.uint64, offset: float) -> Found:
    """Systematic draws through the inverse distribution function, unit after unit; see ``systematic.py``."""
    n_units, n_couplings = len(layout.outputs), len(layout.exactly)
    p, found = new_particles(n_grid, n_units + n_couplings), room(len(states), n_grid, states.shape[1] + 1)
    still_open, base = np.empty(n_units + n_couplings, dtype=np.int64), np.empty(states.shape[1], dtype=np.int64)
    on, rates = np.empty(n_columns(layout), dtype=np.bool_), np.empty(n_units, dtype=np.float64)
    probs = np.empty(widest(layout), dtype=np.float64)
    counts, following, terminated, mass, points = found
    total = 0
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        n_live, n_open, ended = begin(p, n_grid), 0, False
        base[:] = states[b]
        chances(states[b], actions[b], layout, graphs, on, rates)
        for i in range(len(graphs.changing) + n_couplings):
            number = graphs.changing[i] if i < len(graphs.changing) else n_units + i - len(graphs.changing)
            if number == n_units - 1 or (number < n_units and layout.coupling_of[number] >= 0):
                continue
            if number < n_units:
                n = layout.outputs[number]
                distribution(number, read(states[b], number, layout), actions[b], layout, graphs, on, probs)
            else:
                n = couple(number - n_units, rates, layout, probs) + 1
            best = _settled(probs, n)
            if best >= 0:
                ended = _put(base, number, best, layout, ended)
                continue
            prune(probs, n)
            still_open[n_open] = number
            for q in range(n_live):
                n_live = split(p, q, n_live, number, n_open, probs, n, n_grid, key, offset)
            n_open += 1
        counts[b] = n_live
        for q in range(n_live):
            following[total + q], over = base, ended
            for w in range(n_open):
                over = _put(following[total + q], still_open[w], p.factors[q, w], layout, over)
            terminated[total + q], mass[total + q], points[total + q] = over, p.mass[q], p.points[q]
        total += n_live
    return used(found, total)


@compiled
def _put(state: Ints, number: int, value: int, layout: Layout, ended: bool) -> bool:
    """Gives a unit or coupling its value in a next state; returns whether the episode is over."""
    n_units = len(layout.outputs)
    if number == n_units - 2:
        return value == 1
    if number >= n_units:
        settle(state, number - n_units, value, layout)
    else:
        write(state, number, value, layout)
    return ended


@compiled
def _settled(probs: Floats, n: int) -> int:
    """The only value worth drawing, or -1."""
    best = 0
    for k in range(1, n):
        if probs[k] > probs[best]:
            best = k
    for k in range(n):
        if k != best and probs[k] >= NEGLIGIBLE * probs[best]:
            return -1
    return best
