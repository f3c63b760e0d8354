"""Variables, their features, and the one-vs-rest targets that decision graphs are learned for.

A *variable* is a factor, or a group of bits of which exactly one is on; ``terminated`` is one more, and so is whether a rare
reset happens. A *feature* is on or off: a bit, one value of a factor with more than two, whether a factor has at least some
value, or an action. A joint action of several parts (a MultiBinary or MultiDiscrete space) is one of very many, each taken a few
times only; as features of its parts, all actions that agree in the relevant parts share what is learned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.data import Factors
from mbagent.models.dbn.invariants import LAWLESS
from mbagent.models.dbn.score import Head
from mbagent.types import Bools, Ints
from mbagent_envs.random_keys import derive, hash_rows


class Acts(NamedTuple):
    """Which columns each of A actions has on, and which actions are told apart from the start.

    Attributes:
        first: where each action's columns begin in ``column``, int64 [A + 1].
        column: numbers of the columns that are on, ascending, int64.
        n_columns: number of columns K.
        way: the number under which each action is counted, int64 [A]: its own where it is one thing; 0 for all where
            actions have parts, so that only columns tell them apart.
        n_ways: how many such numbers there are.
    """

    first: Ints
    column: Ints
    n_columns: int
    way: Ints
    n_ways: int


def acts_of(parts: Sequence[int]) -> Acts:
    """Actions with so many values of each part, numbered as ``numpy.ravel_multi_index`` does.

    Args:
        parts: number of values of each part; one part for actions that are one thing. A part of two values has one column,
            others have one for each value.
    """
    n_actions = math.prod(parts)
    every = np.arange(n_actions, dtype=np.int64)
    if len(parts) == 1:
        return Acts(np.arange(n_actions + 1, dtype=np.int64), every, n_actions, every, n_actions)
    stride, n, value = np.asarray(act_columns(parts), dtype=np.int64).reshape(-1, 3).T
    action, column = np.nonzero(every[:, None] // stride % n == value)
    first = np.searchsorted(action, np.arange(n_actions + 1)).astype(np.int64)
    return Acts(first, column.astype(np.int64), len(value), np.zeros(n_actions, dtype=np.int64), 1)


def act_columns(parts: Sequence[int]) -> list[tuple[int, int, int]]:
    """The columns as (stride, n, value): on for the actions of which ``action // stride % n`` is the value."""
    alone = len(parts) == 1
    return [
        (math.prod(parts[i + 1 :]), n, value) for i, n in enumerate(parts) for value in (range(n) if n != 2 or alone else (1,))
    ]


def shown_acts(acts: Acts, actions: Ints) -> NDArray[np.bool_]:
    """Which columns are on under actions [B], bool [B, K]."""
    table = np.zeros((len(acts.way), acts.n_columns), dtype=np.bool_)
    table[np.repeat(np.arange(len(acts.way)), np.diff(acts.first)), acts.column] = True
    return table[actions]


BEYOND = -1
"""Stands for a channel where a meeting is with the border."""


class Layout(NamedTuple):
    """Where units and columns lie in a state; for compiled kernels, too.

    Attributes:
        outputs: number of values of each unit, int64 [U]; the last two units are ``terminated`` and the event.
        first: where each unit's factors begin in ``members``, int64 [U + 1].
        members: factors of each unit; several for a group, one for a factor, none for the last two.
        factor, value, top: what each state column stands for, int64 [D']: that a factor's value lies from ``value`` to ``top``.
        n_factors: number of factors F.
        acts: which columns actions have on, K in all, and which are told apart from the start.
        cells: where the observation is a stack of planes, the factor of each channel in each row and column, int64 [C, H, W];
            else empty.
        meetings: columns that are on where, anywhere on the planes, a channel has a value and so has another (or the same) so
            many rows below and columns to the right: (channel, value, channel, value, rows, columns), int64 [M, 6].
            D = D' + K + M columns in all.
        coupled_first: where each coupling's units begin in ``coupled``, int64 [Q + 1].
        coupled: units, all bits, of which at most one is on after a step.
        exactly: whether it is exactly one, bool [Q].
        coupling_of: coupling that each unit is in, or -1, int64 [U].
        counts, met: what planes keep to, see ``laws.py``.
        weights: what each channel's value counts in the number of a combination, int64 [C].
    """

    outputs: Ints
    first: Ints
    members: Ints
    factor: Ints
    value: Ints
    top: Ints
    n_factors: int
    acts: Acts
    cells: Ints
    meetings: Ints
    next_meetings: Ints
    coupled_first: Ints
    coupled: Ints
    exactly: Bools
    coupling_of: Ints
    counts: Ints
    met: Bools
    weights: Ints


MOST_STEPS = 128
"""Columns "at least so much" of one factor; of more values, evenly spaced ones have one."""


def lay_out(cardinalities: Sequence[int], groups: Sequence[Sequence[int]], acts: Acts, ordinal: bool = True) -> Layout:
    """Units of factors: the groups first, then all other factors in their order, then ``terminated`` and the event.

    Args:
        cardinalities: number of values of each factor.
        groups: factors of each group.
        acts: the actions.
        ordinal: whether there are columns for a factor having at least some value.
    """
    grouped = {f for group in groups for f in group}
    members = [*(list(group) for group in groups), *([f] for f in range(len(cardinalities)) if f not in grouped), [], []]
    sizes = [len(group) for group in groups] + [cardinalities[unit[0]] for unit in members[len(groups) : -2]] + [2, 2]
    columns = [column for f, c in enumerate(cardinalities) for column in _columns_of(f, c, ordinal)]
    factor, value, top = np.asarray(columns, dtype=np.int64).reshape(-1, 3).T
    return Layout(
        np.asarray(sizes, dtype=np.int64),
        np.concatenate([[0], np.cumsum([len(unit) for unit in members])]).astype(np.int64),
        np.asarray([f for unit in members for f in unit], dtype=np.int64),
        np.ascontiguousarray(factor),
        np.ascontiguousarray(value),
        np.ascontiguousarray(top),
        len(cardinalities),
        acts,
        np.zeros((0, 0, 0), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.bool_),
        np.full(len(sizes), -1, dtype=np.int64),
        *LAWLESS,
        np.zeros(0, dtype=np.int64),
    )


def _columns_of(factor: int, cardinality: int, ordinal: bool) -> list[tuple[int, int, int]]:
    if cardinality == 2:
        return [(factor, 1, 1)]
    columns = [(factor, v, v) for v in range(cardinality)]
    if ordinal:
        steps = np.unique(np.linspace(1, cardinality - 2, min(MOST_STEPS, max(cardinality - 2, 0))).astype(np.int64))
        columns += [(factor, int(v), cardinality - 1) for v in steps]
    return columns


def shown(layout: Layout, states: Factors, columns: Ints | None = None) -> Bools:
    """Which state columns are on in states [B, F], bool [B, D'], or [B, K] of those ``columns`` [K]."""
    which = np.arange(len(layout.factor)) if columns is None else columns
    values = states[:, layout.factor[which]]
    result: Bools = (values >= layout.value[which]) & (values <= layout.top[which])
    return result


def coupled_layout(layout: Layout, couplings: Sequence[Ints], exactly: Sequence[bool] | None = None) -> Layout:
    """The layout with couplings, each given by its units; exactly one bit of a coupling is on, or at most one (default)."""
    of = np.full(len(layout.outputs), -1, dtype=np.int64)
    for number, units in enumerate(couplings):
        of[units] = number
    return layout._replace(
        coupled_first=np.concatenate([[0], np.cumsum([len(units) for units in couplings])]).astype(np.int64),
        coupled=np.concatenate([*couplings, np.zeros(0, dtype=np.int64)]).astype(np.int64),
        exactly=np.asarray([False] * len(couplings) if exactly is None else exactly, dtype=np.bool_),
        coupling_of=of,
    )


def is_lone_bit(layout: Layout) -> Bools:
    """Which units are a single bit, bool [U]."""
    result: Bools = (layout.outputs == 2) & (np.diff(layout.first) == 1)
    return result


def unit_values(layout: Layout, states: Factors) -> Factors:
    """Value of each unit of factors, [B, U - 2], in states [B, F], as narrow as can be; in a group the first bit on counts."""
    values = np.empty((len(states), len(layout.outputs) - 2), dtype=np.min_scalar_type(int(layout.outputs.max()) - 1))
    for unit in range(values.shape[1]):
        members = layout.members[layout.first[unit] : layout.first[unit + 1]]
        values[:, unit] = states[:, members[0]] if len(members) == 1 else states[:, members].argmax(axis=1)
    return values


def column_table(layout: Layout, states: Factors, actions: Ints) -> Bools:
    """Which columns are on, bool [B, D]: those of states [B, F], then those of actions [B]."""
    return np.concatenate(
        [shown(layout, states), shown_acts(layout.acts, actions)],
        axis=1,
    )


def column_kinds(layout: Layout, states: Factors, changing: Bools) -> Ints:
    """Which kind of thing each column is, int64 [D], by what can be seen without knowing the world.

    The values of one unit are one kind; so are all bits that change, and all actions; bits that stay fall in two kinds by
    how often they are on, where the largest gap is.

    Args:
        layout: the units.
        states: int64 [N, F].
        changing: which factors change, bool [F].
    """
    n_columns = len(layout.factor)
    kinds = np.zeros(n_columns + layout.acts.n_columns, dtype=np.int64)
    kinds[n_columns:] = 1
    of_factor = np.full(layout.n_factors, -1)
    for unit in np.flatnonzero(np.diff(layout.first) * (layout.outputs > 2)):
        of_factor[layout.members[layout.first[unit] : layout.first[unit + 1]]] = unit
    owner = of_factor[layout.factor]
    steps = np.where(layout.top > layout.value, len(layout.outputs), 0)
    kinds[:n_columns][owner >= 0] = (4 + owner + steps)[owner >= 0]
    still = np.flatnonzero((owner < 0) & ~changing[layout.factor])
    if len(still) == 0:
        return kinds
    often = np.log(states[:, layout.factor[still]].mean(axis=0) + 1e-3)
    order, edge = np.argsort(often, kind="stable"), len(still) // 6
    gaps = np.diff(often[order])[edge : len(still) - 1 - edge]
    cut = edge + int(gaps.argmax()) + 1 if len(gaps) else len(still)
    kinds[still[order[:cut]]] = 2
    kinds[still[order[cut:]]] = 3
    return kinds


@dataclass(frozen=True)
class Question:
    """Whether a unit takes a value, or moves so far, in the contexts (action, present value) in which that is possible.

    Attributes:
        unit: number of the unit.
        values: the value after each pair, int64 [P].
        pairs: action times cardinality plus present value, of each pair that has an answer, int64 [P], ascending.
        head: the rows.
        context: the context of each pair, int64 [P]; unless several pairs are one context from the start, each is its own.
        partner: columns of what takes the action's place in the pairs, one for each of its values, int64; None for the action.
    """

    unit: int
    values: Ints
    pairs: Ints
    head: Head
    context: Ints
    partner: Ints | None = None


@dataclass(frozen=True)
class Seen:
    """Rows and what they look like.

    Attributes:
        pattern: number of each row's look, action included, int64 [N]; rows of one look have one present value.
        actions: the ways of the actions, see ``Acts``, int64 [N].
        now: a unit's present values, int64 [N].
        then: those that follow, int64 [N].
    """

    pattern: Ints
    actions: Ints
    now: Ints
    then: Ints

    def select(self, rows: Ints) -> Seen:
        """Some of the rows."""
        return Seen(self.pattern[rows], self.actions[rows], self.now[rows], self.then[rows])


def ask(unit: int, cardinality: int, seen: Seen) -> list[Question]:
    """The questions about one unit, where it goes; none if it never changes.

    Args:
        unit: its number.
        cardinality: number of its values.
        seen: the rows to ask.
    """
    if (seen.now == seen.then).all():
        return []
    if cardinality == 2:
        return [question(unit, seen.then, 1, cardinality, seen)]
    pair, asked = seen.actions * cardinality + seen.now, []
    for value in np.unique(seen.then[seen.now != seen.then]):
        leading = np.unique(pair[seen.then == value])
        leading = leading[leading % cardinality != value]
        some = seen.select(np.flatnonzero(np.isin(pair, leading)))
        asked.append(question(unit, some.then, int(value), cardinality, some))
    return asked


def question(
    unit: int, came: Ints, value: int, cardinality: int, seen: Seen, every: Ints | None = None, alike: Ints | None = None
) -> Question:
    """Whether ``came`` [R] is some value; in the pairs met, or in ``every`` one of these.

    Args:
        unit: its number.
        came: what came in each row, int64 [R].
        value: what is asked for.
        cardinality: number of the unit's values.
        seen: the R rows.
        every: pairs that get an answer, int64 [P], ascending; None for those met.
        alike: number of the context of each, int64 [P]; None for one each.
    """
    n, e = np.bincount(seen.pattern), np.bincount(seen.pattern, weights=came == value).astype(np.int64)
    pair_of = np.empty(len(n), dtype=np.int64)
    pair_of[seen.pattern] = seen.actions * cardinality + seen.now
    rows = np.flatnonzero(n)
    pairs = np.unique(pair_of[rows]) if every is None else every
    context = np.arange(len(pairs)) if alike is None else np.unique(alike, return_inverse=True)[1].astype(np.int64)
    asked, several = np.searchsorted(pairs, pair_of[rows]), np.full(context.max(initial=-1) + 1, -1)
    head = Head(
        rows,
        n[rows],
        e[rows],
        context[asked],
        pairs // cardinality if alike is None else several,
        pairs % cardinality if alike is None else several,
    )
    return Question(unit, np.full(len(pairs), value), pairs, head, context)


AT_ONCE = 20_000_000
"""Entries of a table whose rows are told apart at once."""


def distinct(table: NDArray[Any], besides: Ints | None = None) -> tuple[Ints, Ints]:
    """Numbers of rows that look different [P], and which of them each row [N] looks like, int64 [N].

    Args:
        table: integers or booleans [N, D].
        besides: one more column, int64 [N].
    """
    step = max(1, AT_ONCE // max(table.shape[1], 1))
    parts = [hash_rows(table[begin : begin + step]) for begin in range(0, len(table), step)]
    tags = np.concatenate([np.zeros(0, dtype=np.uint64), *parts])
    if besides is not None:
        tags = derive(tags, besides.astype(np.uint64))
    _, first, pattern = np.unique(tags, return_index=True, return_inverse=True)
    return first, pattern.astype(np.int64)
