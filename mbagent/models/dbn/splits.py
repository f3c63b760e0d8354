"""A head in the course of the search for what it hangs on: its splits so far, and the contexts that they lead to."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mbagent.models.dbn.score import (
    BY_ACTION,
    BY_ALL,
    BY_CONTEXT,
    BY_VALUE,
    Chosen,
    FeatureBlocks,
    Tables,
    Tally,
    Target,
    count,
    evidences,
)
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
        feature: the column; -1 for none, where contexts are only merged.
        off, on: the new context of each old one, int64 [C each], where the column is off and on.
        gain: evidence beyond its price, nats.
    """

    feature: int
    off: Ints
    on: Ints
    gain: float


@dataclass
class Search:
    """A head in the course of the search.

    Attributes:
        target: its rows, with contexts as split so far.
        prior_mean: for each context, the rate of the rows on its side of the last split that it was part of, [C]: what to
            expect of a context with few rows.
        splits: in the order found.
        open: whether more may be found.
    """

    target: Target
    prior_mean: Floats = field(init=False)
    splits: list[Split] = field(default_factory=list)
    open: bool = field(init=False)
    _tally: Tally | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Starts with the rate of all rows."""
        positives, counts = int(self.target.positives.sum()), int(self.target.counts.sum())
        self.open = 0 < positives < counts
        self.prior_mean = np.full(len(self.target.action), positives / counts if counts else 0.5)

    def counts(self, rows: Bools | None = None) -> tuple[Ints, Ints]:
        """Rows met and arrivals of each context, int64 [C] each; of some rows only where ``rows`` [R] is given."""
        target, size = self.target, len(self.target.action)
        some = slice(None) if rows is None else rows
        context, counts, positives = target.context[some], target.counts[some], target.positives[some]
        n, e = (np.bincount(context, weights=w, minlength=size).astype(np.int64) for w in (counts, positives))
        return n, e

    def tally(self, features: FeatureBlocks) -> Tally:
        """Counts of each context with each column on, made once where they are few."""
        if self._tally is not None:
            return self._tally
        tally = count(self.target, features)
        if tally.on.size <= MOST_KEPT:
            self._tally = tally
        return tally

    def merge(self, tables: Tables) -> None:
        """Lets all contexts share one rate where that has more evidence, as a split by no column would."""
        n, e = self.counts()
        if len(n) > 1 and _share(n, e, tables):
            merged, nowhere = np.zeros(len(n), dtype=np.int64), np.zeros(len(self.target.rows), dtype=np.bool_)
            self._take(Split(-1, merged, merged, 0.0), nowhere, self.prior_mean)

    def divide(self, chosen: Chosen, table: Bools, tables: Tables) -> None:
        """Does the split that was found; ``table`` [N, D] holds all columns."""
        target, size = self.target, len(self.target.action)
        on, covered = table[target.rows, chosen.feature], self._covered(chosen)
        sides_to = np.arange(size), np.where(covered, np.arange(size) + size, np.arange(size))
        prior_mean = np.concatenate([self.prior_mean, self.prior_mean])
        for side, merged in zip((~on, on), sides_to, strict=True):
            n, e = self.counts(side & covered[target.context])
            prior_mean[merged[covered]] = e.sum() / max(n.sum(), 1)
            alike = covered if _share(n[covered], e[covered], tables) else covered & (n == 0)
            if alike.any():
                merged[alike] = merged[alike][0]
        names, numbers = np.unique(np.concatenate(sides_to), return_inverse=True)
        self._take(Split(chosen.feature, numbers[:size], numbers[size:], chosen.gain), on, prior_mean[names])

    def divide_by_pair(self, pair: Pair, table: Bools) -> None:
        """Gives the rows that a pair of columns tells apart a context of their own, in two splits."""
        target, size = self.target, len(self.target.action)
        rows = target.context == pair.context
        cell = 2 * table[target.rows, pair.first] + table[target.rows, pair.second]
        inside = np.asarray(pair.pattern)[cell]
        sides = [rows & side for side in (~inside, inside)]
        rates = [target.positives[side].sum() / target.counts[side].sum() if side.any() else 0.5 for side in sides]
        same, apart = np.arange(size), np.where(np.arange(size) == pair.context, size, np.arange(size))
        prior_mean = np.append(self.prior_mean, self.prior_mean[pair.context])
        self._take(Split(pair.first, same, apart, pair.gain), table[target.rows, pair.first], prior_mean)
        sides_to = np.arange(size + 1), np.arange(size + 1)  # size: the first is on; pair.context: it is off
        for second, merged in enumerate(sides_to):
            merged[pair.context] = size if pair.pattern[second] else pair.context
            merged[size] = size if pair.pattern[2 + second] else pair.context
        prior_mean[pair.context], prior_mean[size] = rates
        self._take(Split(pair.second, *sides_to, 0.0), table[target.rows, pair.second], prior_mean)

    def renamed(self, numbers: Ints) -> Search:
        """Itself, its columns having got other numbers."""
        for i, split in enumerate(self.splits):
            if split.feature >= 0:
                self.splits[i] = replace(split, feature=int(numbers[split.feature]))
        return self

    def _take(self, split: Split, on: Bools, prior_mean: Floats) -> None:
        target, size = self.target, int(max(split.on.max(), split.off.max())) + 1
        context = np.where(on, split.on[target.context], split.off[target.context])
        labels = []
        for old in (target.action, target.value):  # a merged context keeps only what all its parts have in common
            low, high = np.full(size, np.iinfo(np.int64).max), np.full(size, -2)
            for merged in (split.off, split.on):
                np.minimum.at(low, merged, old)
                np.maximum.at(high, merged, old)
            labels.append(np.where(low == high, low, -1))
        self.target = target._replace(context=context, action=labels[0], value=labels[1])
        self.prior_mean = prior_mean[:size]
        self._tally = None
        self.splits.append(split)

    def _covered(self, chosen: Chosen) -> Bools:
        """Which contexts a split is about, bool [C]."""
        target = self.target
        if chosen.kind == BY_ALL:
            return np.ones(len(target.action), dtype=np.bool_)
        labels = {BY_ACTION: target.action, BY_VALUE: target.value, BY_CONTEXT: np.arange(len(target.action))}[chosen.kind]
        covered: Bools = labels == chosen.which
        return covered


def _share(n: Ints, e: Ints, tables: Tables) -> bool:
    """Whether contexts with these counts have more evidence for one rate than for a rate each."""
    pooled = evidences(e.sum(keepdims=True), n.sum(keepdims=True), tables)[0]
    return bool(pooled > evidences(e, n, tables).sum())
