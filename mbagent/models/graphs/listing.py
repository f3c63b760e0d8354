"""Successors for planning, compiled: systematic draws through the inverse distribution function (see ``systematic.py``).

Shapes: B rows, F factors, U units (the last two are ``terminated`` and the event), Q couplings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Successors
from mbagent.models.graphs.compiled import Graphs, Ints, distributions, show, show_next, show_next_meetings, write
from mbagent.models.graphs.couplings import couple, settle
from mbagent.models.graphs.draws import Work, alone, is_late, settled, work_space
from mbagent.models.graphs.units import Layout
from mbagent.models.particles import Found, Particles, begin, new_particles, prune, room, split, used
from mbagent_envs._compiled import compiled


@compiled
def successors(
    states: Ints, actions: Ints, layout: Layout, graphs: Graphs, late: Graphs, n_grid: int, key: np.uint64, offset: float
) -> Found:
    """The outcomes of each row that ``n_grid`` points find, unit after unit."""
    w, n_units = work_space(layout, graphs, late), len(layout.outputs)
    single = alone(layout, graphs, w.later)
    early = np.concatenate((single[single < n_units - 1], n_units + np.arange(len(layout.exactly))))
    width = n_units + len(layout.exactly)
    p, found = new_particles(n_grid, width), room(len(states), n_grid, states.shape[1] + 1)
    still_open, base = np.empty(width, dtype=np.int64), np.empty(states.shape[1], dtype=np.int64)
    total = 0
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(graphs.changing, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        base[:] = states[b]
        n_live, n_open, ended = begin(p, n_grid), 0, False
        for number in early:
            n, value = _distribution(number, states[b], layout, graphs, w)
            best = settled(w.joint, 0, n)
            if best >= 0:
                if best != value:
                    ended = _put(base, number, best, layout, ended)
                continue
            prune(w.joint, n)
            still_open[n_open] = number
            for q in range(n_live):
                n_live = split(p, q, n_live, number, n_open, w.joint, n, n_grid, key, offset)
            n_open += 1
        if len(late.changing):
            n_live, n_open = _split_late(
                p, n_live, n_open, states[b], actions[b], base, still_open, ended, layout, graphs, late, w, n_grid, key, offset
            )
        _list(p, n_live, n_open, base, still_open, ended, layout, found, b, total)
        total += n_live
    return used(found, total)


@compiled
def _distribution(number: int, state: Ints, layout: Layout, graphs: Graphs, w: Work) -> tuple[int, int]:
    """Writes the distribution of a unit, or of a coupling, to ``w.joint``; returns its size and the present value or -1."""
    n_units = len(layout.outputs)
    if number >= n_units:
        return couple(number - n_units, state, w.rates, w.still, layout, graphs, w.joint) + 1, -1
    n, start = layout.outputs[number], graphs.start[number]
    w.joint[:n] = w.rates[start : start + n]
    return n, w.values[number]


@compiled
def _split_late(
    p: Particles,
    n_live: int,
    n_open: int,
    state: Ints,
    action: int,
    base: Ints,
    still_open: Ints,
    ended: bool,
    layout: Layout,
    graphs: Graphs,
    late: Graphs,
    w: Work,
    n_grid: int,
    key: np.uint64,
    offset: float,
) -> tuple[int, int]:
    """Draws the late units, each given what the particle became so far; returns how many particles and open units there are."""
    following = np.empty_like(base)
    for i in range(len(late.changing)):
        number = late.changing[i]
        n, start = layout.outputs[number], late.start[number]
        if not is_late(number, w.rates, layout, graphs):
            _put(base, number, settled(w.rates, start, n), layout, False)
            continue
        for q in range(n_live):
            _fill(following, base, p, q, still_open, n_open, layout, ended)
            show_next(following, layout, w.on)
            if number == len(layout.outputs) - 2:
                show_next_meetings(following, layout, w.on)
            distributions(late.changing[i : i + 1], state, action, layout, late, w.on, w.values, w.rates)
            w.joint[:n] = w.rates[start : start + n]
            prune(w.joint, n)
            n_live = split(p, q, n_live, number, n_open, w.joint, n, n_grid, key, offset)
        still_open[n_open] = number
        n_open += 1
    return n_live, n_open


@compiled
def _list(
    p: Particles,
    n_live: int,
    n_open: int,
    base: Ints,
    still_open: Ints,
    ended: bool,
    layout: Layout,
    found: Found,
    b: int,
    total: int,
) -> None:
    """Writes the outcomes of row b from number ``total`` on."""
    counts, following, terminated, mass, points = found
    counts[b] = n_live
    for q in range(n_live):
        terminated[total + q] = _fill(following[total + q], base, p, q, still_open, n_open, layout, ended)
        mass[total + q], points[total + q] = p.mass[q], p.points[q]


@compiled
def _fill(state: Ints, base: Ints, p: Particles, q: int, still_open: Ints, n_open: int, layout: Layout, ended: bool) -> bool:
    """Writes the next state that a particle stands for; returns whether the episode is over."""
    state[:] = base
    over = ended
    for v in range(n_open):
        over = _put(state, still_open[v], p.factors[q, v], layout, over)
    return over


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


def mixed(usual: Successors, event: Successors, happens: NDArray[np.int64], rates: NDArray[np.float64]) -> Successors:
    """Both kinds of successors; row ``happens[j]`` of ``usual`` is row j of ``event``, which has the share ``rates`` of it."""
    rows = np.concatenate([usual.rows, happens[event.rows]])
    share = rates.copy()
    share[np.setdiff1d(np.arange(len(rates)), happens)] = 0.0
    weights = np.concatenate([usual.probabilities * (1.0 - share)[usual.rows], event.probabilities * share[happens[event.rows]]])
    kept = weights > 0.0
    order = np.argsort(rows[kept], kind="stable")
    index = np.flatnonzero(kept)[order]
    states = np.concatenate([usual.states, event.states])[index]
    terminated = np.concatenate([usual.terminated, event.terminated])[index]
    counts = np.bincount(rows[index], minlength=len(rates))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, states, terminated, weights[index])
