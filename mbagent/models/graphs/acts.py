"""Actions as graphs see them: one thing of so many, or several parts of which each is a cause for itself.

A joint action of many parts (a MultiBinary or MultiDiscrete space) is one of very many numbers, each taken a few times only.
By its parts far more is learned from as many steps: all actions that agree in the parts that matter are one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Ints: TypeAlias = NDArray[np.int64]


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
