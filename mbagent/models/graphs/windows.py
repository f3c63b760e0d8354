"""What a cell of a stack of planes can hang on: its neighbourhood, the border, the action, and what meets what anywhere.

Columns are relative, the same for every position, so that what is learned at one position holds at all: modules that are
alike share what they know (the paper's section 5). Shapes: N transitions, C channels, P positions, D relative columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Ints: TypeAlias = NDArray[np.int64]
_T = TypeVar("_T", bound=np.generic)
Bools: TypeAlias = NDArray[np.bool_]

CELL, BORDER, ACTION, MEETING, NEXT = 0, 1, 2, 3, 4
"""Kinds of relative columns: (CELL, channel, value, rows below, columns right, 0, 0), (BORDER, rows below, columns right, 0 ...),
(ACTION, action, 0 ...), (MEETING, channel, value, channel, value, rows below, columns right), and (NEXT, ...), a CELL of the next
state."""

NEXT_RADIUS = 2
"""Rows and columns that a neighbourhood in the next state reaches: two places that a thing may go to lie so far apart."""


def relative_columns(cardinalities: Sequence[int], n_actions: int, radius: int) -> Ints:
    """All relative columns, int64 [D, 7]; see above.

    Args:
        cardinalities: number of values of each channel's cells, length C.
        n_actions: number of actions A.
        radius: rows and columns that a neighbourhood reaches in each direction.
    """
    reach = range(-radius, radius + 1)
    offsets = list(itertools.product(reach, reach))
    shown = [(c, v) for c, k in enumerate(cardinalities) for v in (range(k) if k != 2 else (1,))]
    columns = [(CELL, c, v, dy, dx, 0, 0) for dy, dx in offsets for c, v in shown]
    columns += [(BORDER, dy, dx, 0, 0, 0, 0) for dy, dx in offsets if (dy, dx) != (0, 0)]
    columns += [(ACTION, action, 0, 0, 0, 0, 0) for action in range(n_actions)]
    for i, first in enumerate(shown):
        for second in shown[i:]:
            near = itertools.product((-1, 0, 1), (-1, 0, 1))
            columns += [(MEETING, *first, *second, dy, dx) for dy, dx in near if first != second or (dy, dx) >= (0, 0)]
    further = range(-NEXT_RADIUS, NEXT_RADIUS + 1)
    columns += [(NEXT, c, v, dy, dx, 0, 0) for dy, dx in itertools.product(further, further) for c, v in shown]
    return np.asarray(columns, dtype=np.int64).reshape(-1, 7)


def known_columns(columns: Ints, planes: Ints) -> Ints:
    """Numbers of the relative columns that are about values met in planes [N, C, H, W]."""
    met = [np.unique(planes[:, channel]) for channel in range(planes.shape[1])]

    def known(column: Ints) -> bool:
        if column[0] in (CELL, NEXT):
            return bool(column[2] in met[column[1]])
        return column[0] != MEETING or bool(column[2] in met[column[1]] and column[4] in met[column[3]])

    return np.flatnonzero([known(column) for column in columns])


def column_values(columns: Ints, planes: Ints, actions: Ints, after: Ints | None = None) -> Bools:
    """Which columns are on for every transition and position, bool [N * P, D], positions of a transition together.

    Args:
        columns: relative columns, int64 [D, 7].
        planes: int64 [N, C, H, W].
        actions: int64 [N].
        after: the next states' planes, for columns of the kind NEXT.
    """
    n, _, height, width = planes.shape
    table = np.empty((len(columns), n, height, width), dtype=np.bool_)
    inside = np.ones((height, width), dtype=np.bool_)
    for d, column in enumerate(columns):
        if column[0] == CELL:
            table[d] = shifted(planes[:, column[1]] == column[2], column[3], column[4])
        elif column[0] == NEXT:
            assert after is not None
            table[d] = shifted(after[:, column[1]] == column[2], column[3], column[4])
        elif column[0] == BORDER:
            table[d] = ~shifted(inside[None], column[1], column[2])
        elif column[0] == ACTION:
            table[d] = (actions == column[1])[:, None, None]
        else:
            table[d] = meets(planes, column[1:])[:, None, None]
    return np.ascontiguousarray(table.reshape(len(columns), n * height * width).T)


def shifted(plane: NDArray[_T], below: int, right: int) -> NDArray[_T]:
    """What lies so many rows below and columns to the right of each position of [N, H, W]; 0 beyond the border."""
    _, height, width = plane.shape
    result = np.zeros_like(plane)
    rows, columns = slice(max(0, -below), min(height, height - below)), slice(max(0, -right), min(width, width - right))
    source_rows = slice(max(0, below), min(height, height + below))
    source_columns = slice(max(0, right), min(width, width + right))
    result[:, rows, columns] = plane[:, source_rows, source_columns]
    return result


def meets(planes: Ints, meeting: Ints) -> Bools:
    """Whether, anywhere, one channel has a value and the other has its value so far from there, bool [N]."""
    first, value, second, other, below, right = (int(part) for part in meeting)
    found: Bools = ((planes[:, first] == value) & shifted(planes[:, second] == other, below, right)).any(axis=(1, 2))
    return found


def column_kinds(columns: Ints) -> Ints:
    """Which kind of thing each relative column is, int64 [D]: a channel's cells (now, next), border, action, meeting."""
    kind = columns[:, 0]
    n_channels = int(columns[kind == CELL, 1].max(initial=0)) + 1
    kinds = np.where(kind == CELL, columns[:, 1], np.where(kind == NEXT, n_channels + columns[:, 1], 2 * n_channels + kind))
    return kinds.astype(np.int64)
