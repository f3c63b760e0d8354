"""Decision graphs inside compiled search where some units are drawn late, or rare events happen: every unit is asked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.models.compiled_model import Outcomes, implements, outcomes, work_for
from mbagent.models.graphs import expanding as expanding  # its overloads
from mbagent.models.graphs.compiled import Bools, Floats, Graphs, Ints, distributions, n_columns, show
from mbagent.models.graphs.ending import ends_late_only
from mbagent.models.graphs.fitting import Fitted, nothing_late
from mbagent.models.graphs.laws import leave_out
from mbagent.models.graphs.lean import Lean, lean
from mbagent.models.graphs.listing import event_draws, successors
from mbagent.models.graphs.units import Layout
from mbagent_envs._compiled import compiled


class WholeKernel(NamedTuple):
    """Decision graphs for compiled search, where some units are drawn late, or rare events happen.

    Attributes:
        layout, usual, late, event: see ``fitting.Fitted``; for planning.
        event_late: graphs of nothing.
        has_event: whether there are rare events.
    """

    layout: Layout
    usual: Graphs
    late: Graphs
    event: Graphs
    event_late: Graphs
    has_event: bool


def kernel_of(fitted: Fitted, cardinalities: tuple[int, ...]) -> Lean | WholeKernel:
    """The kernel of fitted graphs for planning: the lean one where it says everything."""
    if not fitted.has_event and ends_late_only(fitted.layout, fitted.late):
        return lean(fitted.layout, fitted.usual, fitted.late, cardinalities)
    none = nothing_late(fitted.event)
    return WholeKernel(fitted.layout, fitted.usual, fitted.late, fitted.event, none, bool(fitted.has_event))


class WholeWork(NamedTuple):
    """Work space.

    Attributes:
        on: columns, bool [D].
        values: of the units, int64 [U].
        rates: their distributions, [sum of cardinalities].
        actions: int64 [A].
        states: int64 [1, F].
        event: number of the event's unit, int64 [1].
    """

    on: Bools
    values: Ints
    rates: Floats
    actions: Ints
    states: Ints
    event: Ints


@implements(work_for, WholeKernel)
@compiled
def whole_work(kernel: WholeKernel, n_grid: int) -> WholeWork:
    """See compiled_model."""
    layout = kernel.layout
    return WholeWork(
        np.empty(n_columns(layout), dtype=np.bool_),
        np.empty(len(layout.outputs), dtype=np.int64),
        np.empty(kernel.usual.start[-1], dtype=np.float64),
        np.arange(len(layout.acts.way)),
        np.empty((1, layout.n_factors), dtype=np.int64),
        np.array([len(layout.outputs) - 1]),
    )


@implements(outcomes, WholeKernel)
@compiled
def whole_outcomes(
    kernel: WholeKernel, work: WholeWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See compiled_model; every unit is asked."""
    layout, graphs, states, actions, total = kernel.layout, kernel.usual, work.states, work.actions, 0
    states[:] = state
    for action in range(len(layout.acts.way)):
        rate, a = 0.0, action
        if kernel.has_event:
            show(state, action, layout, work.on)
            distributions(work.event, state, action, layout, graphs, work.on, work.values, work.rates)
            rate = work.rates[graphs.start[-1] - 1]
        draws, n, out.left_out[action] = event_draws(rate, n_grid), 0, 0.0
        if rate < 1.0:
            grid = (max(1, n_grid - draws), key, offset)
            found = successors(states[:1], actions[a : a + 1], layout, graphs, kernel.late, grid)
            n = _take(found[1], found[2], found[3], 1.0 - rate, total, out)
            out.left_out[action] += (1.0 - rate) * found[4][0]
        if rate > 0.0:
            grid = (draws, key, offset)
            found = successors(states[:1], actions[a : a + 1], layout, kernel.event, kernel.event_late, grid)
            n += _take(found[1], found[2], found[3], rate, total + n, out)
            out.left_out[action] += rate * found[4][0]
        if len(layout.counts) or len(layout.met):
            n = _leave_out(layout, state, total, n, out)
        out.counts[action] = n
        total += n
    return total


@compiled
def _leave_out(layout: Layout, state: Ints, first: int, n: int, out: Outcomes) -> int:
    """Takes what breaks a law out of the last ``n`` outcomes; returns how many are left."""
    counts, met, weights, cells = layout.counts, layout.met, layout.weights, layout.cells
    return leave_out(counts, met, weights, cells, state, out.states, out.terminated, out.probabilities, first, n)


@compiled
def _take(states: Ints, terminated: Bools, probabilities: Floats, share: float, total: int, out: Outcomes) -> int:
    """Takes outcomes over, from number ``total`` on, which have a share of all; returns how many."""
    for q in range(len(states)):
        out.states[total + q] = states[q]
        out.terminated[total + q] = terminated[q]
        out.probabilities[total + q] = share * probabilities[q]
    return len(states)
