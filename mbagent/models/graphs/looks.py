"""Transitions of planes as a table of what cells look like, of as many transitions as there is room for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.acts import Acts
from mbagent.models.graphs.compiled import Graphs, build
from mbagent.models.graphs.greedy import find_splits
from mbagent.models.graphs.habits import habit_of
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import Layout, Question, Seen, ask, distinct, lay_out
from mbagent.models.graphs.windows import (
    ACTION,
    BORDER,
    CELL,
    MEETING,
    NEXT_MEETING,
    WRAP,
    column_kinds,
    column_values,
    far_value,
    known_columns,
    told_by,
)
from mbagent.spaces import PlaneLayout
from mbagent.transitions import Factors, TransitionBatch

Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]

MOST_CELLS = 200_000_000
"""Entries of the table of columns that the search reads; of more transitions than that, some from all over are searched."""

QUICK_CELLS = 50_000_000
"""As MOST_CELLS, for a quick look that asks for single causes only."""

FEWEST_CHANGES = 50
"""Cells of a channel that must have changed as another's did, before it is taken for a copy."""

MOST_COUNTED = 1_000_000_000
"""Values of cells that are gone through in all, a byte each before and after a step."""

CHUNK = 50_000_000
"""Entries of the table that are made at once."""


def channel_layout(cardinalities: Sequence[int], acts: Acts) -> Layout:
    """Channels as the factors of a layout; its own columns mean nothing."""
    return lay_out(cardinalities, (), acts, ordinal=False)


def _counted(rows: TransitionBatch) -> tuple[TransitionBatch, Ints]:
    """The rows that are gone through, and their numbers."""
    most = max(1, MOST_COUNTED // max(1, rows.before.shape[1]))
    if len(rows) <= most:
        return rows, np.arange(len(rows))
    counted = np.linspace(0, len(rows) - 1, most).astype(np.int64)
    return rows.select(counted), counted


class PlaneTable:
    """Transitions of planes, as cells with their relative columns.

    Attributes:
        table: columns of the neighbourhood of all cells that look different, bool [looks, near].
        whole: whether it is of all transitions.
        most_looks: rows that a table for a search may have.
        every: planes of all transitions and of their next states; of evenly chosen ones where that were over MOST_COUNTED.

    Args:
        rows: N transitions.
        board: where cells lie.
        cardinalities: number of values of each channel's cells, length C.
        columns: all relative columns, int64 [D, 7].
        acts: the actions.
        since: first row that counts for each channel and for ``terminated``, int64 [C + 1]; None for all.
        in_pairs: whether to look for causes that matter only together, which takes most of the time.
    """

    def __init__(
        self,
        rows: TransitionBatch,
        board: PlaneLayout,
        cardinalities: tuple[int, ...],
        columns: Ints,
        acts: Acts,
        since: Ints | None = None,
        in_pairs: bool = True,
    ) -> None:
        """See the class."""
        self.in_pairs = in_pairs
        self.board, self.cardinalities, self.columns, self.acts = board, cardinalities, columns, acts
        self.n_cells = board.height * board.width
        self.since = np.zeros(len(cardinalities) + 1, dtype=np.int64) if since is None else since
        rows, counted = _counted(rows)
        self.since = np.searchsorted(counted, self.since)
        self.every = board.to_planes(rows.before), board.to_planes(rows.after)
        self.every_action, self.every_since = rows.actions, self.since
        known = known_columns(columns, *self.every)
        kind = columns[known, 0]
        here = np.isin(kind, (CELL, BORDER, ACTION, WRAP)) | ((kind == MEETING) & (columns[known, 5:] == 0).all(axis=1))
        self.near, self.far, self.next_far = (
            known[which] for which in (here, np.isin(kind, (MEETING, ACTION)), kind == NEXT_MEETING)
        )
        self.most_looks = (MOST_CELLS if in_pairs else QUICK_CELLS) // max(len(self.near), 1)
        self.table, self.pattern, taken = self._looks(self.every[0], rows.actions)
        self.whole = len(taken) == len(rows)
        self.rows = rows if self.whole else rows.select(taken)
        self.before, self.after = board.to_planes(self.rows.before), board.to_planes(self.rows.after)
        self.since = np.searchsorted(taken, self.since)
        self.actions = np.repeat(acts.way[self.rows.actions], self.n_cells)

    def _looks(self, planes: Factors, actions: Ints) -> tuple[Bools, Ints, Ints]:
        """Columns of all cells that look different, which each cell looks like, and which transitions that is of.

        Transitions from all over are taken as long as there is room.
        """
        most, step = self.most_looks, max(1, CHUNK // (self.n_cells * max(len(self.near), 1)))
        looks, n_parts = np.zeros((0, -(-len(self.near) // 8)), dtype=np.uint8), -(-len(planes) // step)
        pattern, taken = [np.zeros((0, self.n_cells), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for number in range(n_parts):
            if len(looks) >= most:
                break
            part = np.arange(number, len(planes), n_parts)
            packed = np.packbits(column_values(self.columns[self.near], planes[part], actions[part]), axis=1)
            first, of = distinct(packed)
            both, known = np.concatenate([looks, packed[first]]), len(looks)
            kept, now = distinct(both)
            renamed = np.argsort(np.argsort(kept, kind="stable"), kind="stable")[now]  # looks known before keep their numbers
            looks = both[np.sort(kept)]
            pattern.append(renamed[known:][of].reshape(len(part), self.n_cells))
            taken.append(part)
        rows = np.concatenate(taken)
        order = np.argsort(rows)
        table = np.unpackbits(looks, axis=1, count=len(self.near)).astype(np.bool_)
        return table, np.concatenate(pattern)[order].ravel(), rows[order]

    def seen(self, channel: int) -> Seen:
        """A channel's values in all cells; looks are rows of ``table``."""
        now, then = (planes[:, channel].reshape(-1).astype(np.int64) for planes in (self.before, self.after))
        return Seen(self.pattern, self.actions, now, then).select(self.cells_since(channel))

    def told_by(self, channel: int) -> Ints | None:
        """Columns that alone tell what a channel becomes, see ``windows.told_by``; None where none do, or it changed rarely."""
        before, after = (planes[:, channel] for planes in self.every)
        if (before != after).sum() < FEWEST_CHANGES:
            return None
        return told_by(channel, self.columns, self.near, *self.every, self.every_action)

    def copying(self, channel: int, columns: Ints) -> tuple[list[Question], Bools]:
        """The questions about a channel that some columns alone tell all of, with the table of those columns."""
        seen, cardinality = self.seen(channel), self.cardinalities[channel]
        told = column_values(self.columns[columns], self.before, self.rows.actions)[self.cells_since(channel)]
        value = np.concatenate([told, np.ones((len(told), 1), dtype=np.bool_)], axis=1).argmax(axis=1)
        look = (seen.actions * cardinality + seen.now) * (len(columns) + 1) + value
        first = np.full(self.acts.n_ways * cardinality * (len(columns) + 1), -1)
        first[look[::-1]] = np.arange(len(look))[::-1]
        return ask(channel, cardinality, replace(seen, pattern=look)), told[first]

    def cells_since(self, channel: int) -> Ints:
        """Numbers of the cells that count for a channel."""
        return np.arange(min(self.since[channel] * self.n_cells, len(self.actions)), len(self.actions))

    def far_values(self, numbers: Ints) -> Bools:
        """Columns that are the same at all positions, bool [N, len(numbers)]."""
        found = [far_value(self.columns[d], self.before, self.rows.actions, self.after) for d in numbers]
        return np.stack(found, axis=1)

    def split(self, asked: Sequence[Question], table: Bools, numbers: Ints) -> list[Search]:
        """Splits by columns of a table, which have these numbers among the relative ones."""
        kinds = column_kinds(self.columns)[numbers]
        found = find_splits([q.head for q in asked], table, kinds, self.acts.n_ways, self.in_pairs)
        return [search.renamed(numbers) for search in found]

    def build(self, asked: Sequence[Question], found: Sequence[Search]) -> Graphs:
        """Graphs of channels, ``terminated`` and the event that never happens."""
        seen = [self.seen(channel) for channel in range(len(self.cardinalities))]
        habits = [habit_of(k, self.acts.n_ways, s.actions, s.now, s.then) for k, s in zip(self.cardinalities, seen, strict=True)]
        nothing, ends = np.zeros(len(self.rows), dtype=np.int64), self.rows.terminated.astype(np.int64)
        habits += [habit_of(2, self.acts.n_ways, self.acts.way[self.rows.actions], nothing, then) for then in (ends, nothing)]
        still = 0.5 / (len(self.actions) * len(self.cardinalities) + 1.0)
        return build(channel_layout(self.cardinalities, self.acts), asked, found, habits, still)
