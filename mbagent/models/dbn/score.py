"""Bayesian score of splits: exact gain in log marginal likelihood, compiled.

Rows of a target belong to *contexts*. A *split* divides the rows of some contexts by a feature; on each side, either all these
contexts share one rate (pooling: a wall is learned from all directions together), or each keeps a rate of its own. The evidence
of a rate is the marginal likelihood under a Beta prior (Heckerman, Geiger and Chickering 1995), whose small strength favours pure
contexts. Shapes: R rows, D features, C contexts.
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
"""Sets of contexts that a split can apply to: all, those of one action, those of one current value, or a single one."""

STRENGTH = 0.2
"""Both parameters of the Beta prior."""


class FeatureBlocks(NamedTuple):
    """Features that are on in each row, in compressed sparse row format.

    Attributes:
        first: int64 [N + 1].
        feature: int64 [nonzeros].
        n_features: D.
    """

    first: Ints
    feature: Ints
    n_features: int


class Target(NamedTuple):
    """A one-vs-rest target: patterns after which a value of a variable is possible, and how often it was observed.

    Attributes:
        rows: numbers of the patterns in the feature table, int64 [R].
        counts: how often each pattern was observed, int64 [R].
        positives: how often the value came next, int64 [R].
        context: context of each pattern, 0 ... C - 1, int64 [R].
        action: action class of each context, int64 [C]; -1 if contexts of several classes were merged.
        value: the variable's current value in each context, int64 [C]; -1 if several were merged.
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
        which: the action, the value or the context.
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


def evidence_tables(n: int, certain: float = 0.0, strength: float = STRENGTH) -> Tables:
    """Tables from which ``evidence`` of up to ``n`` rows is computed.

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
    """Counts of a target's rows.

    Attributes:
        n, e: rows and positives of each context, int64 [C].
        on, positives_on: those with each feature on, int64 [C, D].
    """

    n: Ints
    e: Ints
    on: Ints
    positives_on: Ints


@compiled
def count(target: Target, features: FeatureBlocks) -> Tally:
    """Counts rows and positives of each context, in all and with each feature on."""
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
    """Sets of contexts that a split can apply to: all, those of each action, those of each current value.

    Attributes:
        of: numbers of the sets that contain each context, int64 [C, 3]; the last set is a placeholder that is never used.
        n, e: rows and positives of each set, int64 [S].
        evidence: evidence of a set's contexts with separate rates, summed, [S].
        base: evidence of each context's own rate, [C].
        n_actions: number of sets of actions.
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
    """The split with the highest gain.

    On either side of the split, the contexts of the set share one rate or have a rate each, whichever has more evidence.

    Args:
        target: the rows, with both outcomes.
        tally: their counts.
        prior: log prior odds of a split by each feature in all contexts, [D]; -inf for features that are excluded.
        narrow: log prior odds to be added for contexts of one action, of one value, and for a single context, [3].
        tables: ``evidence_tables`` for at least the sum of the target's counts.
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
            own = evidence(positives_on[c, b], on[c, b], one, two, alike)
            others = evidence(e[c] - positives_on[c, b], n[c] - on[c, b], one, two, alike) - sets.base[c]
            for s in sets.of[c]:
                set_n[s] += on[c, b]
                set_e[s] += positives_on[c, b]
                inside[s] += own
                outside[s] += others
            gain = own + others + prior[b] + narrow[2]
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
