"""How much better outcomes are explained when rows are told apart by a column: exact Bayesian evidence, compiled.

Rows of a head fall into *contexts*. A *split* takes those rows of some contexts in which a column is on; they share
one rate then, whatever their context (pooling: a wall's evidence comes from all its sides), and all other rows keep
the rates of their contexts. The evidence for a rate is the marginal likelihood under a Beta prior (Heckerman, Geiger and
Chickering 1995), which small strengths turn into a preference for pure rows. Shapes: R rows, D columns, C contexts.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.types import Floats, Ints
from mbagent_envs.jit import compiled

Tables: TypeAlias = tuple[Floats, Floats, Floats]

BY_ALL, BY_ACTION, BY_VALUE, BY_CONTEXT = 0, 1, 2, 3
"""Contexts that a split may pool: all, those of one action, those of one present value, or a single one."""

STRENGTH = 0.2
"""Both parameters of the Beta prior."""


class FeatureBlocks(NamedTuple):
    """Columns that are on in each row, in compressed rows.

    Attributes:
        first: int64 [N + 1].
        feature: int64 [nonzeros].
        n_features: D.
    """

    first: Ints
    feature: Ints
    n_features: int


class Target(NamedTuple):
    """Rows in which one value of one unit is possible, and how often it came; rows that look alike are one row here.

    Attributes:
        rows: numbers of rows, int64 [R].
        counts: how often each was met, int64 [R].
        positives: how often the value came then, int64 [R].
        context: int64 [R], 0 ... C - 1.
        action: of each context, int64 [C]; -1 where contexts of several actions were merged.
        value: of the unit in each context, int64 [C]; -1 likewise.
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
        gain: evidence beyond its price; 0 where no split has any.
        kind: BY_ALL, BY_ACTION, BY_VALUE or BY_CONTEXT.
        which: the action, the value or the context.
        feature: what the rows are told apart by.
    """

    gain: float
    kind: int
    which: int
    feature: int


def feature_blocks(table: NDArray[np.generic]) -> FeatureBlocks:
    """Columns of a table [N, D] of zeros and ones."""
    rows, feature = np.nonzero(table)
    first = np.searchsorted(rows, np.arange(len(table) + 1)).astype(np.int64)
    return FeatureBlocks(first, feature.astype(np.int64), table.shape[1])


def evidence_tables(n: int, certain: float = 0.0, strength: float = STRENGTH) -> Tables:
    """What the evidence of up to ``n`` rows is put together from, see ``evidence``.

    Args:
        n: rows.
        certain: probability that a rate is 0 or 1, before any row is seen; else it has the Beta prior.
        strength: both parameters of the Beta prior.
    """
    i = np.arange(n)
    one = np.concatenate([[0.0], np.cumsum(np.log(i + strength))])
    two = np.concatenate([[0.0], np.cumsum(np.log(i + 2.0 * strength))]) - np.log1p(-certain)
    with np.errstate(divide="ignore"):
        alike = np.logaddexp(np.log(0.5 * certain), one - two)
    alike[0] = 0.0
    return one, two, alike


@compiled
def evidence(positives: int, n: int, one: Floats, two: Floats, alike: Floats) -> float:
    """Log marginal likelihood of ``positives`` among ``n`` outcomes."""
    if positives == 0 or positives == n:
        return float(alike[n])
    return float(one[positives] + one[n - positives] - two[n])


def evidences(positives: Ints, n: Ints, tables: Tables) -> Floats:
    """As ``evidence``, of many."""
    one, two, alike = tables
    result: Floats = np.where((positives == 0) | (positives == n), alike[n], one[positives] + one[n - positives] - two[n])
    return result


class Tally(NamedTuple):
    """What a head's rows come to.

    Attributes:
        n, e: rows and arrivals of each context, int64 [C].
        on, positives_on: those with each column on, int64 [C, D].
    """

    n: Ints
    e: Ints
    on: Ints
    positives_on: Ints


@compiled
def count(target: Target, features: FeatureBlocks) -> Tally:
    """Counts rows and arrivals of each context, with each column on."""
    n_contexts = len(target.action)
    n, e = np.zeros((2, n_contexts), dtype=np.int64)
    on, positives_on = np.zeros((2, n_contexts, features.n_features), dtype=np.int64)
    for r in range(len(target.rows)):
        context, counts, positives = target.context[r], target.counts[r], target.positives[r]
        n[context] += counts
        e[context] += positives
        for j in range(features.first[target.rows[r]], features.first[target.rows[r] + 1]):
            on[context, features.feature[j]] += counts
            positives_on[context, features.feature[j]] += positives
    return Tally(n, e, on, positives_on)


class Sets(NamedTuple):
    """Sets of contexts that a split may be about: all, those of each action, those of each present value.

    Attributes:
        of: numbers of the sets that each context is in, int64 [C, 3]; the last number is one that counts for nothing.
        n, e: rows and arrivals of each set, int64 [S].
        evidence: of its contexts' own rates, summed, [S].
        base: of each context's own rate, [C].
        n_actions: number of sets that are an action's.
    """

    of: Ints
    n: Ints
    e: Ints
    evidence: Floats
    base: Floats
    n_actions: int


@compiled
def _sets(target: Target, n: Ints, e: Ints, one: Floats, two: Floats, alike: Floats) -> Sets:
    n_actions, n_values = target.action.max() + 1, target.value.max() + 1
    n_sets = 2 + n_actions + n_values
    of = np.zeros((len(n), 3), dtype=np.int64)
    of[:, 1] = np.where(target.action < 0, n_sets - 1, 1 + target.action)
    of[:, 2] = np.where(target.value < 0, n_sets - 1, 1 + n_actions + target.value)
    rows, positives = np.zeros((2, n_sets), dtype=np.int64)
    total, base = np.zeros(n_sets), np.empty(len(n))
    for c in range(len(n)):
        base[c] = evidence(e[c], n[c], one, two, alike)
        for s in of[c]:
            rows[s] += n[c]
            positives[s] += e[c]
            total[s] += base[c]
    return Sets(of, rows, positives, total, base, n_actions)


@compiled
def best_split(target: Target, tally: Tally, prior: Floats, narrow: Floats, tables: Tables) -> Chosen:
    """The split with the most evidence beyond its price.

    On either side of the split, the contexts of the set share one rate or keep a rate each, whichever has more evidence.

    Args:
        target: the rows, with at least two outcomes that differ.
        tally: their counts.
        prior: log prior odds of each column as a cause in all contexts, [D]; -inf for one that must not be.
        narrow: log prior odds to be added for contexts of one action, of one value, and for a single context, [3].
        tables: evidence_tables of at least R.
    """
    one, two, alike = tables
    n, e, on, positives_on = tally
    sets = _sets(target, n, e, one, two, alike)
    n_sets = len(sets.n)
    set_n, set_e = np.zeros((2, n_sets), dtype=np.int64)
    inside, outside = np.zeros((2, n_sets))
    best, kind, which, chosen = 0.0, 0, 0, 0
    for b in range(on.shape[1]):
        if prior[b] == -math.inf:
            continue
        set_n[:], set_e[:], inside[:], outside[:] = 0, 0, 0.0, sets.evidence
        for c in range(len(n)):
            if on[c, b] == 0:
                continue
            those = evidence(positives_on[c, b], on[c, b], one, two, alike)
            others = evidence(e[c] - positives_on[c, b], n[c] - on[c, b], one, two, alike) - sets.base[c]
            for s in sets.of[c]:
                set_n[s] += on[c, b]
                set_e[s] += positives_on[c, b]
                inside[s] += those
                outside[s] += others
            gain = those + others + prior[b] + narrow[2]
            if gain > best and on[c, b] < n[c]:
                best, kind, which, chosen = gain, BY_CONTEXT, c, b
        for s in range(n_sets - 1):
            if set_n[s] == 0 or set_n[s] == sets.n[s]:
                continue
            gain = max(inside[s], evidence(set_e[s], set_n[s], one, two, alike)) - sets.evidence[s] + prior[b]
            gain += max(outside[s], evidence(sets.e[s] - set_e[s], sets.n[s] - set_n[s], one, two, alike))
            gain += 0.0 if s == 0 else narrow[0] if s <= sets.n_actions else narrow[1]
            if gain > best:
                kind = BY_ALL if s == 0 else BY_ACTION if s <= sets.n_actions else BY_VALUE
                best, chosen = gain, b
                which = 0 if s == 0 else s - 1 if s <= sets.n_actions else s - 1 - sets.n_actions
    return Chosen(best, kind, which, chosen)
