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
from mbagent.models.dbn.invariants import NO_INVARIANTS
from mbagent.models.dbn.score import Target
from mbagent.types import Bools, Ints
from mbagent_envs.random_keys import derive, hash_rows


class ActionEncoding(NamedTuple):
    """Which columns each of A actions has on, and which actions are told apart from the start.

    Attributes:
        first: where each action's columns begin in ``feature``, int64 [A + 1].
        feature: numbers of the columns that are on, ascending, int64.
        n_features: number of columns K.
        action_class: the number under which each action is counted, int64 [A]: its own where it is one thing; 0 for all where
            actions have parts, so that only columns tell them apart.
        n_action_classes: how many such numbers there are.
    """

    first: Ints
    feature: Ints
    n_features: int
    action_class: Ints
    n_action_classes: int


def action_encoding(parts: Sequence[int]) -> ActionEncoding:
    """Actions with so many values of each part, numbered as ``numpy.ravel_multi_index`` does.

    Args:
        parts: number of values of each part; one part for actions that are one thing. A part of two values has one column,
            others have one for each value.
    """
    n_actions = math.prod(parts)
    every = np.arange(n_actions, dtype=np.int64)
    if len(parts) == 1:
        return ActionEncoding(np.arange(n_actions + 1, dtype=np.int64), every, n_actions, every, n_actions)
    stride, n, value = np.asarray(action_features(parts), dtype=np.int64).reshape(-1, 3).T
    action, feature = np.nonzero(every[:, None] // stride % n == value)
    first = np.searchsorted(action, np.arange(n_actions + 1)).astype(np.int64)
    return ActionEncoding(first, feature.astype(np.int64), len(value), np.zeros(n_actions, dtype=np.int64), 1)


def action_features(parts: Sequence[int]) -> list[tuple[int, int, int]]:
    """The columns as (stride, n, value): on for the actions of which ``action // stride % n`` is the value."""
    alone = len(parts) == 1
    return [
        (math.prod(parts[i + 1 :]), n, value) for i, n in enumerate(parts) for value in (range(n) if n != 2 or alone else (1,))
    ]


def action_feature_table(encoding: ActionEncoding, actions: Ints) -> NDArray[np.bool_]:
    """Which columns are on under actions [B], bool [B, K]."""
    table = np.zeros((len(encoding.action_class), encoding.n_features), dtype=np.bool_)
    table[np.repeat(np.arange(len(encoding.action_class)), np.diff(encoding.first)), encoding.feature] = True
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
        encoding: which columns actions have on, K in all, and which are told apart from the start.
        cells: where the observation is a stack of planes, the factor of each channel in each row and column, int64 [C, H, W];
            else empty.
        adjacencies: columns that are on where, anywhere on the planes, a channel has a value and so has another (or the same) so
            many rows below and columns to the right: (channel, value, channel, value, rows, columns), int64 [M, 6].
            D = D' + K + M columns in all.
        mutex_first: where each coupling's units begin in ``mutex_members``, int64 [Q + 1].
        mutex_members: units, all bits, of which at most one is on after a step.
        exactly: whether it is exactly one, bool [Q].
        mutex_of: coupling that each unit is in, or -1, int64 [U].
        counts, observed: what planes keep to, see ``invariants.py``.
        weights: what each channel's value counts in the number of a combination, int64 [C].
    """

    outputs: Ints
    first: Ints
    members: Ints
    factor: Ints
    value: Ints
    top: Ints
    n_factors: int
    encoding: ActionEncoding
    cells: Ints
    adjacencies: Ints
    next_adjacencies: Ints
    mutex_first: Ints
    mutex_members: Ints
    exactly: Bools
    mutex_of: Ints
    counts: Ints
    observed: Bools
    weights: Ints


MOST_STEPS = 128
"""Columns "at least so much" of one factor; of more values, evenly spaced ones have one."""


def make_layout(
    cardinalities: Sequence[int], groups: Sequence[Sequence[int]], encoding: ActionEncoding, ordinal: bool = True
) -> Layout:
    """Units of factors: the groups first, then all other factors in their order, then ``terminated`` and the event.

    Args:
        cardinalities: number of values of each factor.
        groups: factors of each group.
        encoding: the actions.
        ordinal: whether there are columns for a factor having at least some value.
    """
    grouped = {f for group in groups for f in group}
    members = [*(list(group) for group in groups), *([f] for f in range(len(cardinalities)) if f not in grouped), [], []]
    sizes = [len(group) for group in groups] + [cardinalities[variable[0]] for variable in members[len(groups) : -2]] + [2, 2]
    features = [feature for f, c in enumerate(cardinalities) for feature in _features_of(f, c, ordinal)]
    factor, value, top = np.asarray(features, dtype=np.int64).reshape(-1, 3).T
    return Layout(
        np.asarray(sizes, dtype=np.int64),
        np.concatenate([[0], np.cumsum([len(variable) for variable in members])]).astype(np.int64),
        np.asarray([f for variable in members for f in variable], dtype=np.int64),
        np.ascontiguousarray(factor),
        np.ascontiguousarray(value),
        np.ascontiguousarray(top),
        len(cardinalities),
        encoding,
        np.zeros((0, 0, 0), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.bool_),
        np.full(len(sizes), -1, dtype=np.int64),
        *NO_INVARIANTS,
        np.zeros(0, dtype=np.int64),
    )


def _features_of(factor: int, cardinality: int, ordinal: bool) -> list[tuple[int, int, int]]:
    if cardinality == 2:
        return [(factor, 1, 1)]
    features = [(factor, v, v) for v in range(cardinality)]
    if ordinal:
        steps = np.unique(np.linspace(1, cardinality - 2, min(MOST_STEPS, max(cardinality - 2, 0))).astype(np.int64))
        features += [(factor, int(v), cardinality - 1) for v in steps]
    return features


def shown(layout: Layout, states: Factors, features: Ints | None = None) -> Bools:
    """Which state columns are on in states [B, F], bool [B, D'], or [B, K] of those ``features`` [K]."""
    which = np.arange(len(layout.factor)) if features is None else features
    values = states[:, layout.factor[which]]
    result: Bools = (values >= layout.value[which]) & (values <= layout.top[which])
    return result


def layout_with_mutexes(layout: Layout, mutexes: Sequence[Ints], exactly: Sequence[bool] | None = None) -> Layout:
    """The layout with couplings, each given by its units; exactly one bit of a coupling is on, or at most one (default)."""
    of = np.full(len(layout.outputs), -1, dtype=np.int64)
    for number, variables in enumerate(mutexes):
        of[variables] = number
    return layout._replace(
        mutex_first=np.concatenate([[0], np.cumsum([len(variables) for variables in mutexes])]).astype(np.int64),
        mutex_members=np.concatenate([*mutexes, np.zeros(0, dtype=np.int64)]).astype(np.int64),
        exactly=np.asarray([False] * len(mutexes) if exactly is None else exactly, dtype=np.bool_),
        mutex_of=of,
    )


def is_lone_bit(layout: Layout) -> Bools:
    """Which units are a single bit, bool [U]."""
    result: Bools = (layout.outputs == 2) & (np.diff(layout.first) == 1)
    return result


def variable_values(layout: Layout, states: Factors) -> Factors:
    """Value of each unit of factors, [B, U - 2], in states [B, F], as narrow as can be; in a group the first bit on counts."""
    values = np.empty((len(states), len(layout.outputs) - 2), dtype=np.min_scalar_type(int(layout.outputs.max()) - 1))
    for variable in range(values.shape[1]):
        members = layout.members[layout.first[variable] : layout.first[variable + 1]]
        values[:, variable] = states[:, members[0]] if len(members) == 1 else states[:, members].argmax(axis=1)
    return values


def feature_table(layout: Layout, states: Factors, actions: Ints) -> Bools:
    """Which columns are on, bool [B, D]: those of states [B, F], then those of actions [B]."""
    return np.concatenate(
        [shown(layout, states), action_feature_table(layout.encoding, actions)],
        axis=1,
    )


def feature_kinds(layout: Layout, states: Factors, changing: Bools) -> Ints:
    """Which kind of thing each column is, int64 [D], by what can be seen without knowing the world.

    The values of one unit are one kind; so are all bits that change, and all actions; bits that stay fall in two kinds by
    how often they are on, where the largest gap is.

    Args:
        layout: the units.
        states: int64 [N, F].
        changing: which factors change, bool [F].
    """
    n_features = len(layout.factor)
    kinds = np.zeros(n_features + layout.encoding.n_features, dtype=np.int64)
    kinds[n_features:] = 1
    of_factor = np.full(layout.n_factors, -1)
    for variable in np.flatnonzero(np.diff(layout.first) * (layout.outputs > 2)):
        of_factor[layout.members[layout.first[variable] : layout.first[variable + 1]]] = variable
    owner = of_factor[layout.factor]
    steps = np.where(layout.top > layout.value, len(layout.outputs), 0)
    kinds[:n_features][owner >= 0] = (4 + owner + steps)[owner >= 0]
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
        variable: number of the unit.
        values: the value after each pair, int64 [P].
        pairs: action times cardinality plus present value, of each pair that has an answer, int64 [P], ascending.
        target: the rows.
        context: the context of each pair, int64 [P]; unless several pairs are one context from the start, each is its own.
        operand: columns of what takes the action's place in the pairs, one for each of its values, int64; None for the action.
    """

    variable: int
    values: Ints
    pairs: Ints
    target: Target
    context: Ints
    operand: Ints | None = None


@dataclass(frozen=True)
class Observed:
    """Rows and what they look like.

    Attributes:
        pattern: number of each row's look, action included, int64 [N]; rows of one look have one present value.
        actions: the ways of the actions, see ``ActionEncoding``, int64 [N].
        now: a unit's present values, int64 [N].
        then: those that follow, int64 [N].
    """

    pattern: Ints
    actions: Ints
    now: Ints
    then: Ints

    def select(self, rows: Ints) -> Observed:
        """Some of the rows."""
        return Observed(self.pattern[rows], self.actions[rows], self.now[rows], self.then[rows])


def ask(variable: int, cardinality: int, observed: Observed) -> list[Question]:
    """The questions about one unit, where it goes; none if it never changes.

    Args:
        variable: its number.
        cardinality: number of its values.
        observed: the rows to ask.
    """
    if (observed.now == observed.then).all():
        return []
    if cardinality == 2:
        return [question(variable, observed.then, 1, cardinality, observed)]
    pair, asked = observed.actions * cardinality + observed.now, []
    for value in np.unique(observed.then[observed.now != observed.then]):
        leading = np.unique(pair[observed.then == value])
        leading = leading[leading % cardinality != value]
        some = observed.select(np.flatnonzero(np.isin(pair, leading)))
        asked.append(question(variable, some.then, int(value), cardinality, some))
    return asked


def question(
    variable: int,
    positives: Ints,
    value: int,
    cardinality: int,
    observed: Observed,
    every: Ints | None = None,
    alike: Ints | None = None,
) -> Question:
    """Whether ``positives`` [R] is some value; in the pairs met, or in ``every`` one of these.

    Args:
        variable: its number.
        positives: what came in each row, int64 [R].
        value: what is asked for.
        cardinality: number of the unit's values.
        observed: the R rows.
        every: pairs that get an answer, int64 [P], ascending; None for those met.
        alike: number of the context of each, int64 [P]; None for one each.
    """
    n, e = np.bincount(observed.pattern), np.bincount(observed.pattern, weights=positives == value).astype(np.int64)
    pair_of = np.empty(len(n), dtype=np.int64)
    pair_of[observed.pattern] = observed.actions * cardinality + observed.now
    rows = np.flatnonzero(n)
    pairs = np.unique(pair_of[rows]) if every is None else every
    context = np.arange(len(pairs)) if alike is None else np.unique(alike, return_inverse=True)[1].astype(np.int64)
    asked, several = np.searchsorted(pairs, pair_of[rows]), np.full(context.max(initial=-1) + 1, -1)
    target = Target(
        rows,
        n[rows],
        e[rows],
        context[asked],
        pairs // cardinality if alike is None else several,
        pairs % cardinality if alike is None else several,
    )
    return Question(variable, np.full(len(pairs), value), pairs, target, context)


ENTRIES_AT_ONCE = 20_000_000
"""Entries of a table whose rows are told apart at once."""


def distinct(table: NDArray[Any], also: Ints | None = None) -> tuple[Ints, Ints]:
    """Numbers of rows that look different [P], and which of them each row [N] looks like, int64 [N].

    Args:
        table: integers or booleans [N, D].
        also: one more column, int64 [N].
    """
    step = max(1, ENTRIES_AT_ONCE // max(table.shape[1], 1))
    parts = [hash_rows(table[begin : begin + step]) for begin in range(0, len(table), step)]
    tags = np.concatenate([np.zeros(0, dtype=np.uint64), *parts])
    if also is not None:
        tags = derive(tags, also.astype(np.uint64))
    _, first, pattern = np.unique(tags, return_index=True, return_inverse=True)
    return first, pattern.astype(np.int64)
