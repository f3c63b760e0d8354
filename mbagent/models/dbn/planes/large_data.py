"""Plane data too large for one feature table: distinct patterns, and refinement of splits found in a sample.

A table of all features of every cell does not fit into memory if neighbourhoods have thousands of features. In most contexts
that the splits produce, all cells have the same outcome. Therefore, all cells are counted using only the few features that the
splits test. A table of all features is made only for contexts whose outcomes differ, from a sample of cells that favours the
rarer outcome (compare RainForest, Gehrke et al. 1998).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mbagent.data import Factors, TransitionBatch
from mbagent.models.dbn.arrays import Graphs, build
from mbagent.models.dbn.effects import smoothing_of
from mbagent.models.dbn.features import ActionEncoding, Layout, Observed, Question, ask, distinct, make_layout
from mbagent.models.dbn.planes.features import (
    ACTION,
    ADJACENCY,
    BORDER,
    CELL,
    NEXT_ADJACENCY,
    WRAP,
    determined_by,
    far_value,
    feature_kinds,
    feature_planes,
    feature_values,
    informative_features,
    values_at,
)
from mbagent.models.dbn.score import Search, Split, Tables, Target, evidence_tables, evidences, feature_blocks
from mbagent.models.dbn.split_search import certainty, find_splits, go_on
from mbagent.spaces import PlaneLayout
from mbagent.types import Bools, Ints
from mbagent_envs.jit import compiled

MOST_TABLE_ENTRIES = 200_000_000
"""Maximum number of entries of the feature table for the search; of more transitions, an evenly spaced sample is searched."""

QUICK_CELLS = 50_000_000
"""As ``MOST_TABLE_ENTRIES``, for quick fits without pairwise splits."""

FEWEST_CHANGES = 50
"""Minimum number of changed cells of a channel for which it can be found to copy another channel or an action."""

MOST_CELLS_COUNTED = 1_000_000_000
"""Maximum number of cell values that are counted in all, of one byte each before and after a step."""

ENTRIES_PER_CHUNK = 50_000_000
"""Entries of the table that are computed at once."""


def channel_layout(cardinalities: Sequence[int], encoding: ActionEncoding) -> Layout:
    """A layout whose factors are the channels; the features of this layout are not used."""
    return make_layout(cardinalities, (), encoding, ordinal=False)


def _counted(rows: TransitionBatch) -> tuple[TransitionBatch, Ints]:
    """The rows that are counted, and their indices in ``rows``."""
    most = max(1, MOST_CELLS_COUNTED // max(1, rows.before.shape[1]))
    if len(rows) <= most:
        return rows, np.arange(len(rows))
    counted = np.linspace(0, len(rows) - 1, most).astype(np.int64)
    return rows.select(counted), counted


class PlaneTable:
    """Transitions of planes as cells, each with its relative features.

    Attributes:
        table: neighbourhood features (``near``) of each distinct pattern of a cell, bool [patterns, len(near)].
        whole: whether the table covers all transitions.
        most_patterns: maximum number of rows of a table for a search.
        every: planes of the current and next states of all transitions, or of an evenly spaced subset beyond
            ``MOST_CELLS_COUNTED`` cell values.

    Args:
        rows: N transitions.
        board: positions of the cells.
        cardinalities: number of values of each channel's cells, length C.
        features: all relative features, int64 [D, 7].
        encoding: the actions.
        since: first row that counts for each channel and for ``terminated``, int64 [C + 1]; None for all.
        in_pairs: whether to search for pairwise splits, which takes most of the time.
    """

    def __init__(
        self,
        rows: TransitionBatch,
        board: PlaneLayout,
        cardinalities: tuple[int, ...],
        features: Ints,
        encoding: ActionEncoding,
        since: Ints | None = None,
        in_pairs: bool = True,
    ) -> None:
        """See the class."""
        self.in_pairs = in_pairs
        self.board, self.cardinalities, self.features, self.encoding = board, cardinalities, features, encoding
        self.n_cells = board.height * board.width
        self.since = np.zeros(len(cardinalities) + 1, dtype=np.int64) if since is None else since
        rows, counted = _counted(rows)
        self.since = np.searchsorted(counted, self.since)
        self.every = board.to_planes(rows.before), board.to_planes(rows.after)
        self.every_action, self.every_since = rows.actions, self.since
        known = informative_features(features, *self.every)
        kind = features[known, 0]
        here = np.isin(kind, (CELL, BORDER, ACTION, WRAP)) | ((kind == ADJACENCY) & (features[known, 5:] == 0).all(axis=1))
        self.near, self.far, self.next_far = (
            known[which] for which in (here, np.isin(kind, (ADJACENCY, ACTION)), kind == NEXT_ADJACENCY)
        )
        self.most_patterns = (MOST_TABLE_ENTRIES if in_pairs else QUICK_CELLS) // max(len(self.near), 1)
        self.table, self.pattern, taken = self._patterns(self.every[0], rows.actions)
        self.whole = len(taken) == len(rows)
        self.rows = rows if self.whole else rows.select(taken)
        self.before, self.after = board.to_planes(self.rows.before), board.to_planes(self.rows.after)
        self.since = np.searchsorted(taken, self.since)
        self.actions = np.repeat(encoding.action_class[self.rows.actions], self.n_cells)

    def _patterns(self, planes: Factors, actions: Ints) -> tuple[Bools, Ints, Ints]:
        """Features of each distinct pattern, the index of the pattern of each cell, and the indices of the transitions used.

        Evenly spaced transitions are added until there are ``most_patterns`` patterns.
        """
        most, step = self.most_patterns, max(1, ENTRIES_PER_CHUNK // (self.n_cells * max(len(self.near), 1)))
        patterns_seen, n_parts = np.zeros((0, -(-len(self.near) // 8)), dtype=np.uint8), -(-len(planes) // step)
        pattern, taken = [np.zeros((0, self.n_cells), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for number in range(n_parts):
            if len(patterns_seen) >= most:
                break
            part = np.arange(number, len(planes), n_parts)
            packed = np.packbits(feature_values(self.features[self.near], planes[part], actions[part]), axis=1)
            first, of = distinct(packed)
            both, known = np.concatenate([patterns_seen, packed[first]]), len(patterns_seen)
            kept, now = distinct(both)
            renamed = np.argsort(np.argsort(kept, kind="stable"), kind="stable")[now]  # earlier patterns keep their numbers
            patterns_seen = both[np.sort(kept)]
            pattern.append(renamed[known:][of].reshape(len(part), self.n_cells))
            taken.append(part)
        rows = np.concatenate(taken)
        order = np.argsort(rows)
        table = np.unpackbits(patterns_seen, axis=1, count=len(self.near)).astype(np.bool_)
        return table, np.concatenate(pattern)[order].ravel(), rows[order]

    def observed(self, channel: int) -> Observed:
        """A channel's values in all cells that count for it; patterns are row indices of ``table``."""
        now, then = (planes[:, channel].reshape(-1).astype(np.int64) for planes in (self.before, self.after))
        return Observed(self.pattern, self.actions, now, then).select(self.cells_since(channel))

    def determined_by(self, channel: int) -> Ints | None:
        """As ``features.determined_by``, but also None if the channel rarely changed."""
        before, after = (planes[:, channel] for planes in self.every)
        if (before != after).sum() < FEWEST_CHANGES:
            return None
        return determined_by(channel, self.features, self.near, *self.every, self.every_action)

    def copying(self, channel: int, features: Ints) -> tuple[list[Question], Bools]:
        """The questions about a channel determined by ``features``, and a feature table of only these features."""
        observed, cardinality = self.observed(channel), self.cardinalities[channel]
        determined = feature_values(self.features[features], self.before, self.rows.actions)[self.cells_since(channel)]
        value = np.concatenate([determined, np.ones((len(determined), 1), dtype=np.bool_)], axis=1).argmax(axis=1)
        pattern = (observed.actions * cardinality + observed.now) * (len(features) + 1) + value
        first = np.full(self.encoding.n_action_classes * cardinality * (len(features) + 1), -1)
        first[pattern[::-1]] = np.arange(len(pattern))[::-1]
        return ask(channel, cardinality, replace(observed, pattern=pattern)), determined[first]

    def cells_since(self, channel: int) -> Ints:
        """Indices of the cells that count for a channel."""
        return np.arange(min(self.since[channel] * self.n_cells, len(self.actions)), len(self.actions))

    def far_values(self, numbers: Ints) -> Bools:
        """Values of features that are the same at all positions, bool [N, len(numbers)]."""
        found = [far_value(self.features[d], self.before, self.rows.actions, self.after) for d in numbers]
        return np.stack(found, axis=1)

    def split(self, asked: Sequence[Question], table: Bools, numbers: Ints) -> list[Search]:
        """Completed split searches for the questions; the columns of ``table`` are the relative features ``numbers``."""
        kinds = feature_kinds(self.features)[numbers]
        found = find_splits([q.target for q in asked], table, kinds, self.encoding.n_action_classes, self.in_pairs)
        return [search.renamed(numbers) for search in found]

    def build(self, asked: Sequence[Question], found: Sequence[Search]) -> Graphs:
        """Graphs of channels, ``terminated`` and the reset, which never happens."""
        observed = [self.observed(channel) for channel in range(len(self.cardinalities))]
        smoothings = [
            smoothing_of(k, self.encoding.n_action_classes, s.actions, s.now, s.then)
            for k, s in zip(self.cardinalities, observed, strict=True)
        ]
        nothing, ends = np.zeros(len(self.rows), dtype=np.int64), self.rows.terminated.astype(np.int64)
        smoothings += [
            smoothing_of(2, self.encoding.n_action_classes, self.encoding.action_class[self.rows.actions], nothing, then)
            for then in (ends, nothing)
        ]
        still = 0.5 / (len(self.actions) * len(self.cardinalities) + 1.0)
        return build(channel_layout(self.cardinalities, self.encoding), asked, found, smoothings, still)


REFINEMENTS = 6
"""Maximum number of rounds of refinement, each of which counts all transitions."""

WORTH_SEARCHING = 10.0
"""Minimum log evidence, in nats, that could be gained in a context at most, for it to be searched."""


FEWEST_ROOM = 300
"""Minimum number of sampled cells of the more frequent outcome, if there are as many."""


def refine(planes: PlaneTable, asked: Sequence[Question], found: list[Search]) -> list[Search]:
    """Continues searches that were made on a sample, using all transitions; without a sample, returns them unchanged.

    Args:
        planes: the transitions.
        asked: Questions whose variables are channels.
        found: each question's search on the sample.

    Returns:
        Searches with further splits; they have one row for each context, with its counts over all transitions.
    """
    if planes.whole or not asked:
        return found
    refined = [_Refined(planes, question, search) for question, search in zip(asked, found, strict=True)]
    most, certain = planes.most_patterns, certainty(found)
    for _ in range(REFINEMENTS):
        if not _round(planes, refined, most, certain):
            break
    return [each.search() for each in refined]


class _Refined:
    """A question whose contexts are counted over all cells.

    Attributes:
        splits: all splits so far.
        context: context of each cell, int32 [N * P]; -1 if the question does not apply to it.
        n, e: number of cells and of positives in each context, int64 [C].
        action, value, prior_mean: of each context, see ``Target`` and ``Search``.
        closed: contexts in which no further split was found, bool [C].
    """

    def __init__(self, planes: PlaneTable, question: Question, search: Search) -> None:
        self.planes, self.question, self.channel = planes, question, question.variable
        self.splits: list[Split] = []
        cardinality = planes.cardinalities[self.channel]
        context = np.full(planes.encoding.n_action_classes * cardinality, -1, dtype=np.int32)
        context[question.pairs] = np.arange(len(question.pairs))
        now = planes.every[0][:, self.channel].reshape(len(planes.every_action), -1)
        self.context = context[(planes.encoding.action_class[planes.every_action] * cardinality)[:, None] + now].ravel()
        self.context[: planes.every_since[self.channel] * planes.n_cells] = -1
        self.action, self.value, self.prior_mean = search.target.action, search.target.value, search.prior_mean
        self.closed = np.zeros(len(self.action), dtype=np.bool_)
        self.follow(search.splits)

    def positives(self) -> Bools:
        """In which cells the question's value came next, bool [N * P]."""
        result: Bools = (self.planes.every[1][:, self.channel] == self.question.values[0]).ravel()
        return result

    def follow(self, splits: Sequence[Split]) -> None:
        """Assigns all cells to their new contexts after further splits, and recounts each context."""
        planes = self.planes
        used = np.unique([split.feature for split in splits if split.feature >= 0]).astype(np.int64)
        which = np.asarray([np.searchsorted(used, s.feature) if s.feature >= 0 else -1 for s in splits], dtype=np.int64)
        targets = np.concatenate([np.zeros((2, 0), dtype=np.int64), *(np.stack([s.off, s.on]) for s in splits)], axis=1)
        first = np.concatenate([[0], np.cumsum([len(s.off) for s in splits])]).astype(np.int64)
        step = max(1, ENTRIES_PER_CHUNK // (planes.n_cells * (len(used) + 1)))
        for begin in range(0, len(planes.every_action), step):
            part = slice(begin, begin + step)
            values = feature_planes(planes.features[used], planes.every[0][part], planes.every_action[part])
            cells = self.context[begin * planes.n_cells : (begin + step) * planes.n_cells]
            _walk(values.reshape(len(used), len(cells)), which, first, targets, cells)
        self.splits += splits
        included, size = self.context >= 0, len(self.action)
        self.n = np.bincount(self.context[included], minlength=size)
        self.e = np.bincount(self.context[included & self.positives()], minlength=size)

    def search(self) -> Search:
        """A search with all splits so far; its rows are the contexts."""
        contexts = np.arange(len(self.action))
        search = Search(Target(contexts, self.n, self.e, contexts, self.action, self.value))
        search.splits, search.prior_mean = self.splits, self.prior_mean
        return search

    def open_contexts(self, tables: Tables) -> Bools:
        """Mask of the contexts that have both outcomes and are worth searching, bool [C]."""
        result: Bools = ~self.closed & (-evidences(self.e, self.n, tables) > WORTH_SEARCHING) & (self.e > 0) & (self.e < self.n)
        return result

    def graft(self, found: Sequence[Search], contexts: Ints, near: Ints) -> bool:
        """Appends the splits found in the given contexts; returns whether there are any.

        Args:
            found: the search in each context; its splits refer to features by their index in ``near``.
            contexts: ascending, int64 [K].
            near: feature numbers, int64.
        """
        splits, rates = [], self.e / np.maximum(self.n, 1)
        for context, search in zip(contexts[::-1], found[::-1], strict=True):  # last first: earlier contexts keep their numbers
            if not search.splits:
                self.closed[context] = True
                continue
            size, target = len(self.action), search.target
            kept = np.delete(np.arange(size), context)
            order = np.empty(size, dtype=np.int64)
            order[kept], order[context] = np.arange(size - 1), size - 1
            splits.append(Split(-1, order, order, 0.0))
            for split in search.splits:
                off, on = (np.concatenate([np.arange(size - 1), size - 1 + side]) for side in (split.off, split.on))
                splits.append(Split(int(near[split.feature]) if split.feature >= 0 else -1, off, on, split.gain))
            self.action = np.concatenate([self.action[kept], target.action])
            self.value = np.concatenate([self.value[kept], target.value])
            self.prior_mean = np.concatenate([self.prior_mean[kept], np.full(len(target.action), rates[context])])
            self.closed = np.concatenate([self.closed[kept], np.zeros(len(target.action), dtype=np.bool_)])
        if splits:
            self.follow(splits)
        return bool(splits)


def _round(planes: PlaneTable, refined: Sequence[_Refined], most: int, certain: float) -> bool:
    """Runs one round of refinement in all open contexts; returns whether any split was found."""
    tables = evidence_tables(max(int(each.n.max(initial=0)) for each in refined) + 1, certain)
    opened = [np.flatnonzero(each.open_contexts(tables)) for each in refined]
    limit = _cells_per_context([np.minimum(r.e, r.n - r.e)[o] for r, o in zip(refined, opened, strict=True)], most // 4)
    chosen: list[Ints] = []
    searches: list[list[Search]] = []
    for each, contexts in zip(refined, opened, strict=True):
        searches.append(_sampled(each, contexts, limit, chosen))
    every = [search for some in searches for search in some]
    if not every:
        return False
    rows, cells = np.divmod(np.concatenate(chosen), planes.n_cells)
    width = planes.board.width
    table = values_at(planes.features[planes.near], planes.every[0], planes.every_action, rows, cells // width, cells % width)
    kinds = feature_kinds(planes.features)[planes.near]
    tables = evidence_tables(len(table) + 1, certain)
    go_on(every, table, feature_blocks(table), kinds, planes.encoding.n_action_classes, tables, planes.in_pairs)
    grown = [each.graft(some, contexts, planes.near) for each, some, contexts in zip(refined, searches, opened, strict=True)]
    return any(grown)


def _cells_per_context(rarer: Sequence[Ints], room: int) -> int:
    """Limit per context on cells of the rarer outcome, such that the total over all contexts is at most ``room``; at least 1."""
    counts = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *rarer]))
    below = np.concatenate([[0], np.cumsum(counts)])
    for i, count in enumerate(counts):
        if below[i] + count * (len(counts) - i) > room:
            return max(1, int((room - below[i]) // (len(counts) - i)))
    return room


def _sampled(each: _Refined, contexts: Ints, limit: int, chosen: list[Ints]) -> list[Search]:
    """A search for each context on a sample of its cells. Appends these cells to ``chosen``; target rows are positions in it.

    The sample has up to ``limit`` evenly spaced cells of the rarer outcome, and up to three times as many plus ``FEWEST_ROOM``
    of the other. Sampled cells are unweighted: a feature absent from the sample may still occur in the population. Such a sample
    identifies discriminative features but not base rates, so each context is searched separately.
    """
    number = np.full(len(each.action) + 1, -1, dtype=np.int32)  # the last entry: cells without a context
    number[contexts] = np.arange(len(contexts))
    inside = np.flatnonzero(number[each.context] >= 0)
    group = 2 * number[each.context[inside]] + each.positives()[inside]
    order = np.argsort(group, kind="stable")
    ends = np.searchsorted(group[order], np.arange(2 * len(contexts) + 1))
    begun, searches = sum(len(cells) for cells in chosen), []
    for k, context in enumerate(contexts):
        outcomes = [inside[order[ends[2 * k + e] : ends[2 * k + e + 1]]] for e in (0, 1)]
        rarer = min(limit, *(len(outcome) for outcome in outcomes))
        sizes = [min(len(o), 3 * rarer + FEWEST_ROOM if len(o) == max(map(len, outcomes)) else rarer) for o in outcomes]
        taken = [o[np.linspace(0, len(o) - 1, n).astype(np.int64)] for o, n in zip(outcomes, sizes, strict=True)]
        chosen += taken
        rows, positives = begun + np.arange(sum(sizes)), np.repeat([0, 1], sizes)
        begun += sum(sizes)
        start = np.zeros(len(rows), dtype=np.int64)
        own = slice(int(context), int(context) + 1)
        searches.append(Search(Target(rows, start + 1, positives, start, each.action[own], each.value[own])))
    return searches


@compiled
def _walk(values: Bools, which: Ints, first: Ints, targets: Ints, context: NDArray[np.int32]) -> None:
    """Moves cells through splits: changes ``context`` in place.

    Args:
        values: features, bool [U, n].
        which: row of ``values`` that each split tests, int64 [S]; -1 for none.
        first: column of ``targets`` where each split begins, int64 [S + 1].
        targets: new context of each old context if the feature is off (row 0) or on (row 1), int64 [2, contexts of all splits].
        context: context of each cell, int32 [n]; negative for none.
    """
    for cell in range(len(context)):
        now = context[cell]
        if now >= 0:
            for s in range(len(which)):
                side = 1 if which[s] >= 0 and values[which[s], cell] else 0
                now = targets[side, first[s] + now]
            context[cell] = now
