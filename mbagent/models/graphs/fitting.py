"""Fitting decision graphs to transitions: units, rare events, questions, splits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs import draws
from mbagent.models.graphs.compiled import Graphs, build, habit_of
from mbagent.models.graphs.exclusive import find_cliques, find_groups
from mbagent.models.graphs.greedy import find_splits
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import (
    Layout,
    Question,
    ask,
    column_kinds,
    column_table,
    coupled_layout,
    is_lone_bit,
    lay_out,
    unit_values,
)
from mbagent.transitions import TransitionBatch

Bools: TypeAlias = NDArray[np.bool_]

SOME_ROWS = 4000
"""Rows on which it is looked at how often bits should be on together."""


@dataclass(frozen=True)
class Fitted:
    """What was found.

    Attributes:
        layout: the units.
        usual: graphs of all units, and of whether the event happens.
        event: graphs of what happens in an event; as ``usual`` where there is none.
        has_event: whether there is one.
        asked, found: questions and splits behind ``usual``.
    """

    layout: Layout
    usual: Graphs
    event: Graphs
    has_event: bool
    asked: Sequence[Question]
    found: Sequence[Search]


def fit_graphs(
    cardinalities: Sequence[int], n_actions: int, rows: TransitionBatch, events: Bools, in_pairs: bool = True
) -> Fitted:
    """Fits everything.

    Args:
        cardinalities: number of values of each factor.
        n_actions: number of actions A.
        rows: N transitions.
        events: which of them are rare events, bool [N].
        in_pairs: whether to look for causes that matter only together, which takes most of the time.
    """
    groups = find_groups(cardinalities, rows.states, rows.next_states, ~events)
    layout = lay_out(cardinalities, groups, n_actions)
    now, then = (
        _values(layout, rows.states, rows, events, before=True),
        _values(layout, rows.next_states, rows, events, before=False),
    )
    usual, everything = np.flatnonzero(~events), np.arange(len(rows))
    last = len(layout.outputs) - 1
    asked_of = {unit: everything if unit == last else usual for unit in range(last + 1)}
    regime = _graphs(layout, rows, now, then, asked_of, usual, True, in_pairs)
    layout = _coupled(layout, regime[0], rows)
    if not events.any():
        return Fitted(layout, regime[0], regime[0], False, *regime[1:])
    rare = np.flatnonzero(events)
    event = _graphs(layout, rows, now, then, dict.fromkeys(range(last), rare), rare, False, in_pairs)
    return Fitted(layout, regime[0], event[0], True, *regime[1:])


def _coupled(layout: Layout, graphs: Graphs, rows: TransitionBatch) -> Layout:
    """The layout with those bits coupled that are never on together, though each for itself might be."""
    bits = graphs.changing[is_lone_bit(layout)[graphs.changing]]
    if len(bits) < 2 or len(rows) == 0:
        return layout
    factors = layout.members[layout.first[bits]]
    on = rows.next_states[:, factors].astype(np.float32)
    some = np.linspace(0, len(rows) - 1, min(len(rows), SOME_ROWS)).astype(np.int64)
    start = np.concatenate([[0], np.cumsum(_cardinalities(layout))]).astype(np.int64)
    probs = np.empty((len(some), int(start[-1])))
    draws.marginals(rows.states[some], rows.actions[some], layout, graphs, start, probs)
    ones = probs[:, start[factors] + 1]
    expected = ones.T @ ones * (len(rows) / len(some))
    return coupled_layout(layout, [bits[c] for c in find_cliques(np.rint(on.T @ on).astype(np.int64), expected)])


def _cardinalities(layout: Layout) -> NDArray[np.int64]:
    """Number of values of each factor."""
    cardinalities = np.full(layout.n_factors, 2, dtype=np.int64)
    lone = np.flatnonzero(np.diff(layout.first) == 1)
    cardinalities[layout.members[layout.first[lone]]] = layout.outputs[lone]
    return cardinalities


def _values(
    layout: Layout, states: NDArray[np.int64], rows: TransitionBatch, events: Bools, *, before: bool
) -> NDArray[np.int64]:
    """Values of all units, int64 [N, U], before or after the step."""
    flags = np.zeros((len(rows), 2), dtype=np.int64)
    if not before:
        flags[:, 0], flags[:, 1] = rows.terminated, events
    return np.concatenate([unit_values(layout, states), flags], axis=1)


def _graphs(
    layout: Layout,
    rows: TransitionBatch,
    now: NDArray[np.int64],
    then: NDArray[np.int64],
    asked_of: dict[int, NDArray[np.int64]],
    seen: NDArray[np.int64],
    regular: bool,
    in_pairs: bool,
) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of some units, each asked of some rows; ``seen`` are the rows of this regime.

    In a ``regular`` regime units that never changed are all taken together for how likely they are to change; where
    anything may change, each for itself.
    """
    outputs, actions = layout.outputs, rows.actions
    asked = [
        question
        for unit, which in asked_of.items()
        for question in ask(unit, int(outputs[unit]), actions, now[:, unit], then[:, unit], which)
    ]
    changing = (rows.states[seen] != rows.next_states[seen]).any(axis=0)
    kinds = column_kinds(layout, rows.states[seen], changing)
    found = find_splits([q.head for q in asked], column_table(layout, rows.states, actions), kinds, layout.n_actions, in_pairs)
    habits = [
        habit_of(int(cardinality), layout.n_actions, actions[seen], now[seen, unit], then[seen, unit])
        for unit, cardinality in enumerate(outputs)
    ]
    still = 0.5 / (len(seen) * (len(outputs) if regular else 1) + 1.0)
    return build(layout, asked, found, habits, still), asked, found
