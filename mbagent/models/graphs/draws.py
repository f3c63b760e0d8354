"""Drawing from decision graphs, compiled: next states, probabilities, and successors for planning.

Shapes: B batch, F factors, U units (the last two are ``terminated`` and the event), D columns.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.compiled import Bools, Floats, Graphs, Ints, distribution, read, show, write
from mbagent.models.graphs.units import Layout
from mbagent.models.particles import NEGLIGIBLE, Found, begin, new_particles, prune, room, split, used
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import uniform_at

Keys: TypeAlias = NDArray[np.uint64]


@compiled
def event_rates(states: Ints, actions: Ints, layout: Layout, graphs: Graphs) -> Floats:
    """Probability of the event, [B]."""
    rates = np.empty(len(states), dtype=np.float64)
    on, out = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_), np.empty(2, dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        distribution(len(layout.outputs) - 1, 0, actions[b], layout, graphs, on, out)
        rates[b] = out[1]
    return rates


@compiled
def sample(states: Ints, actions: Ints, keys: Keys, layout: Layout, graphs: Graphs, following: Ints, terminated: Bools) -> None:
    """Draws next states into ``following`` [B, F] and ``terminated`` [B], unit u of row b at number u of key b.

    ``following`` holds a copy of ``states``.
    """
    on = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_)
    probs = np.empty(layout.outputs.max(), dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        terminated[b] = False
        for unit in graphs.changing:
            value = read(states[b], unit, layout)
            distribution(unit, value, actions[b], layout, graphs, on, probs)
            u, chosen = uniform_at(keys[b], unit), value
            for k in range(layout.outputs[unit]):
                if probs[k] > 0.0:
                    chosen = k
                    u -= probs[k]
                    if u < 0.0:
                        break
            if unit == len(layout.outputs) - 2:
                terminated[b] = chosen == 1
            elif chosen != value:
                write(following[b], unit, chosen, layout)


@compiled
def likeliest(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, following: Ints, terminated: Bools) -> None:
    """As ``sample``, with each unit's likeliest value."""
    on = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_)
    probs = np.empty(layout.outputs.max(), dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        terminated[b] = False
        for unit in graphs.changing:
            value = read(states[b], unit, layout)
            distribution(unit, value, actions[b], layout, graphs, on, probs)
            chosen = int(np.argmax(probs[: layout.outputs[unit]]))
            if unit == len(layout.outputs) - 2:
                terminated[b] = chosen == 1
            elif chosen != value:
                write(following[b], unit, chosen, layout)


@compiled
def log_prob(states: Ints, actions: Ints, following: Ints, terminated: Bools, layout: Layout, graphs: Graphs) -> Floats:
    """Log-probability [B] of next states [B, F] and ends [B]."""
    result = np.zeros(len(states), dtype=np.float64)
    on = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_)
    probs = np.empty(layout.outputs.max(), dtype=np.float64)
    other = np.empty(states.shape[1], dtype=np.int64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        other[:] = states[b]
        for unit in range(len(layout.outputs) - 1):
            now = read(states[b], unit, layout)
            then = int(terminated[b]) if unit == len(layout.outputs) - 2 else read(following[b], unit, layout)
            distribution(unit, now, actions[b], layout, graphs, on, probs)
            result[b] += math.log(probs[then]) if probs[then] > 0.0 else -math.inf
            if unit < len(layout.outputs) - 2:
                write(other, unit, then, layout)
        if not (other == following[b]).all():  # a group with no bit on, or with several
            result[b] = -math.inf
    return result


@compiled
def marginals(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, start: Ints, out: Floats) -> None:
    """Writes each factor's distribution to ``out`` [B, sum of cardinalities]; factor f's begins at ``start[f]``."""
    on = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_)
    probs = np.empty(layout.outputs.max(), dtype=np.float64)
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        for unit in range(len(layout.outputs) - 2):
            first, last = layout.first[unit], layout.first[unit + 1]
            distribution(unit, read(states[b], unit, layout), actions[b], layout, graphs, on, probs)
            for k in range(layout.outputs[unit]):
                if last - first == 1:
                    out[b, start[layout.members[first]] + k] = probs[k]
                else:
                    out[b, start[layout.members[first + k]]] = 1.0 - probs[k]
                    out[b, start[layout.members[first + k]] + 1] = probs[k]


@compiled
def successors(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, n_grid: int, key: np.uint64, offset: float) -> Found:
    """Systematic draws through the inverse distribution function, unit after unit; see ``systematic.py``."""
    n_units, n_factors = len(layout.outputs), states.shape[1]
    p, found = new_particles(n_grid, n_units), room(len(states), n_grid, n_factors + 1)
    still_open, base = np.empty(n_units, dtype=np.int64), np.empty(n_factors, dtype=np.int64)
    on = np.empty(len(layout.factor) + layout.n_actions, dtype=np.bool_)
    probs = np.empty(layout.outputs.max(), dtype=np.float64)
    total = 0
    for b in range(len(states)):
        show(states[b], actions[b], layout, on)
        n_live, n_open, ended = begin(p, n_grid), 0, False
        base[:] = states[b]
        for unit in graphs.changing:
            if unit == n_units - 1:
                continue
            n, value = layout.outputs[unit], read(states[b], unit, layout)
            distribution(unit, value, actions[b], layout, graphs, on, probs)
            best = _settled(probs, n)
            if best < 0:
                prune(probs, n)
                still_open[n_open] = unit
                for q in range(n_live):
                    n_live = split(p, q, n_live, unit, n_open, probs, n, n_grid, key, offset)
                n_open += 1
            elif unit == n_units - 2:
                ended = best == 1
            elif best != value:
                write(base, unit, best, layout)
        counts, following, terminated, mass, points = found
        counts[b] = n_live
        for q in range(n_live):
            following[total + q], terminated[total + q] = base, ended
            mass[total + q], points[total + q] = p.mass[q], p.points[q]
            for w in range(n_open):
                if still_open[w] == n_units - 2:
                    terminated[total + q] = p.factors[q, w] == 1
                else:
                    write(following[total + q], still_open[w], p.factors[q, w], layout)
        total += n_live
    return used(found, total)


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
