"""Changes of rewards during ``learn``: when they occurred, and which older rewards are still valid.

Random rewards contradict each other at all times; changed rewards contradict earlier ones from some step on. The evidence for
such a step is the gain in log-probability if each group of similar transitions has one reward distribution before it and another
after it. It must far exceed the gain in permuted orders of the same episodes, so that an unobserved property of episodes is not
mistaken for a change.
"""

from __future__ import annotations

import numpy as np
import scipy

from mbagent.data import TransitionBatch
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.random_keys import hash_rows

ORDERS, TIMES = 20, 1.75
"""Number of random permutations of the blocks, and the factor by which a change's evidence must exceed their greatest."""


LONG_EPISODE, MOST_EPISODE_BLOCKS = 1000, 50
"""Blocks are episodes; those longer than LONG_EPISODE rows, or than all rows / MOST_EPISODE_BLOCKS, are divided."""


CHANGE_EVIDENCE = 10.0
"""Evidence in nats that a change needs in addition to that of permutations."""


COUNT = 0.5
"""Pseudo-count of a Dirichlet prior over the values of a group."""


def triples(rows: TransitionBatch) -> Ints:
    """A hash of each (s, a, s'), int64 [N]."""
    return hash_rows(np.concatenate([rows.states, rows.actions[:, None], rows.next_states], axis=1)).view(np.int64)


def wrong_until(rows: TransitionBatch, wrong: Bools) -> int | None:
    """Number of rows before rewards changed to those of a function that is ``wrong`` in earlier rows; None if no change."""
    order, until = np.argsort(rows.episodes, kind="stable"), 0
    rows, flags = rows.select(order), wrong[order].astype(np.int64)
    keys = triples(rows)
    while found := turn(keys[until:], flags[until:], rows.episodes[until:]):
        until += found
    return until if until and not flags[until:].any() else None


def turn(groups: Ints, values: Ints, episodes: Ints) -> int:
    """First row from which rewards differ from earlier ones; 0 without evidence of a change.

    Args:
        groups: group of similar transitions to which each row belongs, int [N], in order of time, episode by episode.
        values: indices of the rewards, int [N].
        episodes: int [N].
    """
    groups = np.unique(groups, return_inverse=True)[1].ravel()
    pairs = np.unique(np.stack([groups, values]), axis=1, return_inverse=True)
    n_distinct = np.bincount(pairs[0][0])  # number of distinct values of each group
    varied = np.flatnonzero(n_distinct[groups] > 1)
    if not len(varied):
        return 0
    groups, labels, blocks = groups[varied], pairs[1].ravel()[varied], _blocks(episodes)[varied]
    gains, rng, best = _gains(groups, labels, n_distinct), np.random.default_rng(0), 0.0
    for _ in range(ORDERS):
        order = np.argsort(rng.permutation(blocks[-1] + 1)[blocks], kind="stable")
        best = max(best, float(_gains(groups[order], labels[order], n_distinct).max()))
    found = int(gains.argmax())
    return int(varied[found + 1]) if gains[found] > CHANGE_EVIDENCE + TIMES * best else 0


def still_hold(cells: Ints, values: Ints, since: int) -> Bools:
    """Rows before ``since`` in cells whose rewards have the same distribution after it, or were not observed again, [since].

    Args:
        cells: cell of similar transitions to which each row belongs, int [N].
        values: indices of the rewards, int [N].
        since: the row from which rewards differ.
    """
    cells = np.unique(cells, return_inverse=True)[1].ravel()
    shape, is_later = (2, int(cells.max()) + 1, int(values.max()) + 1), (np.arange(len(cells)) >= since).astype(np.int64)
    counts = np.bincount(np.ravel_multi_index((is_later, cells, values), shape), minlength=int(np.prod(shape))).reshape(shape)
    n_kinds = (counts.sum(axis=0) > 0).sum(axis=1)
    gain = _evidence(counts[0], n_kinds) + _evidence(counts[1], n_kinds) - _evidence(counts.sum(axis=0), n_kinds)
    same: Bools = (gain <= 0.0)[cells[:since]]
    return same


def _evidence(counts: Ints, n_kinds: Ints) -> Floats:
    """Log marginal likelihood [G] of rewards with counts [G, K], ``n_kinds`` [G] distinct ones in each group."""
    prior, total, log_gamma = COUNT * n_kinds, counts.sum(axis=1), scipy.special.gammaln
    result: Floats = (log_gamma(counts + COUNT) - log_gamma(COUNT)).sum(axis=1) - log_gamma(total + prior) + log_gamma(prior)
    return result


def _gains(groups: Ints, labels: Ints, n_distinct: Ints) -> Floats:
    """Evidence [N] for a change after each row: rows up to it are predicted from earlier ones, the others from later ones."""
    (rank, remaining), (own, own_remaining) = _ranks(groups), _ranks(labels)
    prior = COUNT * n_distinct[groups]
    forwards = np.log(own + COUNT) - np.log(rank + prior)
    backwards = np.log(own_remaining + COUNT) - np.log(remaining + prior)
    gains: Floats = np.cumsum(forwards - backwards)
    return gains


def _ranks(labels: Ints) -> tuple[Ints, Ints]:
    """For each row, how many earlier and how many later rows have the same label, int [N] each."""
    order, counts = np.argsort(labels, kind="stable"), np.bincount(labels)
    rank = np.empty(len(labels), dtype=np.int64)
    rank[order] = np.arange(len(labels)) - (np.cumsum(counts) - counts)[labels[order]]
    return rank, counts[labels] - 1 - rank


def _blocks(episodes: Ints) -> Ints:
    """Index of each row's block, int [N], ascending; blocks are whole episodes or parts of long ones."""
    n, rows = len(episodes), np.arange(len(episodes))
    first = np.flatnonzero(np.r_[True, episodes[1:] != episodes[:-1]])
    start = first[np.searchsorted(first, rows, side="right") - 1]
    length = min(max(n // MOST_EPISODE_BLOCKS, 1), LONG_EPISODE)
    blocks: Ints = np.unique(start + (rows - start) // length * length, return_inverse=True)[1].ravel()
    return blocks
