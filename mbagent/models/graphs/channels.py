"""Learning graphs for planes: one for each channel, from all positions at once."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs import draws
from mbagent.models.graphs.compiled import Graphs
from mbagent.models.graphs.conditioner import UNCERTAIN, go_together, uncertain_rows
from mbagent.models.graphs.fitting import nothing_late
from mbagent.models.graphs.instantiate import COLUMN, ROW, WHOLE, Coupling
from mbagent.models.graphs.looks import PlaneTable
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import Layout, Question, Seen, ask, distinct
from mbagent.models.graphs.windows import NEXT, column_values, shifted
from mbagent.models.graphs.zoom import zoom
from mbagent.spaces import PlaneLayout
from mbagent.transitions import TransitionBatch

Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Floats: TypeAlias = NDArray[np.float64]

TOGETHER = 12.0
"""Two bits of a set must have been expected together this often before "never" is believed of them."""

SOME_CELLS = 100_000
"""Cells that are looked at for errors that go together."""


def learn_channels(planes: PlaneTable) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of all channels, each cell for itself, and of ``terminated``."""
    asked: list[Question] = []
    copied_asked: list[Question] = []
    copied: list[Search] = []
    for channel, cardinality in enumerate(planes.cardinalities):
        columns = planes.told_by(channel)
        if columns is None:
            asked += ask(channel, cardinality, planes.seen(channel))
        else:
            questions, table = planes.copying(channel, columns)
            copied_asked, copied = copied_asked + questions, copied + planes.split(questions, table, columns)
    found = planes.split(asked, planes.table, planes.near) if asked else []
    found = zoom(planes, asked, found)
    asked, found = asked + copied_asked, found + copied
    if planes.rows.terminated.any():
        over, searches = _ends(planes, planes.far)
        asked, found = asked + over, found + searches
    return planes.build(asked, found), asked, found


def _ends(planes: PlaneTable, numbers: Ints) -> tuple[list[Question], list[Search]]:
    """Whether episodes end, by columns that are the same at all positions."""
    rows, far = planes.rows, planes.far_values(numbers)
    first, pattern = distinct(np.packbits(far, axis=1))
    nothing, ends = np.zeros(len(rows), dtype=np.int64), rows.terminated.astype(np.int64)
    counting = np.arange(min(planes.since[-1], len(rows)), len(rows))
    asked = ask(len(planes.cardinalities), 2, Seen(pattern, planes.acts.way[rows.actions], nothing, ends).select(counting))
    return asked, planes.split(asked, far[first], numbers)


def learn_late(planes: PlaneTable, layout: Layout, graphs: Graphs) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of the channels whose cells hang on what others become, given those; and of ``terminated``.

    Args:
        planes: the transitions.
        layout: of the board.
        graphs: of all cells, each for itself.
    """
    late, asked, found = [], [], []
    for channel, numbers in _dependent(planes, layout, graphs).items():
        units = layout.cells[channel].ravel()
        needed = uncertain_rows(planes.rows, layout, graphs, units)
        counting = planes.cells_since(channel)
        kept = np.flatnonzero((needed & (layout.coupling_of[units] < 0)).ravel()[counting])
        some, which = planes.seen(channel).select(kept), counting[kept]
        following = column_values(planes.columns[numbers], planes.before, planes.rows.actions, planes.after)[which]
        first, pattern = distinct(following, some.pattern)
        questions = ask(channel, planes.cardinalities[channel], replace(some, pattern=pattern))
        table = np.concatenate([planes.table[some.pattern[first]], following[first]], axis=1)
        searches = planes.split(questions, table, np.concatenate([planes.near, numbers])) if questions else []
        if any(split.column in numbers for search in searches for split in search.splits):
            late.append(channel)
            asked += questions
            found += searches
    if planes.rows.terminated.any():
        over, searches = _ends(planes, np.concatenate([planes.far, planes.next_far]))
        if any(split.column in planes.next_far for search in searches for split in search.splits):
            late.append(len(planes.cardinalities))
            asked, found = asked + over, found + searches
    if not late:
        return nothing_late(graphs), [], []
    return planes.build(asked, found)._replace(changing=np.asarray(late, dtype=np.int64)), asked, found


def _dependent(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[int, Ints]:
    """For each channel, numbers of the columns of the kind NEXT whose errors go with those of its cells."""
    errors = _errors(planes, layout, graphs)
    found: dict[int, Ints] = {}
    for channel in sorted({c for c, _ in errors}):
        own = [errors[key] for key in errors if key[0] == channel]
        earlier = [d for d in np.flatnonzero(planes.columns[:, 0] == NEXT) if _is_earlier(planes.columns[d], channel)]
        kept = []
        for d in earlier:
            _, other, value, below, right, _, _ = (int(part) for part in planes.columns[d])
            if (other, value) in errors:
                error, spread = (shifted(part, below, right) for part in errors[other, value])
                if any(go_together(e, error, v, spread, len(earlier)) for e, v in own):
                    kept.append(int(d))
        if kept:
            found[channel] = np.asarray(kept, dtype=np.int64)
    return found


def _is_earlier(column: Ints, channel: int) -> bool:
    """Whether a cell of the next state is drawn before those of the channel at the same place."""
    return bool(column[1] < channel or (column[1] == channel and tuple(column[3:5]) < (0, 0)))


def _errors(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    """Errors and their variances, [n, H, W] each, of every (channel, value) that is uncertain, in some rows."""
    if len(planes.rows) == 0:
        return {}
    n = min(max(100, SOME_CELLS // planes.n_cells), len(planes.rows))
    some = np.linspace(0, len(planes.rows) - 1, n).astype(np.int64)
    rows, cards = planes.rows.select(some), np.empty(layout.n_factors, dtype=np.int64)
    for channel, k in enumerate(planes.cardinalities):
        cards[layout.cells[channel]] = k
    start = np.concatenate([[0], np.cumsum(cards)]).astype(np.int64)
    probs = np.empty((n, int(start[-1])))
    draws.marginals(rows.states, rows.actions, layout, graphs, start, probs)
    found = {}
    for channel, k in enumerate(planes.cardinalities):
        alone = layout.coupling_of[layout.cells[channel]] < 0
        for value in range(k) if k > 2 else (1,):
            p = probs[:, start[layout.cells[channel]] + value]
            spread = p * (1.0 - p) * alone
            if spread.sum() > UNCERTAIN:
                found[channel, value] = ((planes.after[some, channel] == value) - p) * alone, spread
    return found


def find_couplings(
    rows: TransitionBatch, board: PlaneLayout, cardinalities: tuple[int, ...], some: TransitionBatch, ones: Floats
) -> tuple[Coupling, ...]:
    """Sets of cells that are coupled: whole channels of which one cell is on, or lines of which two are never on.

    Args:
        rows: all transitions.
        board: where cells lie.
        cardinalities: number of values of each channel's cells.
        some: a few of the transitions.
        ones: each cell's probability to be on after those, [n, C, H, W].
    """
    if len(rows) == 0:
        return ()
    before, after = board.to_planes(rows.before), board.to_planes(rows.after)
    found: list[tuple[float, Coupling]] = []
    for channel in (c for c, k in enumerate(cardinalities) if k == 2):
        count = after[:, channel].sum(axis=(1, 2))
        if len(count) and (count == 1).all() and (before[:, channel].sum(axis=(1, 2)) == 1).all():
            found.append((np.inf, Coupling(channel, WHOLE, 0, True)))
            continue
        for kind, axis, length in ((WHOLE, (1, 2), 1), (ROW, (2,), board.height), (COLUMN, (1,), board.width)):
            p = ones[:, channel]
            total, squares = p.sum(axis=axis).reshape(len(p), -1), (p**2).sum(axis=axis).reshape(len(p), -1)
            expected = (total**2 - squares).sum(axis=0) / 2.0 * (len(rows) / max(len(some), 1))
            alone = after[:, channel].sum(axis=axis, dtype=np.int64).reshape(len(rows), -1).max(axis=0, initial=0) <= 1
            for i in np.flatnonzero(alone & (expected > TOGETHER)):
                line = int(i) if i < (length + 1) // 2 else int(i) - length
                found.append((float(expected[i]), Coupling(channel, kind, line, False)))
    found.sort(key=lambda entry: -entry[0])
    return tuple(coupling for _, coupling in found)
