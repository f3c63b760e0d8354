"""Variables, their features, and the one-vs-rest targets of decision graphs.

A *variable* is a factor, a group of bits of which exactly one is on, ``terminated``, or whether a rare reset happens. A
*feature* is on or off: a bit, one value of a factor with more than two, a factor's reaching a threshold, or an action. There are
very many joint actions of several components (``MultiBinary`` or ``MultiDiscrete`` spaces), each taken only a few times; with
component features, actions that agree in the relevant components share parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.data import Factors
from mbagent.models.dbn.score import Target
from mbagent.types import Bools, Ints
from mbagent_envs.random_keys import derive, hash_rows
from mbagent_envs.structs import Struct


class ActionEncoding(Struct):
    """The features of each of A actions, and their action classes.

    Attributes:
        first: where each action's features begin in ``feature``, int64 [A + 1].
        feature: indices of the features that are on, ascending, int64.
        n_features: number of features K.
        action_class: class in which each action is counted, int64 [A]: one of its own if actions have no components; 0 for all
            actions with components, so that only features distinguish them.
        n_action_classes: number of action classes W.
    """

    first: Ints
    feature: Ints
    n_features: int
    action_class: Ints
    n_action_classes: int


def action_encoding(parts: Sequence[int]) -> ActionEncoding:
    """The encoding of all joint actions, numbered as by ``numpy.ravel_multi_index``.

    Args:
        parts: number of values of each action component; a single number for actions without components. A component of two
            values has one feature, others have one for each value.
    """
    n_actions = math.prod(parts)
    actions = np.arange(n_actions, dtype=np.int64)
    if len(parts) == 1:
        return ActionEncoding(np.arange(n_actions + 1, dtype=np.int64), actions, n_actions, actions, n_actions)
    stride, n, value = np.asarray(action_features(parts), dtype=np.int64).reshape(-1, 3).T
    action, feature = np.nonzero(actions[:, None] // stride % n == value)
    first = np.searchsorted(action, np.arange(n_actions + 1)).astype(np.int64)
    return ActionEncoding(first, feature.astype(np.int64), len(value), np.zeros(n_actions, dtype=np.int64), 1)


def action_features(parts: Sequence[int]) -> list[tuple[int, int, int]]:
    """Features of actions as (stride, n, value): on for actions with ``action // stride % n == value``."""
    single = len(parts) == 1
    return [
        (math.prod(parts[i + 1 :]), n, value) for i, n in enumerate(parts) for value in (range(n) if n != 2 or single else (1,))
    ]


def action_feature_table(encoding: ActionEncoding, actions: Ints) -> NDArray[np.bool_]:
    """Features of actions [B], bool [B, K]."""
    table = np.zeros((len(encoding.action_class), encoding.n_features), dtype=np.bool_)
    table[np.repeat(np.arange(len(encoding.action_class)), np.diff(encoding.first)), encoding.feature] = True
    return table[actions]


BEYOND = -1
"""Channel number of the border in adjacency features."""


class Layout(Struct):
    """Variables and features of a state, as arrays that compiled kernels can read, too.

    Attributes:
        outputs: number of values of each variable, int64 [U]; the last two variables are ``terminated`` and the reset.
        first: where each variable's factors begin in ``members``, int64 [U + 1].
        members: factors of each variable; several for a group, one for a factor, none for the last two.
        factor, value, top: the state features, int64 [D']: on if the factor's value is at least ``value`` and at most ``top``.
        first_feature: where each factor's features begin among these, int64 [F + 1].
        n_factors: number of factors F.
        encoding: the K features of actions, and the action classes.
        cells: if the observation is a stack of planes, the factor of each channel in each row and column, int64 [C, H, W];
            else empty.
        adjacencies: adjacency features, on if anywhere on the planes a channel has a value and a channel (another or the same)
            has a value at a fixed offset: (channel, value, channel, value, rows below, columns to the right), int64 [M, 6].
            D = D' + K + M features in all.
        next_adjacencies: adjacency features of the next state, int64 [M', 6].
        mutex_first: where each mutex group's variables begin in ``mutex_members``, int64 [Q + 1].
        mutex_members: variables, all bits, of which at most one is on after a step.
        exactly: whether exactly one is on, bool [Q].
        mutex_of: mutex group of each variable, or -1, int64 [U].
        counts, observed: invariants of planes, see ``planes/invariants.py``.
        weights: weight of each channel's value in the index of a combination of values, int64 [C].
    """

    outputs: Ints
    first: Ints
    members: Ints
    factor: Ints
    value: Ints
    top: Ints
    first_feature: Ints
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
"""Maximum number of threshold features of one factor; with more values, the thresholds are evenly spaced."""


def make_layout(
    cardinalities: Sequence[int], groups: Sequence[Sequence[int]], encoding: ActionEncoding, ordinal: bool = True
) -> Layout:
    """The layout whose variables are the groups, then all other factors in their order, then ``terminated`` and the reset.

    Args:
        cardinalities: number of values of each factor.
        groups: factors of each group.
        encoding: the actions.
        ordinal: whether factors have threshold features (at least a value).
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
        np.searchsorted(factor, np.arange(len(cardinalities) + 1)).astype(np.int64),
        len(cardinalities),
        encoding,
        np.zeros((0, 0, 0), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros((0, 6), dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.bool_),
        np.full(len(sizes), -1, dtype=np.int64),
        np.zeros((0, 2), dtype=np.int64),
        np.zeros(0, dtype=np.bool_),
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
    """State features of states [B, F], bool [B, D'], or only the given ``features`` [K], bool [B, K]."""
    which = np.arange(len(layout.factor)) if features is None else features
    values = states[:, layout.factor[which]]
    result: Bools = (values >= layout.value[which]) & (values <= layout.top[which])
    return result


def layout_with_mutexes(layout: Layout, mutexes: Sequence[Ints], exactly: Sequence[bool] | None = None) -> Layout:
    """The layout with mutex groups, each given by its variables; exactly one bit of a group is on, or at most one (default)."""
    of = np.full(len(layout.outputs), -1, dtype=np.int64)
    for number, variables in enumerate(mutexes):
        of[variables] = number
    return replace(
        layout,
        mutex_first=np.concatenate([[0], np.cumsum([len(variables) for variables in mutexes])]).astype(np.int64),
        mutex_members=np.concatenate([*mutexes, np.zeros(0, dtype=np.int64)]).astype(np.int64),
        exactly=np.asarray([False] * len(mutexes) if exactly is None else exactly, dtype=np.bool_),
        mutex_of=of,
    )


def is_lone_bit(layout: Layout) -> Bools:
    """Which variables are a single bit, bool [U]."""
    result: Bools = (layout.outputs == 2) & (np.diff(layout.first) == 1)
    return result


ROWS_OF_VALUES = 1 << 16
"""Number of rows whose values are copied at once; bounds the memory."""


def variable_values(layout: Layout, states: Factors) -> Factors:
    """Values [B, U - 2] of all variables but the last two in states [B, F], in the smallest dtype.

    A group's value is the index of its first bit that is on.
    """
    values = np.empty((len(states), len(layout.outputs) - 2), dtype=np.min_scalar_type(int(layout.outputs.max()) - 1))
    sizes = np.diff(layout.first)[: values.shape[1]]
    single, groups = np.flatnonzero(sizes == 1), np.flatnonzero(sizes > 1)
    for begin in range(0, len(states), ROWS_OF_VALUES):
        rows = slice(begin, begin + ROWS_OF_VALUES)
        values[rows, single] = states[rows, layout.members[layout.first[single]]]
        for group in groups:
            values[rows, group] = states[rows, layout.members[layout.first[group] : layout.first[group + 1]]].argmax(axis=1)
    return values


def feature_table(layout: Layout, states: Factors, actions: Ints) -> Bools:
    """Features of ``states`` [B, F] followed by those of ``actions`` [B], bool, without adjacency features."""
    return np.concatenate(
        [shown(layout, states), action_feature_table(layout.encoding, actions)],
        axis=1,
    )


def feature_kinds(layout: Layout, states: Factors, changing: Bools) -> Ints:
    """Kind of each feature, int64 [D]; the search uses a common prior for all features of a kind.

    The values of one variable are one kind, its threshold features another one. All bits that change are one kind, as are all
    actions. Constant bits are divided into two kinds by how often they are on, at the largest gap.

    Args:
        layout: the variables.
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
    constant = np.flatnonzero((owner < 0) & ~changing[layout.factor])
    if len(constant) == 0:
        return kinds
    frequency = np.log(states[:, layout.factor[constant]].mean(axis=0) + 1e-3)
    order, edge = np.argsort(frequency, kind="stable"), len(constant) // 6
    gaps = np.diff(frequency[order])[edge : len(constant) - 1 - edge]
    cut = edge + int(gaps.argmax()) + 1 if len(gaps) else len(constant)
    kinds[constant[order[:cut]]] = 2
    kinds[constant[order[cut:]]] = 3
    return kinds


@dataclass(frozen=True)
class Question:
    """Whether a variable takes a value, or changes by an amount, in the (action, current value) pairs where that is possible.

    Attributes:
        variable: number of the variable.
        values: the predicted next value for each pair, int64 [P].
        pairs: action class * cardinality + current value, for each pair, int64 [P], ascending.
        target: the rows.
        context: initial context of each pair, int64 [P]: one of its own, unless several pairs share a context.
        operand: features of the operand that replaces the action in the pairs, one per operand value, int64; or None.
    """

    variable: int
    values: Ints
    pairs: Ints
    target: Target
    context: Ints
    operand: Ints | None = None


@dataclass(frozen=True)
class Observed:
    """Transitions of one variable, with the patterns of their features.

    Attributes:
        pattern: index of each row's pattern, including the action, int64 [N]; rows of a pattern share their current value.
        actions: action classes, see ``ActionEncoding``, int64 [N].
        now: the variable's current values, int64 [N].
        then: its next values, int64 [N].
    """

    pattern: Ints
    actions: Ints
    now: Ints
    then: Ints

    def select(self, rows: Ints) -> Observed:
        """Some of the rows."""
        return Observed(self.pattern[rows], self.actions[rows], self.now[rows], self.then[rows])


def ask(variable: int, cardinality: int, observed: Observed) -> list[Question]:
    """The one-vs-rest questions about a variable's next value; none if it never changes.

    Args:
        variable: its number.
        cardinality: number of its values.
        observed: its transitions.
    """
    if (observed.now == observed.then).all():
        return []
    if cardinality == 2:
        return [question(variable, observed.then, 1, cardinality, observed)]
    pair, questions = observed.actions * cardinality + observed.now, []
    for value in np.unique(observed.then[observed.now != observed.then]):
        sources = np.unique(pair[observed.then == value])
        sources = sources[sources % cardinality != value]
        some = observed.select(np.flatnonzero(np.isin(pair, sources)))
        questions.append(question(variable, some.then, int(value), cardinality, some))
    return questions


def question(
    variable: int,
    positives: Ints,
    value: int,
    cardinality: int,
    observed: Observed,
    every: Ints | None = None,
    alike: Ints | None = None,
) -> Question:
    """The question whether ``positives`` [R] equals a value, for the observed pairs or for the given ones.

    Args:
        variable: number of the variable.
        positives: outcome of each row, int64 [R].
        value: the outcome that counts as positive.
        cardinality: number of the variable's values.
        observed: the R rows.
        every: pairs to predict for, int64 [P], ascending; None for the observed ones.
        alike: index of the initial context of each pair, int64 [P]; None for one context each.
    """
    n, e = np.bincount(observed.pattern), np.bincount(observed.pattern, weights=positives == value).astype(np.int64)
    pair_of = np.empty(len(n), dtype=np.int64)
    pair_of[observed.pattern] = observed.actions * cardinality + observed.now
    rows = np.flatnonzero(n)
    pairs = np.unique(pair_of[rows]) if every is None else every
    context = np.arange(len(pairs)) if alike is None else np.unique(alike, return_inverse=True)[1].astype(np.int64)
    position, several = np.searchsorted(pairs, pair_of[rows]), np.full(context.max(initial=-1) + 1, -1)
    target = Target(
        rows,
        n[rows],
        e[rows],
        context[position],
        pairs // cardinality if alike is None else several,
        pairs % cardinality if alike is None else several,
    )
    return Question(variable, np.full(len(pairs), value), pairs, target, context)


ENTRIES_AT_ONCE = 20_000_000
"""Entries of a table that are hashed at once."""


def distinct(table: NDArray[Any], also: Ints | None = None) -> tuple[Ints, Ints]:
    """Index of the first row of each pattern [P], and the pattern of each row, int64 [N].

    Args:
        table: integers or booleans [N, D].
        also: one more column, int64 [N].
    """
    step = max(1, ENTRIES_AT_ONCE // max(table.shape[1], 1))
    parts = [hash_rows(table[begin : begin + step]) for begin in range(0, len(table), step)]
    hashes = np.concatenate([np.zeros(0, dtype=np.uint64), *parts])
    if also is not None:
        hashes = derive(hashes, also.astype(np.uint64))
    _, first, pattern = np.unique(hashes, return_index=True, return_inverse=True)
    return first, pattern.astype(np.int64)
