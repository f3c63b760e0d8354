"""Greedy search for the splits of decision graphs, by single features and by pairs (paper section 5, modules).

The most certain splits are made first and provide a prior for the others: which kinds of features are relevant, whether targets
share features, and how many splits a target has. With little data, this prior is decisive. If two features matter only jointly,
as in XOR, neither has a gain by itself. So all pairs are scored together (depth-two lookahead, Murthy and Salzberg 1995): in
each context, a matrix product yields the counts of every pair's four on/off combinations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbagent.models.dbn.leaf_prior import best_prior
from mbagent.models.dbn.score import (
    Chosen,
    FeatureBlocks,
    Pair,
    Search,
    Tables,
    Target,
    best_split,
    evidence,
    evidence_tables,
    evidences,
    feature_blocks,
)
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled

PATTERNS: tuple[tuple[bool, bool, bool, bool], ...] = (
    (False, False, False, True),
    (False, False, True, False),
    (False, True, False, False),
    (True, False, False, False),
    (False, True, True, False),
)
"""Patterns of a pairwise split: which of the cells (neither, second only, first only, both) are separated from the others."""

FEWEST_PAIR_ROWS = 20
"""Minimum number of rows of a context for pairwise splits."""

FIRST_THRESHOLD = 3.0
"""Log prior odds against one more split, before any splits were found."""

LEAST_GAIN = 1.0
"""Minimum log prior odds against a split, in nats, however probable its feature is in the prior."""

MOST_WORK = 5_000_000_000
"""Maximum number of rows times features times features for which a context is searched for pairs."""

TELLING = 2
"""Number of pairs from which on their kinds and patterns are a prior for further pairs."""

MOST_CONTEXTS = 4
"""Maximum number of contexts of a target that are searched for pairs, those with the most uncertain outcomes."""


MOST_PAIRED_FEATURES = 500
"""Maximum number of features in pairs; of more, those with the largest gain by themselves."""

EXACT_FLOATS = 2**24
"""Sums of integers below this are exact in single precision."""

SPARSE = 16.0
"""Pairs of features that are on are counted one by one if a matrix product needs more than this many times as many steps."""


class PairSearch:
    """Searches for pairwise splits where single features have no further gain.

    Args:
        kinds: kind of each feature, int64 [D].
        table: features of all rows, bool [N, D].
        tables: see ``evidence_tables``.
    """

    def __init__(self, kinds: Ints, table: Bools, tables: Tables) -> None:
        """See the class."""
        self.kinds, self.table, self.tables = kinds, table, tables
        self._n_searched: dict[int, int] = {}
        self._found: list[Pair] = []

    def divide(self, searches: Sequence[Search]) -> bool:
        """Searches all open targets that changed since the previous round; returns whether any pair was found."""
        prior, found = self._prior(), False
        for h, search in enumerate(searches):
            if not search.open or self._n_searched.get(h) == len(search.splits):
                continue
            worth = self._worth(search, float(prior.max()))
            pairs = find_pairs(search.target, worth, self.table, prior, self._pattern_prior(), self.tables)
            for pair in pairs:
                search.divide_by_pair(pair, self.table)
            self._found += pairs
            found = found or bool(pairs)
            self._n_searched[h] = len(search.splits) if not pairs else -1
        return found

    def _worth(self, search: Search, most: float) -> list[int]:
        """Up to ``MOST_CONTEXTS`` contexts whose outcomes are uncertain enough for a pair to gain, most uncertain first."""
        n, e = search.counts()
        cost = -evidences(e, n, self.tables)
        return [int(c) for c in np.argsort(-cost, kind="stable")[:MOST_CONTEXTS] if cost[c] > -most]

    def _pattern_prior(self) -> Floats:
        """Log probability of each pattern; patterns that were found before are more probable."""
        counts = np.full(len(PATTERNS), 0.2)
        if len(self._found) >= TELLING:
            for pair in self._found:
                counts[PATTERNS.index(pair.pattern)] += 1.0
        result: Floats = np.log(counts / counts.sum())
        return result

    def _prior(self) -> Floats:
        """Log prior odds of feature pairs, [D, D]; higher for pairs of kinds already found and features not yet paired."""
        n = len(self.kinds)
        if len(self._found) < TELLING:
            return np.full((n, n), -math.log(max(1.0, n * (n - 1) / 2)) - FIRST_THRESHOLD)
        n_kinds = int(self.kinds.max()) + 1
        share, used = np.full((n_kinds, n_kinds), 0.2 / n_kinds**2), np.zeros(n, dtype=np.bool_)
        for pair in self._found:
            k, m = self.kinds[pair.first], self.kinds[pair.second]
            share[k, m] += 0.5
            share[m, k] += 0.5
            used[[pair.first, pair.second]] = True
        fresh = np.bincount(self.kinds[~used], minlength=n_kinds).clip(1)
        # If features of one kind were paired with features of another kind, the next one probably is, too: the prior then only
        # charges for which feature it is.
        odds = np.log(share / share.sum() / np.maximum.outer(fresh, fresh))[self.kinds[:, None], self.kinds]
        result: Floats = odds - LEAST_GAIN - np.where(used[:, None] | used, 3.0, 0.0)
        return result


def find_pairs(
    target: Target, contexts: Sequence[int], table: Bools, prior: Floats, patterns: Floats, tables: Tables
) -> list[Pair]:
    """The best pair, then further pairs in the same context that share no features with the earlier pairs.

    Args:
        target: the rows.
        contexts: contexts to search.
        table: features of all rows, bool [N, D].
        prior: log prior odds of each pair of features, [D, D].
        patterns: log probability of each pattern.
        tables: see ``evidence_tables``.
    """
    found: list[Pair] = []
    for context in contexts:
        rows = target.context == context
        if (
            target.counts[rows].sum() >= FEWEST_PAIR_ROWS
            and rows.sum() * min(table.shape[1], MOST_PAIRED_FEATURES) ** 2 < MOST_WORK
        ):
            here, counts, positives = table[target.rows[rows]], target.counts[rows], target.positives[rows]
            kept = _most_informative(here, counts, positives, tables)
            pairs = _in_context(context, here[:, kept], counts, positives, prior[np.ix_(kept, kept)], patterns, tables)
            found += [pair._replace(first=int(kept[pair.first]), second=int(kept[pair.second])) for pair in pairs]
    best = max(found, default=None)
    return [] if best is None else [pair for pair in found if pair.context == best.context]


def _most_informative(table: Bools, counts: Ints, positives: Ints, tables: Tables) -> Ints:
    """Numbers of the features to pair, ascending: all, or the ``MOST_PAIRED_FEATURES`` with the largest individual gains."""
    n_features = table.shape[1]
    if n_features <= MOST_PAIRED_FEATURES:
        return np.arange(n_features)
    on = table.T.astype(np.float64)
    n, e = (np.rint(on @ weights).astype(np.int64) for weights in (counts, positives))
    gain = evidences(e, n, tables) + evidences(positives.sum() - e, counts.sum() - n, tables)
    return np.sort(np.argsort(-gain, kind="stable")[:MOST_PAIRED_FEATURES])


def _in_context(
    context: int, table: Bools, counts: Ints, positives: Ints, prior: Floats, patterns: Floats, tables: Tables
) -> list[Pair]:
    any_positive = positives > 0
    both_n, both_e = _both(table, counts), _both(table[any_positive], positives[any_positive])
    best, which = _best_patterns(
        both_n, both_e, int(counts.sum()), int(positives.sum()), np.asarray(PATTERNS), patterns, prior, tables
    )
    pairs: list[Pair] = []
    while best.size and (top := float(best.max())) > 0.0:
        first, second = (int(i) for i in np.unravel_index(int(best.argmax()), best.shape))
        pattern = PATTERNS[which[first, second]]
        if pairs and (pattern != PATTERNS[0] or pairs[0].pattern != PATTERNS[0]):
            break
        pairs.append(Pair(top, context, first, second, pattern))
        best[[first, second]] = best[:, [first, second]] = -np.inf
    return pairs


def _both(on: Bools, weights: Ints) -> Ints:
    """Total weight of the rows in which both features of each pair are on, int64 [D, D]; only the upper triangle is valid."""
    per_row = on.sum(axis=1)
    if SPARSE * float((per_row**2).sum()) < float(on.size) * on.shape[1]:
        first = np.concatenate([[0], np.cumsum(per_row)]).astype(np.int64)
        result: Ints = _count_both(first, np.nonzero(on)[1], weights, on.shape[1])
        return result
    exact = np.float32 if weights.sum() < EXACT_FLOATS else np.float64
    wide = on.astype(exact)
    product: Ints = np.rint((wide * weights[:, None].astype(exact)).T @ wide).astype(np.int64)
    return product


@compiled
def _count_both(first: Ints, feature: Ints, weights: Ints, n_features: int) -> Ints:
    """As ``_both``, for features in compressed sparse row format, in ascending order within each row."""
    both = np.zeros((n_features, n_features), dtype=np.int64)
    for r in range(len(weights)):
        for i in range(first[r], first[r + 1]):
            for j in range(i, first[r + 1]):
                both[feature[i], feature[j]] += weights[r]
    return both


@compiled
def _best_patterns(
    both_n: Ints, both_e: Ints, n: int, e: int, inside: Bools, patterns: Floats, prior: Floats, tables: Tables
) -> tuple[Floats, Ints]:
    """Gain of each pair of features under its best pattern, [D, D], and the pattern's number.

    Only entries above the diagonal are valid.
    """
    size = len(both_n)
    best, which = np.zeros((size, size)), np.zeros((size, size), dtype=np.int64)
    cells_n, cells_e, before = np.zeros(4, dtype=np.int64), np.zeros(4, dtype=np.int64), evidence(e, n, tables)
    for i in range(size):
        for j in range(i + 1):
            best[i, j] = -math.inf
        for j in range(i + 1, size):
            best[i, j] = -math.inf
            for cells, both, total in ((cells_n, both_n, n), (cells_e, both_e, e)):
                cells[3] = both[i, j]
                cells[2] = both[i, i] - both[i, j]
                cells[1] = both[j, j] - both[i, j]
                cells[0] = total - cells[1] - cells[2] - cells[3]
            for number in range(len(inside)):
                n_in, e_in = 0, 0
                for cell in range(4):
                    if inside[number, cell]:
                        n_in += cells_n[cell]
                        e_in += cells_e[cell]
                gain = patterns[number] + evidence(e_in, n_in, tables)
                gain += evidence(e - e_in, n - n_in, tables)
                if gain > best[i, j]:
                    best[i, j], which[i, j] = gain, number
            best[i, j] += prior[i, j] - before
    return best, which


SUREST = 0.99
"""Maximum prior probability that a rate is 0 or 1."""

MOST_SPLITS_A_GRAPH = 256
"""Maximum number of splits of one target."""


def find_splits(targets: Sequence[Target], table: Bools, kinds: Ints, n_actions: int, in_pairs: bool = True) -> list[Search]:
    """A finished search for each target: its splits, and its rows with their final contexts.

    A first search estimates the share of deterministic rates (0 or 1); a second search scores splits with this share.

    Args:
        targets: the targets.
        table: features of all distinct patterns, bool [N, D].
        kinds: kind of each feature, int64 [D]; a split by one feature makes splits by others of its kind more probable.
        n_actions: number of action classes.
        in_pairs: whether to also search for pairwise splits.
    """
    features = feature_blocks(table)
    most = max((int(target.counts.sum()) for target in targets), default=0) + 1
    first = _searched(targets, table, features, kinds, n_actions, evidence_tables(most), False)
    return _searched(targets, table, features, kinds, n_actions, evidence_tables(most, certainty(first)), in_pairs)


def certainty(searches: Sequence[Search]) -> float:
    """Estimated share of deterministic leaves, at most ``SUREST``."""
    return min(best_prior(searches).certain, SUREST)


def _searched(
    targets: Sequence[Target], table: Bools, features: FeatureBlocks, kinds: Ints, n_actions: int, tables: Tables, in_pairs: bool
) -> list[Search]:
    searches = [Search(target) for target in targets]
    for search in searches:
        search.merge(tables)
    go_on(searches, table, features, kinds, n_actions, tables, in_pairs)
    return searches


def go_on(
    searches: Sequence[Search], table: Bools, features: FeatureBlocks, kinds: Ints, n_actions: int, tables: Tables, in_pairs: bool
) -> None:
    """Adds splits as long as any has a positive gain; see ``find_splits``."""
    pairs = PairSearch(kinds, table, tables)
    improving = True
    while improving:
        while found := _next_splits(searches, features, kinds, n_actions, tables):
            for h, chosen in found:
                searches[h].divide(chosen, table, tables)
                searches[h].open = len(searches[h].splits) < MOST_SPLITS_A_GRAPH
        improving = in_pairs and pairs.divide(searches)


def _next_splits(
    searches: Sequence[Search], features: FeatureBlocks, kinds: Ints, n_actions: int, tables: Tables
) -> list[tuple[int, Chosen]]:
    """Best split of each open target, if its gain is positive; with a learned prior, only the half with most gain."""
    prior, learned = feature_prior(searches, kinds, features.n_features)
    counts = np.asarray([sum(split.feature >= 0 for split in search.splits) for search in searches])
    narrow = -np.asarray([math.log(n_actions) + 1.0, 2.0, 3.0])
    found = []
    for h, search in enumerate(searches):
        if search.open:
            more = ((counts > counts[h]).sum() + 0.5) / ((counts >= counts[h]).sum() + 1.0)
            odds = math.log(more / (1.0 - more)) if learned else -FIRST_THRESHOLD
            chosen = best_split(search.target, search.tally(features), np.minimum(prior + odds, -LEAST_GAIN), narrow, tables)
            if chosen.gain > 0.0:
                found.append((h, chosen))
    found.sort(key=lambda entry: -entry[1].gain)
    return found[: max(1, len(found) // 2)] if learned and found else found


def feature_prior(searches: Sequence[Search], kinds: Ints, n_features: int) -> tuple[Floats, bool]:
    """Log prior of each feature for the next split, [D], and whether this prior was estimated from the splits so far."""
    chosen = [split.feature for search in searches for split in search.splits if split.feature >= 0]
    if len(chosen) < max(3, len(searches) // 10):
        return np.full(n_features, -math.log(n_features)), False
    used = np.bincount(chosen, minlength=n_features).astype(np.float64)
    n_kinds = int(kinds.max()) + 1
    again = (0.5 + np.maximum(used - 1, 0).sum()) / (len(chosen) + 1.0)
    of_kind = np.bincount(kinds, weights=used, minlength=n_kinds) + 0.2
    of_kind /= of_kind.sum()
    fresh = np.bincount(kinds[used == 0], minlength=n_kinds).clip(1)
    reused = np.bincount(kinds[used > 0], minlength=n_kinds).clip(1)
    share = np.where(used == 0, (1.0 - again) / fresh[kinds], again / reused[kinds])
    return np.log(of_kind[kinds] * share), True
