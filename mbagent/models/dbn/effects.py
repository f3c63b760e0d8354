"""Effect parametrisations of ordinal variables: the next value, its change, or its deviation from a sum.

Held-out transitions decide which one is used. The second operand of a sum is the action's number, that of a part of the action,
or another factor's value, as in stock plus order minus demand. For saturating sums such as inventory levels the distribution of
the residual is shared by all (stock, order) pairs; at a bound, only the unclipped sum is relevant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from mbagent.data import TransitionBatch
from mbagent.models.dbn.features import Layout, Question, Seen, act_columns, ask, question
from mbagent.models.dbn.smoothing import Habit, Pools, habit_of
from mbagent.models.held_out import FORETOLD, better, thinned
from mbagent.types import Bools, Floats, Ints

SURE = 5.0
"""Standard errors by which the slope of a partner must differ from zero."""

MOST_LOOKED_AT = 5000
"""Rows that are looked at."""

MOST_CANDIDATES = 200
"""Ordered factors and parts of actions; where there are more, no partners are looked for."""

MOST_ENTRIES = 50_000
"""Nodes that a sum with a partner may take: its values times the factor's, times how many steps from the sum that ends."""


@dataclass(frozen=True)
class Partner:
    """A factor, the action, or a part of it.

    Attributes:
        cardinality: number of its values.
        factor: number of the factor, or -1.
        stride: of the action's part: it is ``action // stride % cardinality``.
        column: number of the part's first column among those of actions.
        whole: whether it is the action, which is one thing.
    """

    cardinality: int
    factor: int = -1
    stride: int = 1
    column: int = 0
    whole: bool = False

    def of(self, rows: TransitionBatch) -> Ints:
        """Its value in each row, int64 [N]."""
        found = rows.before[:, self.factor] if self.factor >= 0 else rows.actions // self.stride % self.cardinality
        return np.asarray(found, dtype=np.int64)

    def columns(self, layout: Layout) -> Ints:
        """The column that is on where it has each value, int64 [cardinality]."""
        if self.factor >= 0:
            own = (layout.factor == self.factor) & (layout.value == layout.top)
            return np.flatnonzero(own)[np.argsort(layout.value[own])]
        return len(layout.factor) + self.column + np.arange(self.cardinality)


def candidates(cardinalities: Sequence[int], parts: Sequence[int]) -> list[Partner]:
    """All factors with an order, and all parts of the action that have one; what is on or off has none."""
    factors = [Partner(n, factor=f) for f, n in enumerate(cardinalities) if n > 2]
    columns = enumerate(act_columns(parts))
    return factors + [Partner(n, -1, stride, i, len(parts) == 1) for i, (stride, n, value) in columns if n > 2 and value == 0]


def likely_partners(factors: Sequence[int], among: Sequence[Partner], rows: TransitionBatch) -> list[tuple[Partner, int] | None]:
    """For each factor the partner that its change most surely rises (1) or falls (-1) with; None if with none.

    All other candidates are held constant: least squares, with t statistics.

    Args:
        factors: numbers of factors that are among the candidates themselves.
        among: the candidates.
        rows: N transitions.
    """
    some = thinned(rows, MOST_LOOKED_AT)
    if len(among) > MOST_CANDIDATES or len(some) < 2 * len(among) + 10:
        return [None] * len(factors)
    x = np.stack([partner.of(some) for partner in among], axis=1).astype(np.float64)
    x -= x.mean(axis=0)
    change = some.after[:, factors].astype(np.float64) - some.before[:, factors]
    change -= change.mean(axis=0)
    inverse = np.linalg.pinv(x.T @ x)
    slopes = inverse @ (x.T @ change)
    left = ((change - x @ slopes) ** 2).sum(axis=0) / (len(some) - len(among) - 1)
    t = slopes / np.sqrt(np.outer(np.diag(inverse), left) + 1e-12)
    found: list[tuple[Partner, int] | None] = []
    for i, factor in enumerate(factors):
        own = [partner.factor == factor for partner in among]
        t[own, i] = 0.0
        best = int(np.abs(t[:, i]).argmax())
        likely = (among[best], int(np.sign(t[best, i]))) if abs(t[best, i]) > SURE else None
        found.append(likely if likely and _entries(*likely, among[own.index(True)], some) <= MOST_ENTRIES else None)
    return found


def _entries(partner: Partner, sign: int, factor: Partner, rows: TransitionBatch) -> int:
    """Number of nodes that a factor's sum with its partner takes, at most; with the action none."""
    far = rows.after[:, factor.factor].astype(np.int64) - factor.of(rows) - sign * partner.of(rows)
    return factor.cardinality * partner.cardinality * (len(np.unique(far)) + 2) * (not partner.whole)


def chained(entries: Ints, columns: Ints, add: Callable[[int, int, int], int], zero: int) -> Ints:
    """One node for each (present value, value) that leads on by the partner's value.

    Args:
        entries: (partner's value, present value, value, node), int64 [N, 4].
        columns: the partner's.
        add: adds a node (column, off, on) and returns its number.
        zero: node for the partner's values of which there is no entry.

    Returns:
        (present value, value, node) of each, int64 [M, 3].
    """
    found: dict[tuple[int, int], int] = {}
    for partner, now, value, node in entries.tolist():
        found[now, value] = add(int(columns[partner]), found.get((now, value), zero), node)
    return np.asarray([(now, value, node) for (now, value), node in found.items()], dtype=np.int64).reshape(-1, 3)


def for_all_ways(habit: Habit, n_partner: int, n_ways: int) -> Habit:
    """A habit by pairs (partner's value, value), as one by pairs (way, value)."""
    stays, novelty = (np.tile(array.reshape(n_partner, -1).max(axis=0), n_ways) for array in (habit.stays, habit.novelty))
    return replace(habit, stays=stays, novelty=novelty)


SELDOM = 1e-9
"""Share of rows in which a value is kept that a sum may lead back to: whatever the other values leave."""


class Manner(Enum):
    """How a factor is asked about; a sum or a difference is that of its value and the action's number, or its partner's.

    What is beyond the bounds counts in some sums, and is lost before luck comes in others: those fill or drain.
    """

    GOES = "goes"
    MOVES = "moves"
    ADDS = "adds"
    TAKES = "takes"
    FILLS = "fills"
    DRAINS = "drains"

    def sum_of(self, values: Ints, actions: Ints, last: int) -> Ints:
        """The sum of present values and the actions' numbers, or their difference."""
        sums = values + actions if self in (Manner.ADDS, Manner.FILLS) else values - actions
        return np.clip(sums, 0, last) if self in (Manner.FILLS, Manner.DRAINS) else sums


class Asking(NamedTuple):
    """A manner, and what sums are with; None for the number of the action's way."""

    manner: Manner
    partner: Partner | None = None


WHERE = Asking(Manner.GOES)
"""Where it goes."""

SUMS = (Manner.ADDS, Manner.TAKES, Manner.FILLS, Manner.DRAINS)
"""Manners that ask of sums."""

SUM_ERRORS = 1.0
"""Standard errors by which a sum must foretell held-out values better: what an action's number is may mean nothing."""

ENOUGH, MOST_FOLDS = 1000, 6
"""So many held-out rows tell which manner fits; where there are fewer, others are held out, too, so many times in all."""


def best_askings(
    foretold: Callable[[Sequence[Asking]], Floats],
    n_factors: int,
    partners: Callable[[], Sequence[tuple[Partner, int] | None]],
) -> list[Asking]:
    """How each of K factors is foretold best; sums are looked at where something is left to foretell.

    Args:
        foretold: log-probabilities of held-out next values, each factor being asked about in some way, [N, K].
        n_factors: K.
        partners: the likeliest of each factor, and whether it is added (1) or taken away (-1).
    """
    logs, moves = (foretold([asking] * n_factors) for asking in (WHERE, Asking(Manner.MOVES)))
    moving = (moves - logs).sum(axis=0) > 0.0
    best, logs = [Asking(Manner.MOVES) if there else WHERE for there in moving], np.where(moving, moves, logs)
    random = np.flatnonzero(logs.mean(axis=0) < FORETOLD).tolist()
    likely = partners() if random else []
    if not any(likely[i] for i in random):
        return best
    rounds = [
        [_summed(manners, *one) if one else usual for one, usual in zip(likely, best, strict=True)]
        for manners in ((Manner.ADDS, Manner.TAKES), (Manner.FILLS, Manner.DRAINS))
    ]
    sums = np.stack([foretold(askings) for askings in rounds])
    for i in random:
        most = int(sums[:, :, i].mean(axis=1).argmax())
        if better(sums[most, :, i], logs[:, i], SUM_ERRORS):
            best[i] = rounds[most][i]
    return best


def _summed(manners: tuple[Manner, Manner], partner: Partner, sign: int) -> Asking:
    """How to ask about a sum with a partner, or a difference; actions are in all questions as it is."""
    return Asking(manners[sign < 0], None if partner.whole else partner)


def more_folds(train: TransitionBatch, held_out: TransitionBatch) -> list[Bools]:
    """Which rows to hold out, besides those that are, where these are too few to tell manners apart, [folds][N]."""
    if (n := len(train) // MOST_FOLDS) == 0:
        return []
    folds = min(MOST_FOLDS - 1, -(-(ENOUGH - len(held_out)) // n))
    return [np.arange(len(train)) // n == fold for fold in range(folds)]


def ask_in(manner: Manner, unit: int, cardinality: int, n_actions: int, seen: Seen) -> list[Question]:
    """The questions about one unit; none if it never changes.

    Args:
        manner: how to ask; units of two values are asked where they go.
        unit: its number.
        cardinality: number of its values.
        n_actions: number of ways of actions, met or not.
        seen: the rows to ask.
    """
    if manner is Manner.GOES or cardinality == 2 or (seen.now == seen.then).all():
        return ask(unit, cardinality, seen)
    return _sums(manner, unit, cardinality, n_actions, seen) if manner in SUMS else _moves(unit, cardinality, seen)


def _moves(unit: int, cardinality: int, seen: Seen) -> list[Question]:
    """How far a unit moves under the actions that ever moved it so far, whatever its present value, met or not.

    After the last value comes the first.
    """
    far, asked = (seen.then - seen.now) % cardinality, []
    for move in np.unique(far[far > 0]):
        leading = np.unique(seen.actions[far == move])
        rows = np.flatnonzero(np.isin(seen.actions, leading))
        every = (leading[:, None] * cardinality + np.arange(cardinality)).ravel()
        one = question(unit, far[rows], int(move), cardinality, seen.select(rows), every)
        asked.append(replace(one, values=(every % cardinality + move) % cardinality))
    return asked


def _sums(manner: Manner, unit: int, cardinality: int, n_actions: int, seen: Seen) -> list[Question]:
    """How far from the sum a unit ends within its bounds, and for either bound whether it ends there, given the sum.

    Sums that were never met are taken for the nearest one that was.
    """
    last, every = cardinality - 1, np.arange(n_actions * cardinality)
    sums, here = (manner.sum_of(*of, last) for of in ((every % cardinality, every // cardinality), (seen.now, seen.actions)))
    inside, asked = (seen.then > 0) & (seen.then < last), []
    for far in np.unique((seen.then - here)[inside]):
        rows = np.flatnonzero((here + far > 0) & (here + far < last))
        there = (sums + far > 0) & (sums + far < last)
        one = question(unit, (seen.then - here)[rows], int(far), cardinality, seen.select(rows), every[there])
        asked.append(_elsewhere(replace(one, values=sums[there] + far), cardinality))
    met = np.unique(here)
    nearest = np.searchsorted((met[:-1] + met[1:]) / 2, sums)
    for bound in np.intersect1d((0, last), seen.then):
        one = question(unit, seen.then, int(bound), cardinality, seen, every, nearest)
        asked.append(_elsewhere(one, cardinality))
    return asked


def _elsewhere(one: Question, cardinality: int) -> Question:
    """The question answered for pairs with other present values only: the present one has what the others leave."""
    other = one.pairs % cardinality != one.values
    return replace(one, values=one.values[other], pairs=one.pairs[other], context=one.context[other])


def habit_in(manner: Manner, cardinality: int, n_actions: int, seen: Seen) -> Habit:
    """A unit's habit where it is asked about in a manner: what the manner asks at once is counted at once, too."""
    if manner is Manner.GOES or cardinality == 2 or len(seen.now) == 0:
        return habit_of(cardinality, n_actions, seen.actions, seen.now, seen.then)
    every = np.arange(n_actions * cardinality)
    if manner is Manner.MOVES:
        pools = Pools(every // cardinality, (seen.then - seen.now) % cardinality)
        return habit_of(cardinality, n_actions, seen.actions, seen.now, seen.then, pools)
    value, last = every % cardinality, cardinality - 1
    sums, here = manner.sum_of(value, every // cardinality, last), manner.sum_of(seen.now, seen.actions, last)
    far, inside = seen.then - here, (seen.then > 0) & (seen.then < last)
    pools = Pools(np.zeros_like(every), np.where(inside, far - far.min(), np.ptp(far) + 1 + seen.then))
    habit = habit_of(cardinality, n_actions, seen.actions, seen.now, seen.then, pools)
    met = np.isin(value - sums, far[inside]) & (value > 0) & (value < last)
    for bound in (0, last):
        met |= (value == bound) & np.isin(sums, here[seen.then == bound])
    return replace(habit, stays=np.where(met, SELDOM, 0.0))
