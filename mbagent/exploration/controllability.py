"""Which factors actions have a say in, found from transitions by Bayesian evidence: a quick look, not a model."""

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
"""Transitions that are looked at; of more, evenly chosen ones."""

CELLS, CAUSES = 1024, 512
"""Changes, and values of other factors, that are set against each other at most: the most frequent ones."""

MOST_TABLE_COUNTS, MOST_VALUE = 4_000_000, 65_535
"""Numbers that are counted at once, and the largest value of a factor; one with more is neither steered nor cut into classes."""

LEAST_SHARE = 0.1
"""Of the changes of a factor that hangs on something, those that are expected to hang on it."""

SURE_EVIDENCE = 5.0
"""Log evidence, beyond the logarithm of the number of questions, from which on a dependence is believed."""

RARE_CHANGE = 16
"""What changed less often multiplies the states met by little, and what it hangs on is not to be told yet."""


@dataclass(frozen=True)
class Controllable:
    """What was found of F factors.

    Attributes:
        directly: the next value hangs on the action, given the present one, bool [F].
        classes: of each factor that changed, the lowest value of the class that each of its values belongs to. Values of a class
            change into each other often, but whatever is done.
    """

    directly: Bools
    classes: Mapping[int, Mapping[int, int]]


class StateAbstraction:
    """States as what matters of them: some factors as they are, of others only the class of each value.

    Args:
        found: what hangs on actions.
        whole: factors whose values are told apart in any case, bool [F].
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
        width = max((max(found.classes[factor]) for factor in some), default=0) + 2  # the last for any that was never met
        self.classes = np.repeat(np.arange(width)[None], len(some), axis=0)
        for row, factor in enumerate(some):
            for value, lowest in found.classes[factor].items():
                self.classes[row, value] = lowest

    def __call__(self, states: Values) -> States:
        """What matters of states [B, F], int64 [B, K]."""
        kept = states.take(self.factors, axis=1).astype(np.int64, copy=False)
        if not len(self.some):
            return kept
        known = np.minimum(states.take(self.some, axis=1), self.classes.shape[1] - 1)
        return np.concatenate([kept, self.classes[np.arange(len(self.some)), known]], axis=1)

    def same_as(self, other: StateAbstraction | None) -> bool:
        """Whether another tells the same states apart in the same words."""
        names = ("factors", "some", "classes")
        return other is not None and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)


@dataclass(frozen=True)
class _Changes:
    """How a factor changed: each present value with another next one is a cell.

    Attributes:
        value: number of the present value of each row, int64 [N].
        cell: number of the row's cell, -1 where nothing changed, int64 [N].
        start: the present value's number for each cell, int64 [C].
        ways: the present value and the next one of each cell, [C, 2].
    """

    value: Ints
    cell: Ints
    start: Ints
    ways: Ints


def thinned(before: Values, actions: Actions, after: Values, most: int = MOST_COUNTED_STEPS) -> tuple[Values, Actions, Values]:
    """At most so many of some transitions, evenly chosen."""
    if len(actions) <= most:
        return before, actions, after
    some = np.linspace(0, len(actions) - 1, most).astype(np.int64)
    return before[some], actions[some], after[some]


def find_controllable(before: Values, actions: Actions, after: Values, n_actions: int) -> Controllable:
    """Which of F factors hang on actions, and which values not even then.

    Each change is taken for itself: whether its probability, given the factor's present value, is another one after some action
    than after the rest, always or where some other factor has some value. Beta-binomial evidence answers; of a factor's changes,
    one must speak for itself, or many together.

    Args:
        before: states, integers of any width [N, F].
        actions: int64 [N].
        after: next states, as ``before``.
        n_actions: number of actions A.
    """
    before, actions, after = thinned(before, actions, after)
    changes = _all_changes(before, after)
    enough = SURE_EVIDENCE + math.log(n_actions * max(1, sum(len(change.start) for change in changes.values())))
    directly, classes = np.zeros(before.shape[1], dtype=np.bool_), {}
    contexts = _in_contexts(changes, before, actions, n_actions)
    for factor, change in changes.items():
        n_values, moved = int(change.value.max()) + 1, change.cell >= 0
        if (n_values + len(change.start)) * n_actions > MOST_TABLE_COUNTS or change.ways.max() > MOST_VALUE:
            classes[factor] = {int(value): int(value) for value in np.unique(before[:, factor])}
            continue
        pairs = change.value * n_actions + actions
        of_value = np.bincount(pairs, minlength=n_values * n_actions).reshape(n_values, -1)
        staying = np.bincount(pairs[~moved], minlength=n_values * n_actions).reshape(n_values, -1)
        of_cell = np.bincount(change.cell[moved] * n_actions + actions[moved], minlength=len(change.start) * n_actions)
        of_cell = of_cell.reshape(-1, n_actions)
        logs = _evidence(of_cell, of_value[change.start])
        directly[factor] = _speaks(logs).max() > enough or contexts[factor].any()
        odds = _evidence(of_cell, of_cell + staying[change.start])  # one change must not look steered for another that is
        dependent = contexts[factor] | (odds.max(axis=1) > enough / (1 + directly[factor]))
        times = np.where(
            staying.sum(axis=1)[change.start] < RARE_CHANGE, 0, of_cell.sum(axis=1)
        )  # without both, odds tell nothing
        classes[factor] = _classes(change.ways, times, dependent, before[:, factor], after[:, factor])
    return Controllable(directly, classes)


def _in_contexts(changes: Mapping[int, _Changes], before: Values, actions: Actions, n_actions: int) -> dict[int, Bools]:
    """For each factor, which of its cells hang on the action where some other factor has some value.

    What comes from the left by one action and from the right by another does not hang on the action alone.
    """
    result, factors = {f: np.zeros(len(change.start), dtype=np.bool_) for f, change in changes.items()}, list(changes)
    some = (
        slice(None)
        if len(actions) <= MOST_COUNTED_STEPS // 2
        else np.linspace(0, len(actions) - 1, MOST_COUNTED_STEPS // 2).astype(np.int64)
    )
    of_cells, kept = _columns([changes[f].cell[some] for f in factors], CELLS)
    stays = [np.where(changes[f].cell[some] < 0, changes[f].value[some], -1) for f in factors]
    of_values, kept_values = _columns(stays, CELLS)
    place = {(f, number): column for column, (f, number) in enumerate(kept_values.tolist())}
    begun = np.array([place.get((f, int(changes[factors[f]].start[cell])), -1) for f, cell in kept.tolist()], dtype=np.int64)
    of_cells, kept, begun = of_cells[:, begun >= 0], kept[begun >= 0], begun[begun >= 0]
    most = min(CAUSES, MOST_TABLE_COUNTS // (n_actions * max(1, len(begun))))
    causes, _ = _columns([np.unique(before[some, f], return_inverse=True)[1] for f in factors], most, even=True)
    if not len(begun) or not causes.shape[1]:
        return result
    chosen = [actions[some] == action for action in range(n_actions)]
    k, n = (
        np.stack([np.rint(columns[own].T @ causes[own]) for own in chosen]).astype(np.int64) for columns in (of_cells, of_values)
    )
    n = n[:, begun] + k
    enough, all_k, all_n = SURE_EVIDENCE + math.log(k.size), k.sum(axis=0), n.sum(axis=0)
    dependent = np.max([(_evidence(k[a], n[a], all_k, all_n)).max(axis=1) for a in range(n_actions)], axis=0) > enough
    for f, cell in kept[dependent].tolist():
        result[factors[f]][cell] = True
    return result


def _classes(ways: Ints, times: Ints, dependent: Bools, *met: NDArray[Any]) -> dict[int, int]:
    """The lowest value of each value's class; what changed too few ``times`` to tell whether it hangs on actions stays apart."""
    both: dict[tuple[int, int], int] = {}
    apart = {(min(pair), max(pair)) for pair in ways[dependent].tolist()}
    for pair, n in zip(ways.tolist(), times.tolist(), strict=True):
        key = min(pair), max(pair)
        both[key] = both.get(key, 0) + n
    lowest = {int(value): int(value) for value in np.unique(np.concatenate(met))}
    for (low, high), n in sorted(both.items()):
        if n >= RARE_CHANGE and (low, high) not in apart:
            one, other = lowest[low], lowest[high]
            merged = {value for value, name in lowest.items() if name in (one, other)}
            if not any(a in merged and b in merged for a, b in apart):
                lowest.update(dict.fromkeys(merged, min(one, other)))
    return lowest


def find_reached(found: Controllable, before: Values, actions: Actions, after: Values) -> Bools:
    """Factors that hang on actions, or on others of which this is true, bool [F].

    As in ``find_controllable``: whether a change is more or less probable beside some value of the other factor.
    """
    before, _, after = thinned(before, actions, after, MOST_COUNTED_STEPS // 2)
    changes, reached, new = _all_changes(before, after), found.directly.copy(), found.directly
    rest = [f for f, change in changes.items() if not reached[f] and (change.cell >= 0).sum() >= RARE_CHANGE]
    if not rest or not new.any():
        return reached
    of_values, kept_values = _columns([changes[f].value for f in rest], CELLS)
    of_cells, kept_cells = _columns([changes[f].cell for f in rest], CELLS)
    place = {(f, number): column for column, (f, number) in enumerate(kept_values.tolist())}
    begun = np.array([place.get((f, int(changes[rest[f]].start[cell])), -1) for f, cell in kept_cells.tolist()])
    of_cells, owner, begun = of_cells[:, begun >= 0], np.array(rest)[kept_cells[begun >= 0, 0]], begun[begun >= 0]
    while new.any() and len(begun):
        causes, _ = _columns([np.unique(before[:, f], return_inverse=True)[1] for f in np.flatnonzero(new)], CAUSES)
        causes = np.column_stack([causes, np.ones(len(causes), dtype=np.float32)])  # the last column for all rows
        n, k = (np.rint(columns.T @ causes).astype(np.int64) for columns in (of_values, of_cells))
        logs = _evidence(k[:, :-1], n[begun, :-1], k[:, -1:], n[begun, -1:])
        new = np.zeros_like(reached)
        for f in np.unique(owner):
            new[f] = not reached[f] and _speaks(logs[owner == f]).max() > SURE_EVIDENCE + math.log(logs.size)
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
    """Indicators float32 [N, C] of the most frequent numbers but -1, and for each column its row in the list and its number.

    With ``even``, those come first that cut the rows most evenly, and of a factor with two values one is enough.
    """
    found: list[tuple[int, int, int]] = []
    for i, row in enumerate(numbers):
        times = np.bincount(row[row >= 0])
        weight = np.minimum(times, len(row) - times) if even else times
        met = np.flatnonzero(times)
        found += [(-int(weight[number]), i, int(number)) for number in (met[1:] if even and len(met) == 2 else met)]
    kept = np.array([entry[1:] for entry in sorted(found)[:most]], dtype=np.int64).reshape(-1, 2)
    columns = np.zeros((len(numbers[0]), len(kept) + 1), dtype=np.float32)  # the last for those that are left out
    for i in np.unique(kept[:, 0]):
        place = np.full(int(numbers[i].max()) + 2, len(kept), dtype=np.int64)  # the last for -1
        own = np.flatnonzero(kept[:, 0] == i)
        place[kept[own, 1]] = own
        columns[np.arange(len(columns)), place[numbers[i]]] = 1.0
    return columns[:, :-1], kept


@cache
def _log_gammas() -> Floats:
    """Of 1/2, 3/2, ..., minus that of 1/2; and below it of 1, 2, 3, ...: [2, MOST_COUNTED_STEPS + 1]."""
    halves = np.concatenate([[0.0], np.cumsum(np.log(np.arange(MOST_COUNTED_STEPS) + 0.5))])
    wholes = np.concatenate([[0.0], np.cumsum(np.log(np.arange(MOST_COUNTED_STEPS) + 1.0))])
    return np.stack([halves, wholes])


def _chance(k: Ints, n: Ints) -> Floats:
    """Log-probability of k changes among n in a given order, by Jeffreys' prior."""
    halves, wholes = _log_gammas()
    result: Floats = halves[k] + halves[n - k] - wholes[n]
    return result


def _evidence(k: Ints, n: Ints, all_k: Ints | None = None, all_n: Ints | None = None) -> Floats:
    """Log evidence that changes [C, G], k among n, are more or less probable there than in the rest.

    Args:
        k: changes under each condition, int64 [C, G].
        n: rows under each condition, int64 [C, G].
        all_k: changes in all, int64 [C, 1]; None for the sum over conditions.
        all_n: rows in all, as ``all_k``.
    """
    all_k = k.sum(axis=1, keepdims=True) if all_k is None else all_k
    all_n = n.sum(axis=1, keepdims=True) if all_n is None else all_n
    return _chance(k, n) + _chance(all_k - k, all_n - n) - _chance(all_k, all_n)


def _speaks(logs: Floats) -> Floats:
    """Log evidence [G] of a factor's changes [C, G], that one alone hangs on it, or a share of them."""
    together = np.logaddexp(math.log(1.0 - LEAST_SHARE), math.log(LEAST_SHARE) + logs).sum(axis=0)
    result: Floats = np.maximum(logs.max(axis=0), together)
    return result
