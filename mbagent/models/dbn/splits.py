"""State of the search for a target's splits: the splits so far, and the contexts that they lead to."""

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
"""Maximum number of counts that a target keeps between two rounds, 16 bytes each; more are counted again."""


class Pair(NamedTuple):
    """A pairwise split of one context.

    Attributes:
        gain: gain in log evidence, including the log prior odds.
        context: the context.
        first, second: the features.
        pattern: which cells get a context of their own, see ``split_search.PATTERNS``.
    """

    gain: float
    context: int
    first: int
    second: int
    pattern: tuple[bool, bool, bool, bool]


@dataclass(frozen=True)
class Split:
    """A division of the rows of some contexts by a feature.

    Attributes:
        feature: the feature; -1 if contexts are only merged or renumbered.
        off, on: the new context of each old one if the feature is off and on, int64 [C each].
        gain: gain in log evidence, including the log prior odds, in nats.
    """

    feature: int
    off: Ints
    on: Ints
    gain: float


@dataclass
class Search:
    """State of the search for a target's splits.

    Attributes:
        target: the target, with contexts as split so far.
        prior_mean: for each context, the rate of the rows on its side of the last split that it was part of, [C]: the prior mean
            for contexts with few rows.
        splits: in the order found.
        open: whether further splits are possible.
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
        """Counts and positives of each context, int64 [C] each; only of the rows in the mask ``rows`` [R], if given."""
        target, size = self.target, len(self.target.action)
        some = slice(None) if rows is None else rows
        context, counts, positives = target.context[some], target.counts[some], target.positives[some]
        n, e = (np.bincount(context, weights=w, minlength=size).astype(np.int64) for w in (counts, positives))
        return n, e

    def tally(self, features: FeatureBlocks) -> Tally:
        """Counts of each context with each feature on, cached up to ``MOST_KEPT`` counts."""
        if self._tally is not None:
            return self._tally
        tally = count(self.target, features)
        if tally.on.size <= MOST_KEPT:
            self._tally = tally
        return tally

    def merge(self, tables: Tables) -> None:
        """Merges all contexts if one common rate has more evidence."""
        n, e = self.counts()
        if len(n) > 1 and _share(n, e, tables):
            merged, nowhere = np.zeros(len(n), dtype=np.int64), np.zeros(len(self.target.rows), dtype=np.bool_)
            self._take(Split(-1, merged, merged, 0.0), nowhere, self.prior_mean)

    def divide(self, chosen: Chosen, table: Bools, tables: Tables) -> None:
        """Applies a split; ``table`` [N, D] contains all features."""
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
        """Applies a pairwise split, as two splits."""
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
        """This search, after its features were renumbered in place."""
        for i, split in enumerate(self.splits):
            if split.feature >= 0:
                self.splits[i] = replace(split, feature=int(numbers[split.feature]))
        return self

    def _take(self, split: Split, on: Bools, prior_mean: Floats) -> None:
        target, size = self.target, int(max(split.on.max(), split.off.max())) + 1
        context = np.where(on, split.on[target.context], split.off[target.context])
        labels = []
        for old in (target.action, target.value):  # a merged context keeps a label only if all its parts have the same
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
        """Which contexts a split applies to, bool [C]."""
        target = self.target
        if chosen.kind == BY_ALL:
            return np.ones(len(target.action), dtype=np.bool_)
        labels = {BY_ACTION: target.action, BY_VALUE: target.value, BY_CONTEXT: np.arange(len(target.action))}[chosen.kind]
        covered: Bools = labels == chosen.which
        return covered


def _share(n: Ints, e: Ints, tables: Tables) -> bool:
    """Whether one common rate of contexts with these counts has more evidence than a rate for each."""
    pooled = evidences(e.sum(keepdims=True), n.sum(keepdims=True), tables)[0]
    return bool(pooled > evidences(e, n, tables).sum())
