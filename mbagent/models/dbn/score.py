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

ALL, ACTION, VALUE, SINGLE = 0, 1, 2, 3
"""Contexts that a split may pool: all, those of one action, those of one present value, or a single one."""

STRENGTH = 0.2
"""Both parameters of the Beta prior."""


class Columns(NamedTuple):
    """Columns that are on in each row, in compressed rows.

    Attributes:
        first: int64 [N + 1].
        column: int64 [nonzeros].
        n_columns: D.
    """

    first: Ints
    column: Ints
    n_columns: int


class Head(NamedTuple):
    """Rows in which one value of one unit is possible, and how often it came; rows that look alike are one row here.

    Attributes:
        rows: numbers of rows, int64 [R].
        seen: how often each was met, int64 [R].
        came: how often the value came then, int64 [R].
        context: int64 [R], 0 ... C - 1.
        action: of each context, int64 [C]; -1 where contexts of several actions were merged.
        value: of the unit in each context, int64 [C]; -1 likewise.
    """

    rows: Ints
    seen: Ints
    came: Ints
    context: Ints
    action: Ints
    value: Ints


class Chosen(NamedTuple):
    """A split.

    Attributes:
        gain: evidence beyond its price; 0 where no split has any.
        kind: ALL, ACTION, VALUE or SINGLE.
        which: the action, the value or the context.
        column: what the rows are told apart by.
    """

    gain: float
    kind: int
    which: int
    column: int


def columns_of(table: NDArray[np.generic]) -> Columns:
    """Columns of a table [N, D] of zeros and ones."""
    rows, column = np.nonzero(table)
    first = np.searchsorted(rows, np.arange(len(table) + 1)).astype(np.int64)
    return Columns(first, column.astype(np.int64), table.shape[1])


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
def evidence(came: int, n: int, one: Floats, two: Floats, alike: Floats) -> float:
    """Log marginal likelihood of ``came`` among ``n`` outcomes."""
    if came == 0 or came == n:
        return float(alike[n])
    return float(one[came] + one[n - came] - two[n])


def evidences(came: Ints, n: Ints, tables: Tables) -> Floats:
    """As ``evidence``, of many."""
    one, two, alike = tables
    result: Floats = np.where((came == 0) | (came == n), alike[n], one[came] + one[n - came] - two[n])
    return result


class Tally(NamedTuple):
    """What a head's rows come to.

    Attributes:
        n, e: rows and arrivals of each context, int64 [C].
        on, came_on: those with each column on, int64 [C, D].
    """

    n: Ints
    e: Ints
    on: Ints
    came_on: Ints


@compiled
def count(head: Head, columns: Columns) -> Tally:
    """Counts rows and arrivals of each context, with each column on."""
    n_contexts = len(head.action)
    n, e = np.zeros((2, n_contexts), dtype=np.int64)
    on, came_on = np.zeros((2, n_contexts, columns.n_columns), dtype=np.int64)
    for r in range(len(head.rows)):
        context, seen, came = head.context[r], head.seen[r], head.came[r]
        n[context] += seen
        e[context] += came
        for j in range(columns.first[head.rows[r]], columns.first[head.rows[r] + 1]):
            on[context, columns.column[j]] += seen
            came_on[context, columns.column[j]] += came
    return Tally(n, e, on, came_on)


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
def _sets(head: Head, n: Ints, e: Ints, one: Floats, two: Floats, alike: Floats) -> Sets:
    n_actions, n_values = head.action.max() + 1, head.value.max() + 1
    n_sets = 2 + n_actions + n_values
    of = np.zeros((len(n), 3), dtype=np.int64)
    of[:, 1] = np.where(head.action < 0, n_sets - 1, 1 + head.action)
    of[:, 2] = np.where(head.value < 0, n_sets - 1, 1 + n_actions + head.value)
    rows, came = np.zeros((2, n_sets), dtype=np.int64)
    total, base = np.zeros(n_sets), np.empty(len(n))
    for c in range(len(n)):
        base[c] = evidence(e[c], n[c], one, two, alike)
        for s in of[c]:
            rows[s] += n[c]
            came[s] += e[c]
            total[s] += base[c]
    return Sets(of, rows, came, total, base, n_actions)


@compiled
def best_split(head: Head, tally: Tally, prior: Floats, narrow: Floats, tables: Tables) -> Chosen:
    """The split with the most evidence beyond its price.

    On either side of the split, the contexts of the set share one rate or keep a rate each, whichever has more evidence.

    Args:
        head: the rows, with at least two outcomes that differ.
        tally: their counts.
        prior: log prior odds of each column as a cause in all contexts, [D]; -inf for one that must not be.
        narrow: log prior odds to be added for contexts of one action, of one value, and for a single context, [3].
        tables: evidence_tables of at least R.
    """
    one, two, alike = tables
    n, e, on, came_on = tally
    sets = _sets(head, n, e, one, two, alike)
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
            those = evidence(came_on[c, b], on[c, b], one, two, alike)
            others = evidence(e[c] - came_on[c, b], n[c] - on[c, b], one, two, alike) - sets.base[c]
            for s in sets.of[c]:
                set_n[s] += on[c, b]
                set_e[s] += came_on[c, b]
                inside[s] += those
                outside[s] += others
            gain = those + others + prior[b] + narrow[2]
            if gain > best and on[c, b] < n[c]:
                best, kind, which, chosen = gain, SINGLE, c, b
        for s in range(n_sets - 1):
            if set_n[s] == 0 or set_n[s] == sets.n[s]:
                continue
            gain = max(inside[s], evidence(set_e[s], set_n[s], one, two, alike)) - sets.evidence[s] + prior[b]
            gain += max(outside[s], evidence(sets.e[s] - set_e[s], sets.n[s] - set_n[s], one, two, alike))
            gain += 0.0 if s == 0 else narrow[0] if s <= sets.n_actions else narrow[1]
            if gain > best:
                kind = ALL if s == 0 else ACTION if s <= sets.n_actions else VALUE
                best, chosen = gain, b
                which = 0 if s == 0 else s - 1 if s <= sets.n_actions else s - 1 - sets.n_actions
    return Chosen(best, kind, which, chosen)
