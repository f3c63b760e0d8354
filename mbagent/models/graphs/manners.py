"""Manners of asking about a factor whose values are ordered: where it goes, how far it moves, or how far from a sum.

Which one fits is found by what held-out transitions tell. Stock plus order minus what luck takes, kept within bounds, is a
sum: what luck takes is asked of all stocks and orders at once, and at either bound only the sum matters, whatever it is made of.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.habits import Habit, Pools, habit_of
from mbagent.models.graphs.units import Question, Seen, ask, question

Ints: TypeAlias = NDArray[np.int64]


SELDOM = 1e-9
"""Share of rows in which a value is kept that a sum may lead back to: whatever the other values leave."""


class Manner(Enum):
    """How a factor is asked about; a sum or a difference is that of its value and the action's number."""

    GOES = "goes"
    MOVES = "moves"
    ADDS = "adds"
    TAKES = "takes"

    @property
    def sign(self) -> int:
        """What the action's number counts in the sum."""
        return {Manner.ADDS: 1, Manner.TAKES: -1}.get(self, 0)


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
    return _moves(unit, cardinality, seen) if manner is Manner.MOVES else _sums(unit, cardinality, n_actions, seen, manner.sign)


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


def _sums(unit: int, cardinality: int, n_actions: int, seen: Seen, sign: int) -> list[Question]:
    """How far from the sum a unit ends within its bounds, and for either bound whether it ends there, given the sum.

    Sums that were never met are taken for the nearest one that was.
    """
    last, every = cardinality - 1, np.arange(n_actions * cardinality)
    sums, here = every % cardinality + sign * (every // cardinality), seen.now + sign * seen.actions
    inside, asked = (seen.then > 0) & (seen.then < last), []
    for far in np.unique((seen.then - here)[inside]):
        rows = np.flatnonzero((here + far > 0) & (here + far < last))
        pairs = every[(sums + far > 0) & (sums + far < last)]
        one = question(unit, (seen.then - here)[rows], int(far), cardinality, seen.select(rows), pairs)
        asked.append(_elsewhere(replace(one, values=pairs % cardinality + sign * (pairs // cardinality) + far), cardinality))
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
    sums, here = every % cardinality + manner.sign * (every // cardinality), seen.now + manner.sign * seen.actions
    far, inside = seen.then - here, (seen.then > 0) & (seen.then < cardinality - 1)
    pools = Pools(np.zeros_like(every), np.where(inside, far - far.min(), np.ptp(far) + 1 + seen.then))
    habit = habit_of(cardinality, n_actions, seen.actions, seen.now, seen.then, pools)
    value = every % cardinality
    met = np.isin(value - sums, far[inside]) & (value > 0) & (value < cardinality - 1)
    for bound in (0, cardinality - 1):
        met |= (value == bound) & np.isin(sums, here[seen.then == bound])
    return replace(habit, stays=np.where(met, SELDOM, 0.0))
