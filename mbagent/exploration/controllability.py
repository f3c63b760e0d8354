"""Controllable factors: a quick Bayesian test, without a transition model, of which factors depend on actions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.types import Actions, Bools, Floats, Ints, States

Values = NDArray[np.integer[Any]]

MOST_COUNTED_STEPS = 8192
"""Maximum number of transitions that are used; of more, evenly spaced ones."""

CELLS, CAUSES = 1024, 512
"""Maximum numbers of changes, and of values of other factors, between which dependences are tested: the most frequent ones."""

MOST_TABLE_COUNTS, MOST_VALUE = 4_000_000, 65_535
"""Maximum number of counts in a table, and maximum value of a factor; factors with more are not tested for dependences, and each
of their values is a class of its own."""

LEAST_SHARE = 0.1
"""Expected share of a factor's changes that depend on a variable, if any of them does."""

SURE_EVIDENCE = 5.0
"""Log evidence that a dependence needs, in addition to the logarithm of the number of tests."""

RARE_CHANGE = 16
"""Minimum number of changes for a test: rarer changes hardly increase the number of states, and give too little evidence."""


@dataclass(frozen=True)
class Controllable:
    """Result of the tests for F factors.

    Attributes:
        directly: whether the next value depends on the action, given the current value, bool [F].
        classes: for each factor that changed, a mapping of each value to the lowest value in its class. Values in the same class
            often change into each other, independently of the action.
    """

    directly: Bools
    classes: Mapping[int, Mapping[int, int]]


class StateAbstraction:
    """A state abstraction that keeps some factors, maps values of others to their classes, and drops the rest.

    Args:
        found: result of ``find_controllable``.
        whole: factors that are kept unchanged in any case, bool [F].
    """

    def __init__(self, found: Controllable, whole: Bools) -> None:
        """See the class."""
        kept = whole.copy()
        some: list[int] = []
        for factor, classes in found.classes.items():
            n_classes = len(set(classes.values()))
            kept[factor] |= n_classes == len(classes)
            if 1 < n_classes < len(classes) and not kept[factor]:
                some.append(factor)
        self.factors, self.some = np.flatnonzero(kept), np.array(some, dtype=np.int64)
        width = max((max(found.classes[factor]) for factor in some), default=0) + 2  # the last one for unobserved values
        self.classes = np.repeat(np.arange(width)[None], len(some), axis=0)
        for row, factor in enumerate(some):
            for value, lowest in found.classes[factor].items():
                self.classes[row, value] = lowest

    def __call__(self, states: Values) -> States:
        """Maps states [B, F] to abstract states int64 [B, K]."""
        kept = states.take(self.factors, axis=1).astype(np.int64, copy=False)
        if not len(self.some):
            return kept
        known = np.minimum(states.take(self.some, axis=1), self.classes.shape[1] - 1)
        return np.concatenate([kept, self.classes[np.arange(len(self.some)), known]], axis=1)

    def same_as(self, other: StateAbstraction | None) -> bool:
        """Whether another abstraction maps all states to the same abstract states."""
        names = ("factors", "some", "classes")
        return other is not None and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)


@dataclass(frozen=True)
class _Changes:
    """Changes of a factor. Each distinct change (current value, next value that differs from it) is a cell.

    Attributes:
        value: index of each row's current value among the distinct values, int64 [N].
        cell: index of each row's cell, -1 if the factor did not change, int64 [N].
        start: index of each cell's current value, as in ``value``, int64 [C].
        pairs: current and next value of each cell, [C, 2].
    """

    value: Ints
    cell: Ints
    start: Ints
    pairs: Ints


def thinned(before: Values, actions: Actions, after: Values, most: int = MOST_COUNTED_STEPS) -> tuple[Values, Actions, Values]:
    """At most ``most`` of the transitions, evenly spaced."""
    if len(actions) <= most:
        return before, actions, after
    rows = np.linspace(0, len(actions) - 1, most).astype(np.int64)
    return before[rows], actions[rows], after[rows]


def find_controllable(before: Values, actions: Actions, after: Values, n_actions: int) -> Controllable:
    """Tests which of F factors, and which of their changes, depend on actions.

    For each change, beta-binomial tests compare its probability, given the factor's current value, between one action and the
    others. Each comparison is made over all transitions and over those in which another factor has a particular value. A factor
    depends on actions if there is sufficient evidence from one of its changes or from many together.

    Args:
        before: states [N, F], of any integer type.
        actions: int64 [N].
        after: next states, as ``before``.
        n_actions: number of actions A.
    """
    before, actions, after = thinned(before, actions, after)
    changes = _all_changes(before, after)
    threshold = SURE_EVIDENCE + math.log(n_actions * max(1, sum(len(change.start) for change in changes.values())))
    directly, classes = np.zeros(before.shape[1], dtype=np.bool_), {}
    contexts = _dependent_in_contexts(changes, before, actions, n_actions)
    for factor, change in changes.items():
        n_values, moved = int(change.value.max()) + 1, change.cell >= 0
        if (n_values + len(change.start)) * n_actions > MOST_TABLE_COUNTS or change.pairs.max() > MOST_VALUE:
            classes[factor] = {int(value): int(value) for value in np.unique(before[:, factor])}
            continue
        pairs = change.value * n_actions + actions
        of_value = np.bincount(pairs, minlength=n_values * n_actions).reshape(n_values, -1)
        unchanged = np.bincount(pairs[~moved], minlength=n_values * n_actions).reshape(n_values, -1)
        of_cell = np.bincount(change.cell[moved] * n_actions + actions[moved], minlength=len(change.start) * n_actions)
        of_cell = of_cell.reshape(-1, n_actions)
        logs = _evidence(of_cell, of_value[change.start])
        directly[factor] = _factor_evidence(logs).max() > threshold or contexts[factor].any()
        # Compared with no change only, so that a change does not seem to depend on actions because another one does.
        odds = _evidence(of_cell, of_cell + unchanged[change.start])
        dependent = contexts[factor] | (odds.max(axis=1) > threshold / (1 + directly[factor]))
        # Values that almost always change get 0: without rows of both kinds, the odds give no evidence.
        n_changes = np.where(unchanged.sum(axis=1)[change.start] < RARE_CHANGE, 0, of_cell.sum(axis=1))
        classes[factor] = _classes(change.pairs, n_changes, dependent, before[:, factor], after[:, factor])
    return Controllable(directly, classes)


def _dependent_in_contexts(changes: Mapping[int, _Changes], before: Values, actions: Actions, n_actions: int) -> dict[int, Bools]:
    """For each factor, bool [C]: whether each of its cells depends on the action given some value of another factor.

    For example, an object may enter a position from the left by one action and from the right by another: this change does not
    depend on the action alone.
    """
    result, factors = {f: np.zeros(len(change.start), dtype=np.bool_) for f, change in changes.items()}, list(changes)
    rows = (
        slice(None)
        if len(actions) <= MOST_COUNTED_STEPS // 2
        else np.linspace(0, len(actions) - 1, MOST_COUNTED_STEPS // 2).astype(np.int64)
    )
    of_cells, kept = _columns([changes[f].cell[rows] for f in factors], CELLS)
    unchanged = [np.where(changes[f].cell[rows] < 0, changes[f].value[rows], -1) for f in factors]
    of_values, kept_values = _columns(unchanged, CELLS)
    place = {(f, number): column for column, (f, number) in enumerate(kept_values.tolist())}
    origin = np.array([place.get((f, int(changes[factors[f]].start[cell])), -1) for f, cell in kept.tolist()], dtype=np.int64)
    of_cells, kept, origin = of_cells[:, origin >= 0], kept[origin >= 0], origin[origin >= 0]
    most = min(CAUSES, MOST_TABLE_COUNTS // (n_actions * max(1, len(origin))))
    causes, _ = _columns([np.unique(before[rows, f], return_inverse=True)[1] for f in factors], most, even=True)
    if not len(origin) or not causes.shape[1]:
        return result
    chosen = [actions[rows] == action for action in range(n_actions)]
    k, n = (
        np.stack([np.rint(columns[own].T @ causes[own]) for own in chosen]).astype(np.int64) for columns in (of_cells, of_values)
    )
    n = n[:, origin] + k
    threshold, all_k, all_n = SURE_EVIDENCE + math.log(k.size), k.sum(axis=0), n.sum(axis=0)
    dependent = np.max([(_evidence(k[a], n[a], all_k, all_n)).max(axis=1) for a in range(n_actions)], axis=0) > threshold
    for f, cell in kept[dependent].tolist():
        result[factors[f]][cell] = True
    return result


def _classes(pairs: Ints, n_changes: Ints, dependent: Bools, *observed: NDArray[Any]) -> dict[int, int]:
    """Maps each value to the lowest value in its class; changes that are rare or depend on actions join no classes."""
    both: dict[tuple[int, int], int] = {}
    apart = {(min(pair), max(pair)) for pair in pairs[dependent].tolist()}
    for pair, n in zip(pairs.tolist(), n_changes.tolist(), strict=True):
        key = min(pair), max(pair)
        both[key] = both.get(key, 0) + n
    lowest = {int(value): int(value) for value in np.unique(np.concatenate(observed))}
    for (low, high), n in sorted(both.items()):
        if n >= RARE_CHANGE and (low, high) not in apart:
            one, other = lowest[low], lowest[high]
            merged = {value for value, name in lowest.items() if name in (one, other)}
            if not any(a in merged and b in merged for a, b in apart):
                lowest.update(dict.fromkeys(merged, min(one, other)))
    return lowest


def find_reached(found: Controllable, before: Values, actions: Actions, after: Values) -> Bools:
    """Factors that depend on actions directly or through other such factors, bool [F].

    The test is that of ``find_controllable``, but compares a change's probability between one value of another factor and its
    other values.
    """
    before, _, after = thinned(before, actions, after, MOST_COUNTED_STEPS // 2)
    changes, reached, new = _all_changes(before, after), found.directly.copy(), found.directly
    rest = [f for f, change in changes.items() if not reached[f] and (change.cell >= 0).sum() >= RARE_CHANGE]
    if not rest or not new.any():
        return reached
    of_values, kept_values = _columns([changes[f].value for f in rest], CELLS)
    of_cells, kept_cells = _columns([changes[f].cell for f in rest], CELLS)
    place = {(f, number): column for column, (f, number) in enumerate(kept_values.tolist())}
    origin = np.array([place.get((f, int(changes[rest[f]].start[cell])), -1) for f, cell in kept_cells.tolist()])
    of_cells, owner, origin = of_cells[:, origin >= 0], np.array(rest)[kept_cells[origin >= 0, 0]], origin[origin >= 0]
    while new.any() and len(origin):
        causes, _ = _columns([np.unique(before[:, f], return_inverse=True)[1] for f in np.flatnonzero(new)], CAUSES)
        causes = np.column_stack([causes, np.ones(len(causes), dtype=np.float32)])  # the last column counts all rows
        n, k = (np.rint(columns.T @ causes).astype(np.int64) for columns in (of_values, of_cells))
        logs = _evidence(k[:, :-1], n[origin, :-1], k[:, -1:], n[origin, -1:])
        new = np.zeros_like(reached)
        for f in np.unique(owner):
            new[f] = not reached[f] and _factor_evidence(logs[owner == f]).max() > SURE_EVIDENCE + math.log(logs.size)
        reached |= new
    return reached


def _all_changes(before: NDArray[Any], after: NDArray[Any]) -> dict[int, _Changes]:
    return {int(f): _changes_of(before[:, f], after[:, f]) for f in np.flatnonzero((before != after).any(axis=0))}


def _changes_of(before: NDArray[Any], after: NDArray[Any]) -> _Changes:
    known, value = np.unique(before, return_inverse=True)
    moved, cell = np.flatnonzero(before != after), np.full(len(before), -1, dtype=np.int64)
    width = int(after.max()) + 1
    pairs, cell[moved] = np.unique(value[moved] * width + after[moved], return_inverse=True)
    start = pairs // width
    return _Changes(value.astype(np.int64), cell, start, np.column_stack([known[start], pairs % width]).astype(np.int64))


def _columns(numbers: list[Ints], most: int, even: bool = False) -> tuple[NDArray[np.float32], Ints]:
    """(indicator columns float32 [N, C] of the most frequent numbers except -1, (list index, number) of each [C, 2]).

    With ``even``, the numbers that split the rows most evenly are chosen instead, and a list entry with two distinct numbers
    gets only one column.
    """
    found: list[tuple[int, int, int]] = []
    for i, row in enumerate(numbers):
        counts = np.bincount(row[row >= 0])
        weight = np.minimum(counts, len(row) - counts) if even else counts
        distinct = np.flatnonzero(counts)
        found += [
            (-int(weight[number]), i, int(number)) for number in (distinct[1:] if even and len(distinct) == 2 else distinct)
        ]
    kept = np.array([entry[1:] for entry in sorted(found)[:most]], dtype=np.int64).reshape(-1, 2)
    columns = np.zeros((len(numbers[0]), len(kept) + 1), dtype=np.float32)  # the last one for numbers without indicator
    for i in np.unique(kept[:, 0]):
        place = np.full(int(numbers[i].max()) + 2, len(kept), dtype=np.int64)  # the last one for -1
        own = np.flatnonzero(kept[:, 0] == i)
        place[kept[own, 1]] = own
        columns[np.arange(len(columns)), place[numbers[i]]] = 1.0
    return columns[:, :-1], kept


@cache
def _log_gammas() -> Floats:
    """[2, MOST_COUNTED_STEPS + 1]: log gamma(i + 1/2) - log gamma(1/2) in row 0, log gamma(i + 1) in row 1, i from 0."""
    halves = np.concatenate([[0.0], np.cumsum(np.log(np.arange(MOST_COUNTED_STEPS) + 0.5))])
    wholes = np.concatenate([[0.0], np.cumsum(np.log(np.arange(MOST_COUNTED_STEPS) + 1.0))])
    return np.stack([halves, wholes])


def _log_marginal(k: Ints, n: Ints) -> Floats:
    """Log marginal likelihood of a sequence of n rows with k changes, under Jeffreys' prior."""
    halves, wholes = _log_gammas()
    result: Floats = halves[k] + halves[n - k] - wholes[n]
    return result


def _evidence(k: Ints, n: Ints, all_k: Ints | None = None, all_n: Ints | None = None) -> Floats:
    """Log evidence (Bayes factor) [C, G] that a change's probability under a condition differs from that in other rows.

    Args:
        k: number of changes under each condition, int64 [C, G].
        n: number of rows under each condition, int64 [C, G].
        all_k: total number of changes, int64 [C, 1]; None for the sum over conditions.
        all_n: total number of rows, as ``all_k``.
    """
    all_k = k.sum(axis=1, keepdims=True) if all_k is None else all_k
    all_n = n.sum(axis=1, keepdims=True) if all_n is None else all_n
    return _log_marginal(k, n) + _log_marginal(all_k - k, all_n - n) - _log_marginal(all_k, all_n)


def _factor_evidence(logs: Floats) -> Floats:
    """Log evidence [G] that a factor depends on a condition: from its best change in ``logs`` [C, G] or, if more, all."""
    together = np.logaddexp(math.log(1.0 - LEAST_SHARE), math.log(LEAST_SHARE) + logs).sum(axis=0)
    result: Floats = np.maximum(logs.max(axis=0), together)
    return result
