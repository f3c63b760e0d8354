"""Fitting decision graphs to transitions: units, rare events, questions, splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs import draws
from mbagent.models.graphs.acts import Acts
from mbagent.models.graphs.compiled import Graphs, build
from mbagent.models.graphs.conditioner import find_dependent, uncertain_rows
from mbagent.models.graphs.exclusive import find_cliques, find_groups
from mbagent.models.graphs.greedy import find_splits
from mbagent.models.graphs.manners import WHERE, Asking, ask_in, habit_in
from mbagent.models.graphs.partners import for_all_ways
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import (
    Layout,
    Question,
    Seen,
    column_kinds,
    column_table,
    coupled_layout,
    distinct,
    is_lone_bit,
    lay_out,
    shown,
    unit_values,
)
from mbagent.models.particles import NEGLIGIBLE
from mbagent.transitions import TransitionBatch

Bools: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.int64]

NO_MANNERS: Mapping[int, Asking] = MappingProxyType({})
"""All factors are asked where they go."""

SOME_ROWS = 4000
"""Rows on which it is looked at how often bits should be on together."""


@dataclass(frozen=True)
class Fitted:
    """What was found.

    Attributes:
        layout: the units.
        usual: graphs of all units, each for itself, and of whether the event happens.
        late: graphs of the units that are drawn after the others, given what those became, in order.
        event: graphs of what happens in an event; as ``usual`` where there is none.
        has_event: whether there is one.
        asked, found: questions and splits behind ``usual`` and ``late``.
    """

    layout: Layout
    usual: Graphs
    late: Graphs
    event: Graphs
    has_event: bool
    asked: Sequence[Question]
    found: Sequence[Search]


def for_planning(fitted: Fitted) -> Fitted:
    """The graphs as planners read them: what no observation stands behind is no outcome, all else is one, however rare."""
    noise = np.full(1, NEGLIGIBLE)
    usual, late, event = (graphs._replace(noise=noise) for graphs in (fitted.usual, fitted.late, fitted.event))
    return replace(fitted, usual=usual, late=late, event=event)


class _Table:
    """Transitions as units and columns.

    Args:
        layout: the units.
        rows: N transitions.
        events: which of them are rare events, bool [N].
        manners: how factors are asked about, if not where they go.
        since: first row that counts for each factor and for ``terminated``, int64 [F + 1]; None for all.
    """

    def __init__(
        self, layout: Layout, rows: TransitionBatch, events: Bools, manners: Mapping[int, Asking], since: Ints | None
    ) -> None:
        """See the class."""
        self.layout, self.rows = layout, rows
        self.since = np.zeros(len(layout.outputs), dtype=np.int64)
        if since is not None:
            members = [layout.members[begin:end] for begin, end in zip(layout.first, layout.first[1:], strict=False)]
            self.since[:-2] = [since[factors].max() for factors in members[:-2]]
            self.since[-2] = since[-1]
        lone = np.flatnonzero(np.diff(layout.first) == 1)
        self.manners = {int(unit): manners.get(int(layout.members[layout.first[unit]]), WHERE) for unit in lone}
        flags = np.stack([rows.terminated, events], axis=1).astype(np.uint8)
        self.now = np.concatenate([unit_values(layout, rows.before), np.zeros_like(flags)], axis=1)
        self.then = np.concatenate([unit_values(layout, rows.after), flags], axis=1)
        first, self.pattern = distinct(rows.before, rows.actions)
        self.first, self.columns = first, column_table(layout, rows.before[first], rows.actions[first])

    def ask(self, unit: int, which: Ints) -> list[Question]:
        """The questions about a unit, of some rows."""
        return self.questions(unit, self.seen(unit).select(self.counting(unit, which)))

    def counting(self, unit: int, which: Ints) -> Ints:
        """Those of some rows that count for a unit."""
        result: Ints = which[which >= self.since[unit]]
        return result

    def questions(self, unit: int, seen: Seen) -> list[Question]:
        """The questions about a unit, of rows with whatever looks."""
        manner, partner = self.manners.get(unit, WHERE)
        n_ways = self.layout.acts.n_ways if partner is None else partner.cardinality
        asked = ask_in(manner, unit, int(self.layout.outputs[unit]), n_ways, seen)
        return asked if partner is None else [replace(one, partner=partner.columns(self.layout)) for one in asked]

    def seen(self, unit: int) -> Seen:
        """A unit's values in all rows, with the action or what takes its place."""
        now, then = (values[:, unit].astype(np.int64) for values in (self.now, self.then))
        partner = self.manners.get(unit, WHERE).partner
        ways = self.layout.acts.way[self.rows.actions] if partner is None else partner.of(self.rows)
        return Seen(self.pattern, ways, now, then)

    def kinds(self, seen: Ints) -> Ints:
        """Kind of each column, by some rows."""
        changing = (self.rows.before[seen] != self.rows.after[seen]).any(axis=0)
        return column_kinds(self.layout, self.rows.before[seen], changing)

    def build(self, asked: Sequence[Question], found: Sequence[Search], seen: Ints, still: float) -> Graphs:
        """The graphs; habits are those of the rows seen."""
        habits, n_ways = [], self.layout.acts.n_ways
        for unit, cardinality in enumerate(self.layout.outputs):
            some, (manner, partner) = self.seen(unit).select(self.counting(unit, seen)), self.manners.get(unit, WHERE)
            habit = habit_in(manner, int(cardinality), n_ways if partner is None else partner.cardinality, some)
            habits.append(habit if partner is None else for_all_ways(habit, partner.cardinality, n_ways))
        return build(self.layout, asked, found, habits, still)


def nothing_late(graphs: Graphs) -> Graphs:
    """Graphs of no unit, for where nothing is drawn late."""
    return graphs._replace(changing=np.zeros(0, dtype=np.int64), column=np.full_like(graphs.column, -1))


def fit_graphs(
    cardinalities: Sequence[int],
    acts: Acts,
    rows: TransitionBatch,
    events: Bools,
    in_pairs: bool = True,
    jointly: bool = True,
    manners: Mapping[int, Asking] = NO_MANNERS,
    since: Ints | None = None,
) -> Fitted:
    """Fits everything.

    Args:
        cardinalities: number of values of each factor.
        acts: the actions.
        rows: N transitions.
        events: which of them are rare events, bool [N].
        in_pairs: whether to look for causes that matter only together, which takes most of the time.
        jointly: whether to look for units that hang on what others become.
        manners: how factors are asked about, if not where they go.
        since: first row that counts for each factor and for ``terminated``, int64 [F + 1]; None for all.
    """
    groups = find_groups(cardinalities, rows.before, rows.after, ~events)
    layout = lay_out(cardinalities, groups, acts)
    table, usual = _Table(layout, rows, events, manners, since), np.flatnonzero(~events)
    last = len(layout.outputs) - 1
    asked_of = {unit: np.arange(len(rows)) if unit == last else usual for unit in range(last + 1)}
    graphs, asked, found = _graphs(table, asked_of, usual, True, in_pairs)
    layout = _coupled(layout, graphs, rows)
    late = nothing_late(graphs)
    if jointly:
        late, more_asked, more_found = _late_graphs(table, layout, graphs, usual, in_pairs)
        asked, found = [*asked, *more_asked], [*found, *more_found]
    event = graphs
    if events.any():
        rare = np.flatnonzero(events)
        event, _, _ = _graphs(table, dict.fromkeys(range(last), rare), rare, False, in_pairs)
    return Fitted(layout, graphs, late, event, bool(events.any()), asked, found)


def _late_graphs(
    table: _Table, layout: Layout, graphs: Graphs, usual: Ints, in_pairs: bool
) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of units that hang on what others become, with questions and splits."""
    rows, kinds, n_columns = table.rows, table.kinds(usual), table.columns.shape[1]
    late, all_asked, all_found = [], [], []
    for unit, columns in find_dependent(layout, graphs, rows, usual):
        counting = table.counting(unit, usual)
        needed = uncertain_rows(rows.select(counting), layout, graphs, np.asarray([unit]))[:, 0]
        some = table.seen(unit).select(counting[needed])
        following = shown(layout, rows.after[counting[needed]], columns)
        first, pattern = distinct(following, some.pattern)
        asked = table.questions(unit, replace(some, pattern=pattern))
        more_kinds = np.concatenate([kinds, kinds.max(initial=0) + 1 + kinds[columns]])
        more = np.concatenate([table.columns[some.pattern[first]], following[first]], axis=1)
        found = find_splits([q.head for q in asked], more, more_kinds, layout.acts.n_ways, in_pairs)
        if any(split.column >= n_columns for search in found for split in search.splits):
            numbers = np.concatenate([np.arange(n_columns), n_columns + columns])
            late.append(unit)
            all_asked += asked
            all_found += [search.renamed(numbers) for search in found]
    if not late:
        return nothing_late(graphs), [], []
    built = table.build(all_asked, all_found, usual, float(graphs.still[0]))
    return built._replace(changing=np.asarray(late, dtype=np.int64)), all_asked, all_found


def _coupled(layout: Layout, graphs: Graphs, rows: TransitionBatch) -> Layout:
    """The layout with those bits coupled that are never on together, though each for itself might be."""
    bits = graphs.changing[is_lone_bit(layout)[graphs.changing]]
    if len(bits) < 2 or len(rows) == 0:
        return layout
    factors = layout.members[layout.first[bits]]
    on = rows.after[:, factors].astype(np.float32)
    some = np.linspace(0, len(rows) - 1, min(len(rows), SOME_ROWS)).astype(np.int64)
    start = np.concatenate([[0], np.cumsum(_cardinalities(layout))]).astype(np.int64)
    probs = np.empty((len(some), int(start[-1])))
    few = rows.select(some)
    draws.marginals(few.states, few.actions, layout, graphs, start, probs)
    ones = probs[:, start[factors] + 1]
    expected = ones.T @ ones * (len(rows) / len(some))
    return coupled_layout(layout, [bits[c] for c in find_cliques(np.rint(on.T @ on).astype(np.int64), expected)])


def _cardinalities(layout: Layout) -> NDArray[np.int64]:
    """Number of values of each factor."""
    cardinalities = np.full(layout.n_factors, 2, dtype=np.int64)
    lone = np.flatnonzero(np.diff(layout.first) == 1)
    cardinalities[layout.members[layout.first[lone]]] = layout.outputs[lone]
    return cardinalities


def _graphs(
    table: _Table, asked_of: dict[int, Ints], seen: Ints, regular: bool, in_pairs: bool
) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of some units, each asked of some rows; ``seen`` are the rows of this regime.

    In a ``regular`` regime units that never changed are all taken together for how likely they are to change; where
    anything may change, each for itself.
    """
    asked = [question for unit, which in asked_of.items() for question in table.ask(unit, which)]
    found = find_splits([q.head for q in asked], table.columns, table.kinds(seen), table.layout.acts.n_ways, in_pairs)
    still = 0.5 / (len(seen) * (len(table.layout.outputs) if regular else 1) + 1.0)
    return table.build(asked, found, seen, still), asked, found
