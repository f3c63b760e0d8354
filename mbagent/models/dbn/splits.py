"""A head in the course of the search for what it hangs on: its splits so far, and the contexts that they lead to."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mbagent.models.dbn.score import ACTION, ALL, SINGLE, VALUE, Chosen, Columns, Head, Tables, Tally, count, evidences
from mbagent.types import Bools, Floats, Ints

MOST_KEPT = 100_000
"""Counts that a head keeps from one look to the next, 16 bytes each; more are counted anew."""


class Pair(NamedTuple):
    """A context told apart by two columns.

    Attributes:
        gain: evidence beyond its price.
        context: the context.
        first, second: the columns.
        pattern: which cells get a context of their own, see PATTERNS.
    """

    gain: float
    context: int
    first: int
    second: int
    pattern: tuple[bool, bool, bool, bool]


@dataclass(frozen=True)
class Split:
    """Rows of some contexts told apart by a column.

    Attributes:
        column: the column; -1 for none, where contexts are only merged.
        off, on: the new context of each old one, int64 [C each], where the column is off and on.
        gain: evidence beyond its price, nats.
    """

    column: int
    off: Ints
    on: Ints
    gain: float


@dataclass
class Search:
    """A head in the course of the search.

    Attributes:
        head: its rows, with contexts as split so far.
        typical: for each context, the rate of the rows on its side of the last split that it was part of, [C]: what to
            expect of a context with few rows.
        splits: in the order found.
        open: whether more may be found.
    """

    head: Head
    typical: Floats = field(init=False)
    splits: list[Split] = field(default_factory=list)
    open: bool = field(init=False)
    _tally: Tally | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Starts with the rate of all rows."""
        came, seen = int(self.head.came.sum()), int(self.head.seen.sum())
        self.open = 0 < came < seen
        self.typical = np.full(len(self.head.action), came / seen if seen else 0.5)

    def counts(self, rows: Bools | None = None) -> tuple[Ints, Ints]:
        """Rows met and arrivals of each context, int64 [C] each; of some rows only where ``rows`` [R] is given."""
        head, size = self.head, len(self.head.action)
        some = slice(None) if rows is None else rows
        context, seen, came = head.context[some], head.seen[some], head.came[some]
        n, e = (np.bincount(context, weights=w, minlength=size).astype(np.int64) for w in (seen, came))
        return n, e

    def tally(self, columns: Columns) -> Tally:
        """Counts of each context with each column on, made once where they are few."""
        if self._tally is not None:
            return self._tally
        tally = count(self.head, columns)
        if tally.on.size <= MOST_KEPT:
            self._tally = tally
        return tally

    def merge(self, tables: Tables) -> None:
        """Lets all contexts share one rate where that has more evidence, as a split by no column would."""
        n, e = self.counts()
        if len(n) > 1 and _share(n, e, tables):
            target, nowhere = np.zeros(len(n), dtype=np.int64), np.zeros(len(self.head.rows), dtype=np.bool_)
            self._take(Split(-1, target, target, 0.0), nowhere, self.typical)

    def divide(self, chosen: Chosen, table: Bools, tables: Tables) -> None:
        """Does the split that was found; ``table`` [N, D] holds all columns."""
        head, size = self.head, len(self.head.action)
        on, covered = table[head.rows, chosen.column], self._covered(chosen)
        targets = np.arange(size), np.where(covered, np.arange(size) + size, np.arange(size))
        typical = np.concatenate([self.typical, self.typical])
        for side, target in zip((~on, on), targets, strict=True):
            n, e = self.counts(side & covered[head.context])
            typical[target[covered]] = e.sum() / max(n.sum(), 1)
            alike = covered if _share(n[covered], e[covered], tables) else covered & (n == 0)
            if alike.any():
                target[alike] = target[alike][0]
        names, numbers = np.unique(np.concatenate(targets), return_inverse=True)
        self._take(Split(chosen.column, numbers[:size], numbers[size:], chosen.gain), on, typical[names])

    def divide_by_pair(self, pair: Pair, table: Bools) -> None:
        """Gives the rows that a pair of columns tells apart a context of their own, in two splits."""
        head, size = self.head, len(self.head.action)
        rows = head.context == pair.context
        cell = 2 * table[head.rows, pair.first] + table[head.rows, pair.second]
        inside = np.asarray(pair.pattern)[cell]
        sides = [rows & side for side in (~inside, inside)]
        rates = [head.came[side].sum() / head.seen[side].sum() if side.any() else 0.5 for side in sides]
        same, apart = np.arange(size), np.where(np.arange(size) == pair.context, size, np.arange(size))
        typical = np.append(self.typical, self.typical[pair.context])
        self._take(Split(pair.first, same, apart, pair.gain), table[head.rows, pair.first], typical)
        targets = np.arange(size + 1), np.arange(size + 1)  # size: the first is on; pair.context: it is off
        for second, target in enumerate(targets):
            target[pair.context] = size if pair.pattern[second] else pair.context
            target[size] = size if pair.pattern[2 + second] else pair.context
        typical[pair.context], typical[size] = rates
        self._take(Split(pair.second, *targets, 0.0), table[head.rows, pair.second], typical)

    def renamed(self, numbers: Ints) -> Search:
        """Itself, its columns having got other numbers."""
        for i, split in enumerate(self.splits):
            if split.column >= 0:
                self.splits[i] = replace(split, column=int(numbers[split.column]))
        return self

    def _take(self, split: Split, on: Bools, typical: Floats) -> None:
        head, size = self.head, int(max(split.on.max(), split.off.max())) + 1
        context = np.where(on, split.on[head.context], split.off[head.context])
        labels = []
        for old in (head.action, head.value):  # a merged context keeps only what all its parts have in common
            low, high = np.full(size, np.iinfo(np.int64).max), np.full(size, -2)
            for target in (split.off, split.on):
                np.minimum.at(low, target, old)
                np.maximum.at(high, target, old)
            labels.append(np.where(low == high, low, -1))
        self.head = head._replace(context=context, action=labels[0], value=labels[1])
        self.typical = typical[:size]
        self._tally = None
        self.splits.append(split)

    def _covered(self, chosen: Chosen) -> Bools:
        """Which contexts a split is about, bool [C]."""
        head = self.head
        if chosen.kind == ALL:
            return np.ones(len(head.action), dtype=np.bool_)
        labels = {ACTION: head.action, VALUE: head.value, SINGLE: np.arange(len(head.action))}[chosen.kind]
        covered: Bools = labels == chosen.which
        return covered


def _share(n: Ints, e: Ints, tables: Tables) -> bool:
    """Whether contexts with these counts have more evidence for one rate than for a rate each."""
    pooled = evidences(e.sum(keepdims=True), n.sum(keepdims=True), tables)[0]
    return bool(pooled > evidences(e, n, tables).sum())
