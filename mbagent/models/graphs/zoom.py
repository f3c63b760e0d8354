"""Where transitions are too many to search at once: the splits found in some are followed through all, then searched on.

A table of what every cell looks like does not fit into memory where neighbourhoods hold thousands of columns. Few of the
cells are worth looking at: in most contexts that the splits lead to, all transitions agree. So all cells are counted, by the
few columns that were split by, and only cells of contexts in which they disagree get a table of all columns, rare
outcomes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.evidence import Head, Tables, columns_of, evidence_tables, evidences
from mbagent.models.graphs.greedy import certainty, go_on
from mbagent.models.graphs.looks import CHUNK, PlaneTable
from mbagent.models.graphs.search import Search, Split
from mbagent.models.graphs.units import Question
from mbagent.models.graphs.windows import column_kinds, column_planes, values_at
from mbagent_envs._compiled import compiled

Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]

ROUNDS = 6
"""Most times that all transitions are gone through."""

WORTH = 10.0
"""Evidence, nats, that could be gained in a context at most, below which nothing is looked for in it."""


LEAST = 100
"""Cells of the more frequent outcome that are taken at least."""


def zoom(planes: PlaneTable, asked: Sequence[Question], found: list[Search]) -> list[Search]:
    """Searches that go on in all transitions where some were searched; as they are where all were.

    Args:
        planes: the transitions.
        asked: the questions about channels.
        found: what was found for each in some transitions.

    Returns:
        Searches with further splits, whose rows are counts of all transitions: one for each context.
    """
    if planes.whole or not asked:
        return found
    followed = [_Followed(planes, question, search) for question, search in zip(asked, found, strict=True)]
    most, certain = planes.most_looks, certainty(found)
    for _ in range(ROUNDS if planes.in_pairs else 1):
        if not _round(planes, followed, most, certain):
            break
    return [each.search() for each in followed]


class _Followed:
    """A question followed through all cells.

    Attributes:
        splits: all splits so far.
        context: of each cell, int32 [N * P]; -1 where it is not asked.
        n, e: cells and arrivals of each context, int64 [C].
        action, value, typical: of each context, see ``Head`` and ``Search``.
        closed: contexts in which nothing more was found, bool [C].
    """

    def __init__(self, planes: PlaneTable, question: Question, search: Search) -> None:
        self.planes, self.question, self.channel = planes, question, question.unit
        self.splits: list[Split] = []
        cardinality = planes.cardinalities[self.channel]
        context = np.full(planes.n_actions * cardinality, -1, dtype=np.int32)
        context[question.pairs] = np.arange(len(question.pairs))
        now = planes.every[0][:, self.channel].reshape(len(planes.every_action), -1)
        self.context = context[(planes.every_action * cardinality)[:, None] + now].ravel()
        self.context[: planes.every_since[self.channel] * planes.n_cells] = -1
        self.action, self.value, self.typical = search.head.action, search.head.value, search.typical
        self.closed = np.zeros(len(self.action), dtype=np.bool_)
        self.follow(search.splits)

    def came(self) -> Bools:
        """In which cells the value came, bool [N * P]."""
        result: Bools = (self.planes.every[1][:, self.channel] == self.question.values[0]).ravel()
        return result

    def follow(self, splits: Sequence[Split]) -> None:
        """Takes all cells through further splits, and counts them."""
        planes = self.planes
        used = np.unique([split.column for split in splits if split.column >= 0]).astype(np.int64)
        which = np.asarray([np.searchsorted(used, s.column) if s.column >= 0 else -1 for s in splits], dtype=np.int64)
        targets = np.concatenate([np.zeros((2, 0), dtype=np.int64), *(np.stack([s.off, s.on]) for s in splits)], axis=1)
        first = np.concatenate([[0], np.cumsum([len(s.off) for s in splits])]).astype(np.int64)
        step = max(1, CHUNK // (planes.n_cells * (len(used) + 1)))
        for begin in range(0, len(planes.every_action), step):
            part = slice(begin, begin + step)
            values = column_planes(planes.columns[used], planes.every[0][part], planes.every_action[part])
            cells = self.context[begin * planes.n_cells : (begin + step) * planes.n_cells]
            _walk(values.reshape(len(used), len(cells)), which, first, targets, cells)
        self.splits += splits
        asked, size = self.context >= 0, len(self.action)
        self.n = np.bincount(self.context[asked], minlength=size)
        self.e = np.bincount(self.context[asked & self.came()], minlength=size)

    def search(self) -> Search:
        """The splits, with counts for rows."""
        contexts = np.arange(len(self.action))
        search = Search(Head(contexts, self.n, self.e, contexts, self.action, self.value))
        search.splits, search.typical = self.splits, self.typical
        return search

    def open_contexts(self, tables: Tables) -> Bools:
        """Contexts in which cells disagree, bool [C]."""
        result: Bools = ~self.closed & (-evidences(self.e, self.n, tables) > WORTH) & (self.e > 0) & (self.e < self.n)
        return result

    def graft(self, local: Search, begun: int, contexts: Bools, start: Ints, near: Ints) -> bool:
        """Takes over what a search in some contexts found; whether it found anything.

        Args:
            local: the search, whose contexts began as the numbers of ``contexts``, and whose columns are numbers of ``near``.
            begun: number of its splits that were known before.
            contexts: bool [C].
            start: context in which each of its rows began, int64 [R].
            near: columns.
        """
        new, size = local.splits[begun:], len(self.action)
        kept, chosen = np.flatnonzero(~contexts), np.flatnonzero(contexts)
        if not new:
            self.closed |= contexts
            return False
        order = np.empty(size, dtype=np.int64)
        order[kept], order[chosen] = np.arange(len(kept)), len(kept) + np.arange(len(chosen))
        splits = [Split(-1, order, order, 0.0)]
        for split in new:
            off, on = (np.concatenate([np.arange(len(kept)), len(kept) + side]) for side in (split.off, split.on))
            splits.append(replace(split, column=int(near[split.column]) if split.column >= 0 else -1, off=off, on=on))
        pieces = np.unique(np.stack([start, local.head.context]), axis=1)
        whole = np.bincount(pieces[0], minlength=len(chosen)) == 1
        closed = np.ones(len(local.head.action), dtype=np.bool_)
        closed[pieces[1][~whole[pieces[0]]]] = False
        self.closed = np.concatenate([self.closed[kept], closed])
        self.action = np.concatenate([self.action[kept], local.head.action])
        self.value = np.concatenate([self.value[kept], local.head.value])
        self.typical = np.concatenate([self.typical[kept], local.typical])
        self.follow(splits)
        return True


def _round(planes: PlaneTable, followed: Sequence[_Followed], most: int, certain: float) -> bool:
    """Searches on in the contexts in which cells disagree; whether any split was found."""
    tables = evidence_tables(max(int(each.n.max(initial=0)) for each in followed) + 1, certain)
    opened = [each.open_contexts(tables) for each in followed]
    limit = _water_level([np.minimum(f.e, f.n - f.e)[o] for f, o in zip(followed, opened, strict=True)], most)
    position, chosen = np.full(len(planes.columns), -1), []
    position[planes.near] = np.arange(len(planes.near))
    searches: list[Search] = []
    begun = 0
    for each, contexts in zip(followed, opened, strict=True):
        cells, search = _sampled(each, contexts, limit, begun)
        search.splits = [replace(s, column=int(position[s.column]) if s.column >= 0 else -1) for s in each.splits]
        chosen.append(cells)
        searches.append(search)
        begun += len(cells)
    if begun == 0:
        return False
    rows, cells = np.divmod(np.concatenate(chosen), planes.n_cells)
    width = planes.board.width
    table = values_at(planes.columns[planes.near], planes.every[0], planes.every_action, rows, cells // width, cells % width)
    starts, known = [search.head.context for search in searches], [len(search.splits) for search in searches]
    weights = max(int(search.head.seen.sum()) for search in searches) + 1
    kinds = column_kinds(planes.columns)[planes.near]
    go_on(searches, table, columns_of(table), kinds, planes.n_actions, evidence_tables(weights, certain), planes.in_pairs)
    grown = [
        each.graft(search, n, contexts, start, planes.near)
        for each, search, n, contexts, start in zip(followed, searches, known, opened, starts, strict=True)
    ]
    return any(grown)


def _water_level(rarer: Sequence[Ints], most: int) -> int:
    """How many cells of the rarer outcome a context may have, so that all have ``most`` cells, half of each outcome."""
    counts = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *rarer]))
    below = np.concatenate([[0], np.cumsum(counts)])
    room = most // 4  # the more frequent outcome gets three times as many
    for i, count in enumerate(counts):
        if below[i] + count * (len(counts) - i) > room:
            return max(1, int((room - below[i]) // (len(counts) - i)))
    return room


def _sampled(each: _Followed, contexts: Bools, limit: int, begin: int) -> tuple[Ints, Search]:
    """Cells of some contexts, and a search of them; their rows are numbered from ``begin`` on.

    Of each context's rarer outcome evenly chosen cells are taken, of the other three times as many and ``LEAST`` more; they
    weigh what they stand for, as a multiple of what the rarer ones do.
    """
    numbers = np.where(contexts, np.cumsum(contexts) - 1, -1)
    inside = np.flatnonzero((each.context >= 0) & contexts[each.context])
    group = 2 * numbers[each.context[inside]] + each.came()[inside]
    order = np.argsort(group.astype(np.int32), kind="stable")
    ends = np.searchsorted(group[order], np.arange(2 * int(contexts.sum()) + 1))
    none = np.zeros(0, dtype=np.int64)
    cells, weights, came, start = [none], [none], [none], [none]
    for number in range(int(contexts.sum())):
        outcomes = [order[ends[2 * number + e] : ends[2 * number + e + 1]] for e in (0, 1)]
        fewer = min(len(outcome) for outcome in outcomes)
        most = min(fewer, limit)
        taken = [min(len(outcome), most if len(outcome) == fewer else 3 * most + LEAST) for outcome in outcomes]
        stand = [len(outcome) / max(k, 1) for outcome, k in zip(outcomes, taken, strict=True)]
        for e, outcome in enumerate(outcomes):
            k = taken[e]
            cells.append(inside[outcome[np.linspace(0, len(outcome) - 1, k).astype(np.int64)]])
            weights.append(np.full(k, max(1, round(stand[e] / min(stand)))))
            came.append(np.full(k, e))
            start.append(np.full(k, number))
    chosen, seen, arrived, context = (np.concatenate(parts) for parts in (cells, weights, came, start))
    rows = begin + np.arange(len(chosen))
    search = Search(Head(rows, seen, seen * arrived, context, each.action[contexts], each.value[contexts]))
    search.typical = each.typical[contexts]
    return chosen, search


@compiled
def _walk(values: Bools, which: Ints, first: Ints, targets: Ints, context: NDArray[np.int32]) -> None:
    """Takes cells through splits: ``context`` [n] is changed.

    Args:
        values: columns, bool [U, n].
        which: the column of each split, int64 [S]; -1 for none.
        first: where the targets of each split begin, int64 [S + 1].
        targets: new context of each old one, where the column is off and on, int64 [2, sum of contexts].
        context: int32 [n]; negative where there is none.
    """
    for cell in range(len(context)):
        now = context[cell]
        if now >= 0:
            for s in range(len(which)):
                side = 1 if which[s] >= 0 and values[which[s], cell] else 0
                now = targets[side, first[s] + now]
            context[cell] = now
