"""What each value of each unit hangs on: splits found greedily by evidence, surest first (paper section 5, modules).

The surest splits teach a prior for the rest: what kinds of columns are causes at all, whether one column serves many heads
or each head has its own, and how many causes a head has. With little data that prior decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbagent.models.graphs.evidence import Chosen, Columns, Floats, Head, Ints, Tables, best_split, columns_of, evidence_tables
from mbagent.models.graphs.leaves import best_prior
from mbagent.models.graphs.pairs import FIRST, LEAST, PairSearch
from mbagent.models.graphs.search import Bools, Search

SUREST = 0.99
"""A rate is believed to be 0 or 1 beforehand with this probability at most."""

MOST_SPLITS = 256
"""Most splits of one head."""


def find_splits(heads: Sequence[Head], table: Bools, kinds: Ints, n_actions: int, in_pairs: bool = True) -> list[Search]:
    """The splits of each head, and its rows with the contexts that they lead to.

    A first search tells how much of this world is certain at all; the second one knows.

    Args:
        heads: what is to be explained.
        table: columns of all rows that look different, bool [N, D].
        kinds: which kind of thing each column is, int64 [D]; causes of one kind make others of that kind likelier.
        n_actions: number of actions A.
        in_pairs: whether to look for causes that matter only together, too.
    """
    columns = columns_of(table)
    most = max((int(head.seen.sum()) for head in heads), default=0) + 1
    first = _searched(heads, table, columns, kinds, n_actions, evidence_tables(most), False)
    return _searched(heads, table, columns, kinds, n_actions, evidence_tables(most, certainty(first)), in_pairs)


def certainty(searches: Sequence[Search]) -> float:
    """Share of what was found that is not random at all, as believed of the rest."""
    return min(best_prior(searches).certain, SUREST)


def _searched(
    heads: Sequence[Head], table: Bools, columns: Columns, kinds: Ints, n_actions: int, tables: Tables, in_pairs: bool
) -> list[Search]:
    searches = [Search(head) for head in heads]
    for search in searches:
        search.merge(tables)
    go_on(searches, table, columns, kinds, n_actions, tables, in_pairs)
    return searches


def go_on(
    searches: Sequence[Search], table: Bools, columns: Columns, kinds: Ints, n_actions: int, tables: Tables, in_pairs: bool
) -> None:
    """Divides further as long as evidence grows; see ``find_splits``."""
    pairs = PairSearch(kinds, table, tables)
    going = True
    while going:
        while found := _next_splits(searches, columns, kinds, n_actions, tables):
            for h, chosen in found:
                searches[h].divide(chosen, table, tables)
                searches[h].open = len(searches[h].splits) < MOST_SPLITS
        going = in_pairs and pairs.divide(searches)


def _next_splits(
    searches: Sequence[Search], columns: Columns, kinds: Ints, n_actions: int, tables: Tables
) -> list[tuple[int, Chosen]]:
    """One more split for each head that has one: of all heads, or of the surer half once there is a prior to teach."""
    prior, learned = column_prior(searches, kinds, columns.n_columns)
    counts = np.asarray([sum(split.column >= 0 for split in search.splits) for search in searches])
    narrow = -np.asarray([math.log(n_actions) + 1.0, 2.0, 3.0])
    found = []
    for h, search in enumerate(searches):
        if search.open:
            more = ((counts > counts[h]).sum() + 0.5) / ((counts >= counts[h]).sum() + 1.0)
            odds = math.log(more / (1.0 - more)) if learned else -FIRST
            chosen = best_split(search.head, search.tally(columns), np.minimum(prior + odds, -LEAST), narrow, tables)
            if chosen.gain > 0.0:
                found.append((h, chosen))
    found.sort(key=lambda entry: -entry[1].gain)
    return found[: max(1, len(found) // 2)] if learned and found else found


def column_prior(searches: Sequence[Search], kinds: Ints, n_columns: int) -> tuple[Floats, bool]:
    """Log probability of each column to be the next cause [D], and whether it was learned from those found so far."""
    chosen = [split.column for search in searches for split in search.splits if split.column >= 0]
    if len(chosen) < max(3, len(searches) // 10):
        return np.full(n_columns, -math.log(n_columns)), False
    used = np.bincount(chosen, minlength=n_columns).astype(np.float64)
    n_kinds = int(kinds.max()) + 1
    again = (0.5 + np.maximum(used - 1, 0).sum()) / (len(chosen) + 1.0)
    of_kind = np.bincount(kinds, weights=used, minlength=n_kinds) + 0.2
    of_kind /= of_kind.sum()
    fresh = np.bincount(kinds[used == 0], minlength=n_kinds).clip(1)
    reused = np.bincount(kinds[used > 0], minlength=n_kinds).clip(1)
    share = np.where(used == 0, (1.0 - again) / fresh[kinds], again / reused[kinds])
    return np.log(of_kind[kinds] * share), True
