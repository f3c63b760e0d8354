"""Manners of asking about a factor whose values are ordered: where it goes, how far it moves, or how far from a sum.

Which one fits is found by what held-out transitions tell. Stock plus order minus what luck takes, kept within bounds, is a
sum: what luck takes is asked of all stocks and orders at once, and at either bound only the sum matters, whatever it is made of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Bools, Floats
from mbagent.models.graphs.habits import Habit, Pools, habit_of
from mbagent.models.graphs.partners import Partner
from mbagent.models.graphs.units import Question, Seen, ask, question
from mbagent.models.memory import FORETOLD, better
from mbagent.transitions import TransitionBatch

Ints: TypeAlias = NDArray[np.int64]


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
