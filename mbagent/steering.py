"""Which factors actions have a say in, found from transitions by Bayesian evidence: a quick look, not a model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Actions, Bools, Floats, States

Ints = NDArray[np.int64]

LOOKED_AT = 8192
"""Transitions that are looked at; of more, evenly chosen ones."""

CELLS, CAUSES = 2048, 1024
"""Changes, and values of other factors, that are set against each other at most: the most frequent ones."""

SHARE = 0.1
"""Of the changes of a factor that hangs on something, those that are expected to hang on it."""

SURE = 5.0
"""Log evidence, beyond the logarithm of the number of questions, from which on a dependence is believed."""

RARE = 16
"""A factor that changed less often multiplies the states met by little, and what it hangs on is not to be told yet."""


class Steered(NamedTuple):
    """What was found of F factors.

    Attributes:
        directly: the next value hangs on the action, given the present one, bool [F].
        at_all: so it does, or on a factor of which this is true, bool [F].
        rare: changed less than RARE times, bool [F].
    """

    directly: Bools
    at_all: Bools
    rare: Bools


@dataclass(frozen=True)
class _Changes:
    """How a factor changed: each present value with another next one is a cell.

    Attributes:
        value: number of the present value of each row, int64 [N].
        cell: number of the row's cell, -1 where nothing changed, int64 [N].
        start: the present value of each cell, int64 [C].
    """

    value: Ints
    cell: Ints
    start: Ints


def find_steered(before: States, actions: Actions, after: States, n_actions: int) -> Steered:
    """Which of F factors hang on actions.

    Each change is taken for itself: whether its probability, given the factor's present value, is another one after some action
    than after the rest, or beside some value of a steered factor than beside the rest. Beta-binomial evidence answers; of a factor's
    changes, one must speak for itself, or many together.

    Args:
        before, after: states [N, F], integers of any width.
        actions: int64 [N].
        n_actions: number of actions A.
    """
    if len(actions) > LOOKED_AT:
        some = np.linspace(0, len(actions) - 1, LOOKED_AT).astype(np.int64)
        before, actions, after = before[some], actions[some], after[some]
    times = (before != after).sum(axis=0)
    changes = {int(f): _changes_of(before[:, f], after[:, f]) for f in np.flatnonzero(times)}
    n_cells = sum(len(change.start) for change in changes.values())
    directly = np.zeros(before.shape[1], dtype=np.bool_)
    for factor, change in changes.items():
        n_values = int(change.value.max()) + 1
        of_value = np.bincount(change.value * n_actions + actions, minlength=n_values * n_actions).reshape(n_values, -1)
        moved = change.cell >= 0
        of_cell = np.bincount(change.cell[moved] * n_actions + actions[moved], minlength=len(change.start) * n_actions)
        logs = _evidence(of_cell.reshape(-1, n_actions), of_value[change.start])
        directly[factor] = _speaks(logs).max() > SURE + math.log(n_cells * n_actions)
    at_all, new = directly.copy(), directly
    while new.any() and (rest := [f for f in changes if not at_all[f] and times[f] >= RARE]):
        found = _hanging({f: changes[f] for f in rest}, before, np.flatnonzero(new))
        new = np.isin(np.arange(len(at_all)), found)
        at_all |= new
    return Steered(directly, at_all, times < RARE)


def _changes_of(before: NDArray[Any], after: NDArray[Any]) -> _Changes:
    known, value = np.unique(before, return_inverse=True)
    moved, cell = np.flatnonzero(before != after), np.full(len(before), -1, dtype=np.int64)
    width = int(after.max()) + 1
    pairs, number = np.unique(value[moved] * width + after[moved], return_inverse=True)
    cell[moved] = number
    return _Changes(value.astype(np.int64), cell, pairs // width)


def _hanging(changes: dict[int, _Changes], before: States, causes: Ints) -> list[int]:
    """Those factors whose changes hang on a value of one of the causes."""
    shown = _columns([np.unique(before[:, f], return_inverse=True)[1] for f in causes], CAUSES)[0]
    starts, cells = [c.value for c in changes.values()], [c.cell for c in changes.values()]
    of_values, kept_values = _columns(starts, CELLS)
    of_cells, kept_cells = _columns(cells, CELLS)
    place = {pair: i for i, pair in enumerate(map(tuple, kept_values.tolist()))}
    factors = list(changes)
    begun = np.array([place.get((f, int(changes[factors[f]].start[c])), -1) for f, c in kept_cells.tolist()], dtype=np.int64)
    kept_cells, of_cells, begun = kept_cells[begun >= 0], of_cells[:, begun >= 0], begun[begun >= 0]
    if not len(begun) or not shown.shape[1]:
        return []
    n, k = (np.rint(columns.T @ np.column_stack([shown, np.ones(len(shown))])).astype(np.int64) for columns in (of_values, of_cells))
    logs = _evidence(k[:, :-1], n[begun, :-1], k[:, -1:], n[begun, -1:])
    enough = SURE + math.log(logs.size)
    return [f for i, f in enumerate(factors) if (kept_cells[:, 0] == i).any() and _speaks(logs[kept_cells[:, 0] == i]).max() > enough]


def _columns(numbers: list[Ints], most: int) -> tuple[NDArray[np.float32], Ints]:
    """Indicators float32 [N, C] of the most frequent numbers, -1 left out, and for each column its row in the list and its number."""
    found: list[tuple[int, int, int]] = []
    for i, row in enumerate(numbers):
        times = np.bincount(row[row >= 0])
        found += [(-int(times[number]), i, int(number)) for number in np.flatnonzero(times)]
    kept = np.array([entry[1:] for entry in sorted(found)[:most]], dtype=np.int64).reshape(-1, 2)
    columns = np.empty((len(numbers[0]), len(kept)), dtype=np.float32)
    for column, (i, number) in enumerate(kept.tolist()):
        columns[:, column] = numbers[i] == number
    return columns, kept


@cache
def _log_gammas() -> Floats:
    """Of 1/2, 3/2, ..., minus that of 1/2; and below it of 1, 2, 3, ...: [2, LOOKED_AT + 1]."""
    halves = np.concatenate([[0.0], np.cumsum(np.log(np.arange(LOOKED_AT) + 0.5))])
    wholes = np.concatenate([[0.0], np.cumsum(np.log(np.arange(LOOKED_AT) + 1.0))])
    return np.stack([halves, wholes])


def _chance(k: Ints, n: Ints) -> Floats:
    """Log-probability of k changes among n in a given order, by Jeffreys' prior."""
    halves, wholes = _log_gammas()
    result: Floats = halves[k] + halves[n - k] - wholes[n]
    return result


def _evidence(k: Ints, n: Ints, all_k: Ints | None = None, all_n: Ints | None = None) -> Floats:
    """Log evidence that changes [C, G], k among n, are more or less probable there than in the rest.

    Args:
        k, n: changes and rows under each condition, int64 [C, G].
        all_k, all_n: in all, int64 [C, 1]; None for the sums over conditions.
    """
    all_k, all_n = (k.sum(axis=1, keepdims=True) if all_k is None else all_k), (n.sum(axis=1, keepdims=True) if all_n is None else all_n)
    return _chance(k, n) + _chance(all_k - k, all_n - n) - _chance(all_k, all_n)


def _speaks(logs: Floats) -> Floats:
    """Log evidence [G] of a factor's changes [C, G], that one alone hangs on it, or a share of them."""
    together = np.logaddexp(math.log(1.0 - SHARE), math.log(SHARE) + logs).sum(axis=0)
    return np.maximum(logs.max(axis=0), together)
