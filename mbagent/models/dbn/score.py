"""Compiled Bayesian score of splits (exact gain in log marginal likelihood), and the state of the search for a target's splits.

Rows of a target belong to *contexts*. A *split* divides the rows of some contexts by a feature; on each side, either all these
contexts share one rate (pooling: a wall is learned from all directions together), or each keeps a rate of its own. The evidence
of a rate is the marginal likelihood under a Beta prior (Heckerman, Geiger and Chickering 1995), whose small strength favours pure
contexts. Shapes: R rows, D features, C contexts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.structs import Struct

BY_ALL, BY_ACTION, BY_VALUE, BY_CONTEXT = 0, 1, 2, 3
"""Sets of contexts that a split can apply to: all, those of one action, those of one current value, or a single one."""

STRENGTH = 0.2
"""Both parameters of the Beta prior."""


class FeatureBlocks(Struct):
    """Features that are on in each row, in compressed sparse row format.

    Attributes:
        first: int64 [N + 1].
        feature: int64 [nonzeros].
        n_features: D.
    """

    first: Ints
    feature: Ints
    n_features: int


class Target(Struct):
    """A one-vs-rest target: the patterns after which a variable's value is possible, and how often that value came next.

    Attributes:
        rows: row of each pattern in the feature table, int64 [R].
        counts: how often each pattern was observed, int64 [R].
        positives: how often the value came next, int64 [R].
        context: context of each pattern, 0 ... C - 1, int64 [R].
        action: action class of each context, int64 [C]; -1 if contexts of several classes were merged.
        value: the variable's current value in each context, int64 [C]; -1 if contexts of several values were merged.
    """

    rows: Ints
    counts: Ints
    positives: Ints
    context: Ints
    action: Ints
    value: Ints


class Chosen(NamedTuple):
    """A split.

    Attributes:
        gain: gain in log evidence, including the log prior odds; 0 if no split has a positive gain.
        kind: BY_ALL, BY_ACTION, BY_VALUE or BY_CONTEXT.
        which: action class, value or context, according to ``kind``.
        feature: the feature that divides the rows.
    """

    gain: float
    kind: int
    which: int
    feature: int


def feature_blocks(table: NDArray[np.generic]) -> FeatureBlocks:
    """Features of a table [N, D] of zeros and ones."""
    rows, feature = np.nonzero(table)
    first = np.searchsorted(rows, np.arange(len(table) + 1)).astype(np.int64)
    return FeatureBlocks(first, feature.astype(np.int64), table.shape[1])


class Tables(Struct):
    """Logarithms from which ``evidence`` of up to n rows is computed, [n + 1] each.

    Attributes:
        one: of rising factorials of one parameter of the Beta prior.
        two: of the sum of both parameters.
        alike: evidence of outcomes that are all equal.
    """

    one: Floats
    two: Floats
    alike: Floats


def evidence_tables(n: int, certain: float = 0.0, strength: float = STRENGTH) -> Tables:
    """Lookup tables from which ``evidence`` is computed for up to ``n`` rows.

    Args:
        n: maximum number of rows.
        certain: prior probability that a rate is 0 or 1; otherwise it has the Beta prior.
        strength: both parameters of the Beta prior.
    """
    i = np.arange(n)
    one = np.concatenate([[0.0], np.cumsum(np.log(i + strength))])
    two = np.concatenate([[0.0], np.cumsum(np.log(i + 2.0 * strength))]) - np.log1p(-certain)
    with np.errstate(divide="ignore"):
        alike = np.logaddexp(np.log(0.5 * certain), one - two)
    alike[0] = 0.0
    return Tables(one, two, alike)


@inlined
def evidence(positives: int, n: int, tables: Tables) -> float:
    """Log marginal likelihood of ``positives`` among ``n`` outcomes."""
    if positives == 0 or positives == n:
        return float(tables.alike[n])
    return float(tables.one[positives] + tables.one[n - positives] - tables.two[n])


def evidences(positives: Ints, n: Ints, tables: Tables) -> Floats:
    """As ``evidence``, for arrays."""
    one, two, alike = tables.one, tables.two, tables.alike
    result: Floats = np.where((positives == 0) | (positives == n), alike[n], one[positives] + one[n - positives] - two[n])
    return result


class Tally(Struct):
    """Counts of a target's rows.

    Attributes:
        n, e: counts and positives of each context, int64 [C] each.
        on, positives_on: counts and positives with each feature on, int64 [C, D] each.
    """

    n: Ints
    e: Ints
    on: Ints
    positives_on: Ints


def count(target: Target, features: FeatureBlocks) -> Tally:
    """Counts rows and positives of each context, in total and with each feature on."""
    counts = np.zeros((2, len(target.action)), dtype=np.int64)
    on = np.zeros((2, len(target.action), features.n_features), dtype=np.int64)
    tally = Tally(*counts, *on)
    _count(target, features, tally)
    return tally


@compiled
def _count(target: Target, features: FeatureBlocks, tally: Tally) -> None:
    """Adds all rows to the counts."""
    for r in range(len(target.rows)):
        context, counts, positives, row = target.context[r], target.counts[r], target.positives[r], target.rows[r]
        tally.n[context] += counts
        tally.e[context] += positives
        for j in range(features.first[row], features.first[row + 1]):
            tally.on[context, features.feature[j]] += counts
            tally.positives_on[context, features.feature[j]] += positives


class Sets(Struct):
    """Sets of contexts that a split can apply to: all, those of each action, those of each current value; and work space.

    Attributes:
        n_actions: number of sets for action classes.
        of: numbers of the sets that contain each context, int64 [C, 3]; the last set, never scored, collects contexts without a
            single action or value.
        base: evidence of each context with a rate of its own, [C].
        counts: rows and positives of each set; rows and positives with a feature on, int64 [S, 4].
        evidence: evidence of a set's contexts with separate rates: of all rows; with a feature on; with it off, [S, 3].
    """

    n_actions: int
    of: Ints
    base: Floats
    counts: Ints
    evidence: Floats


def best_split(target: Target, tally: Tally, prior: Floats, narrow: Floats, tables: Tables) -> Chosen:
    """The split with the highest gain.

    On each side of the split, the contexts of the set either share one rate or have separate rates, whichever has more evidence.

    Args:
        target: the rows, with both outcomes.
        tally: counts of the rows.
        prior: log prior odds of a split of all contexts by each feature, [D]; -inf for excluded features.
        narrow: log prior odds added if a split applies only to one action class, one current value or one context, in this
            order, [3].
        tables: ``evidence_tables`` for at least the sum of the target's counts.
    """
    n_actions, n_contexts = int(target.action.max()) + 1, len(target.action)
    n_sets = 3 + n_actions + int(target.value.max())
    of = np.zeros((n_contexts, 3), dtype=np.int64)
    of[:, 1] = np.where(target.action < 0, n_sets - 1, 1 + target.action)
    of[:, 2] = np.where(target.value < 0, n_sets - 1, 1 + n_actions + target.value)
    sets = Sets(n_actions, of, np.empty(n_contexts), np.zeros((n_sets, 4), dtype=np.int64), np.zeros((n_sets, 3)))
    return Chosen(*_best_split(tally, sets, prior, narrow, tables))


@inlined
def _kind(s: int, n_actions: int) -> tuple[int, int]:
    """Kind of the set of contexts number ``s``, see ``Chosen``, and number of the first set of that kind."""
    if s == 0:
        return BY_ALL, 0
    return (BY_ACTION, 1) if s <= n_actions else (BY_VALUE, 1 + n_actions)


@inlined
def _count_sets(tally: Tally, sets: Sets, tables: Tables) -> None:
    """Adds all contexts to the first two counts, and to the first evidence, of their sets."""
    n, e, of, counts = tally.n, tally.e, sets.of, sets.counts
    for c in range(len(n)):
        sets.base[c] = evidence(e[c], n[c], tables)
        for i in range(3):
            counts[of[c, i], 0] += n[c]
            counts[of[c, i], 1] += e[c]
            sets.evidence[of[c, i], 0] += sets.base[c]


@compiled
def _best_split(tally: Tally, sets: Sets, prior: Floats, narrow: Floats, tables: Tables) -> tuple[float, int, int, int]:
    """See ``best_split`` and ``Chosen``."""
    n, e, on, positives_on = tally.n, tally.e, tally.on, tally.positives_on
    of, counts, total, n_sets, n_actions = sets.of, sets.counts, sets.evidence, len(sets.counts), sets.n_actions
    _count_sets(tally, sets, tables)
    best, kind, which, chosen = 0.0, 0, 0, 0
    for b in range(on.shape[1]):
        if prior[b] == -math.inf:
            continue
        for s in range(n_sets):
            counts[s, 2], counts[s, 3], total[s, 1], total[s, 2] = 0, 0, 0.0, total[s, 0]
        for c in range(len(n)):
            if on[c, b] == 0:
                continue
            own = evidence(positives_on[c, b], on[c, b], tables)
            others = evidence(e[c] - positives_on[c, b], n[c] - on[c, b], tables) - sets.base[c]
            for i in range(3):
                counts[of[c, i], 2] += on[c, b]
                counts[of[c, i], 3] += positives_on[c, b]
                total[of[c, i], 1] += own
                total[of[c, i], 2] += others
            gain = own + others + prior[b] + narrow[2]
            if gain > best and on[c, b] < n[c]:
                best, kind, which, chosen = gain, BY_CONTEXT, c, b
        for s in range(n_sets - 1):
            rows, positives = counts[s, 2], counts[s, 3]
            if rows == 0 or rows == counts[s, 0]:
                continue
            gain = max(total[s, 1], evidence(positives, rows, tables)) - total[s, 0] + prior[b]
            gain += max(total[s, 2], evidence(counts[s, 1] - positives, counts[s, 0] - rows, tables))
            kind_of, first = _kind(s, n_actions)
            gain += 0.0 if s == 0 else narrow[kind_of - 1]
            if gain > best:
                best, kind, which, chosen = gain, kind_of, s - first, b
    return best, kind, which, chosen


MOST_KEPT = 100_000
"""Maximum number of counts that a target keeps between two rounds, 16 bytes each; more are counted again."""


class Pair(NamedTuple):
    """A pairwise split of one context.

    Attributes:
        gain: gain in log evidence, including the log prior odds.
        context: the context.
        first, second: the features.
        pattern: which of the four cells are separated into a new context, see ``split_search.PATTERNS``.
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
        off, on: new context of each old context if the feature is off, or on, int64 [C] each.
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
        prior_mean: prior mean of each context's rate, which matters if it has few rows, [C]: the rate of all rows on the
            context's side of the last split that covered it.
        splits: splits in the order found.
        open: whether further splits are possible.
    """

    target: Target
    prior_mean: Floats = field(init=False)
    splits: list[Split] = field(default_factory=list)
    open: bool = field(init=False)
    _tally: Tally | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Initialises prior means to the overall rate."""
        positives, counts = int(self.target.positives.sum()), int(self.target.counts.sum())
        self.open = 0 < positives < counts
        self.prior_mean = np.full(len(self.target.action), positives / counts if counts else 0.5)

    def counts(self, rows: Bools | None = None) -> tuple[Ints, Ints]:
        """Counts and positives of each context, int64 [C] each, restricted to the rows in the mask ``rows`` [R] if given."""
        target, size = self.target, len(self.target.action)
        some = slice(None) if rows is None else rows
        context, counts, positives = target.context[some], target.counts[some], target.positives[some]
        n, e = (np.bincount(context, weights=w, minlength=size).astype(np.int64) for w in (counts, positives))
        return n, e

    def tally(self, features: FeatureBlocks) -> Tally:
        """The tally of the target's rows, cached if ``Tally.on`` has at most ``MOST_KEPT`` entries."""
        if self._tally is not None:
            return self._tally
        tally = count(self.target, features)
        if tally.on.size <= MOST_KEPT:
            self._tally = tally
        return tally

    def merge(self, tables: Tables) -> None:
        """Merges all contexts if one common rate has more evidence than separate rates."""
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
        """Replaces each feature d by ``numbers[d]`` in place; returns this search."""
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
        self.target = replace(target, context=context, action=labels[0], value=labels[1])
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
    """Whether one common rate for contexts with these counts has more evidence than separate rates."""
    pooled = evidences(e.sum(keepdims=True), n.sum(keepdims=True), tables)[0]
    return bool(pooled > evidences(e, n, tables).sum())
