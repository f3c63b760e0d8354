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
from mbagent.models.dbn.features import Layout, Observed, Question, action_features, ask, question
from mbagent.models.dbn.smoothing import Pools, Smoothing, smoothing_of
from mbagent.models.held_out import FORETOLD, better, thinned
from mbagent.types import Bools, Floats, Ints

SURE_GAIN = 5.0
"""Standard errors by which the slope of a partner must differ from zero."""

MOST_LOOKED_AT = 5000
"""Rows that are looked at."""

MOST_CANDIDATES = 200
"""Ordered factors and parts of actions; where there are more, no partners are looked for."""

MOST_NODES = 50_000
"""Nodes that a sum with a partner may take: its values times the factor's, times how many steps from the sum that ends."""


@dataclass(frozen=True)
class Operand:
    """A factor, the action, or a part of it.

    Attributes:
        cardinality: number of its values.
        factor: number of the factor, or -1.
        stride: of the action's part: it is ``action // stride % cardinality``.
        feature: number of the part's first column among those of actions.
        whole: whether it is the action, which is one thing.
    """

    cardinality: int
    factor: int = -1
    stride: int = 1
    feature: int = 0
    whole: bool = False

    def of(self, rows: TransitionBatch) -> Ints:
        """Its value in each row, int64 [N]."""
        found = rows.before[:, self.factor] if self.factor >= 0 else rows.actions // self.stride % self.cardinality
        return np.asarray(found, dtype=np.int64)

    def features(self, layout: Layout) -> Ints:
        """The column that is on where it has each value, int64 [cardinality]."""
        if self.factor >= 0:
            own = (layout.factor == self.factor) & (layout.value == layout.top)
            return np.flatnonzero(own)[np.argsort(layout.value[own])]
        return len(layout.factor) + self.feature + np.arange(self.cardinality)


def candidates(cardinalities: Sequence[int], parts: Sequence[int]) -> list[Operand]:
    """All factors with an order, and all parts of the action that have one; what is on or off has none."""
    factors = [Operand(n, factor=f) for f, n in enumerate(cardinalities) if n > 2]
    features = enumerate(action_features(parts))
    return factors + [Operand(n, -1, stride, i, len(parts) == 1) for i, (stride, n, value) in features if n > 2 and value == 0]


def likely_operands(factors: Sequence[int], among: Sequence[Operand], rows: TransitionBatch) -> list[tuple[Operand, int] | None]:
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
    x = np.stack([operand.of(some) for operand in among], axis=1).astype(np.float64)
    x -= x.mean(axis=0)
    change = some.after[:, factors].astype(np.float64) - some.before[:, factors]
    change -= change.mean(axis=0)
    inverse = np.linalg.pinv(x.T @ x)
    slopes = inverse @ (x.T @ change)
    left = ((change - x @ slopes) ** 2).sum(axis=0) / (len(some) - len(among) - 1)
    t = slopes / np.sqrt(np.outer(np.diag(inverse), left) + 1e-12)
    found: list[tuple[Operand, int] | None] = []
    for i, factor in enumerate(factors):
        own = [operand.factor == factor for operand in among]
        t[own, i] = 0.0
        best = int(np.abs(t[:, i]).argmax())
        likely = (among[best], int(np.sign(t[best, i]))) if abs(t[best, i]) > SURE_GAIN else None
        found.append(likely if likely and _entries(*likely, among[own.index(True)], some) <= MOST_NODES else None)
    return found


def _entries(operand: Operand, sign: int, factor: Operand, rows: TransitionBatch) -> int:
    """Number of nodes that a factor's sum with its partner takes, at most; with the action none."""
    far = rows.after[:, factor.factor].astype(np.int64) - factor.of(rows) - sign * operand.of(rows)
    return factor.cardinality * operand.cardinality * (len(np.unique(far)) + 2) * (not operand.whole)


def chained(entries: Ints, features: Ints, add: Callable[[int, int, int], int], zero: int) -> Ints:
    """One node for each (present value, value) that leads on by the partner's value.

    Args:
        entries: (partner's value, present value, value, node), int64 [N, 4].
        features: the partner's.
        add: adds a node (column, off, on) and returns its number.
        zero: node for the partner's values of which there is no entry.

    Returns:
        (present value, value, node) of each, int64 [M, 3].
    """
    found: dict[tuple[int, int], int] = {}
    for operand, now, value, node in entries.tolist():
        found[now, value] = add(int(features[operand]), found.get((now, value), zero), node)
    return np.asarray([(now, value, node) for (now, value), node in found.items()], dtype=np.int64).reshape(-1, 3)


def for_all_actions(smoothing: Smoothing, n_operand: int, n_action_classes: int) -> Smoothing:
    """A habit by pairs (partner's value, value), as one by pairs (way, value)."""
    persistence, unseen_mass = (
        np.tile(array.reshape(n_operand, -1).max(axis=0), n_action_classes)
        for array in (smoothing.persistence, smoothing.unseen_mass)
    )
    return replace(smoothing, persistence=persistence, unseen_mass=unseen_mass)


SELDOM = 1e-9
"""Share of rows in which a value is kept that a sum may lead back to: whatever the other values leave."""


class Effect(Enum):
    """How a factor is asked about; a sum or a difference is that of its value and the action's number, or its partner's.

    What is beyond the bounds counts in some sums, and is lost before luck comes in others: those fill or drain.
    """

    ABSOLUTE = "goes"
    RELATIVE = "moves"
    SUM = "adds"
    DIFFERENCE = "takes"
    CLIPPED_SUM = "fills"
    CLIPPED_DIFFERENCE = "drains"

    def sum_of(self, values: Ints, actions: Ints, last: int) -> Ints:
        """The sum of present values and the actions' numbers, or their difference."""
        sums = values + actions if self in (Effect.SUM, Effect.CLIPPED_SUM) else values - actions
        return np.clip(sums, 0, last) if self in (Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE) else sums


class EffectModel(NamedTuple):
    """A manner, and what sums are with; None for the number of the action's way."""

    effect: Effect
    operand: Operand | None = None


ABSOLUTE_EFFECT = EffectModel(Effect.ABSOLUTE)
"""Where it goes."""

SUM_EFFECTS = (Effect.SUM, Effect.DIFFERENCE, Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE)
"""Manners that ask of sums."""

SUM_ERRORS = 1.0
"""Standard errors by which a sum must foretell held-out values better: what an action's number is may mean nothing."""

ENOUGH_HELD_OUT, MOST_EFFECT_FOLDS = 1000, 6
"""So many held-out rows tell which manner fits; where there are fewer, others are held out, too, so many times in all."""


def best_effect_models(
    log_probs: Callable[[Sequence[EffectModel]], Floats],
    n_factors: int,
    operands: Callable[[], Sequence[tuple[Operand, int] | None]],
) -> list[EffectModel]:
    """How each of K factors is foretold best; sums are looked at where something is left to foretell.

    Args:
        log_probs: log-probabilities of held-out next values, each factor being asked about in some way, [N, K].
        n_factors: K.
        operands: the likeliest of each factor, and whether it is added (1) or taken away (-1).
    """
    logs, moves = (log_probs([effect_model] * n_factors) for effect_model in (ABSOLUTE_EFFECT, EffectModel(Effect.RELATIVE)))
    moving = (moves - logs).sum(axis=0) > 0.0
    best, logs = [EffectModel(Effect.RELATIVE) if there else ABSOLUTE_EFFECT for there in moving], np.where(moving, moves, logs)
    random = np.flatnonzero(logs.mean(axis=0) < FORETOLD).tolist()
    likely = operands() if random else []
    if not any(likely[i] for i in random):
        return best
    rounds = [
        [_summed(effects, *one) if one else usual for one, usual in zip(likely, best, strict=True)]
        for effects in ((Effect.SUM, Effect.DIFFERENCE), (Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE))
    ]
    sums = np.stack([log_probs(effect_models) for effect_models in rounds])
    for i in random:
        most = int(sums[:, :, i].mean(axis=1).argmax())
        if better(sums[most, :, i], logs[:, i], SUM_ERRORS):
            best[i] = rounds[most][i]
    return best


def _summed(effects: tuple[Effect, Effect], operand: Operand, sign: int) -> EffectModel:
    """How to ask about a sum with a partner, or a difference; actions are in all questions as it is."""
    return EffectModel(effects[sign < 0], None if operand.whole else operand)


def more_folds(train: TransitionBatch, held_out: TransitionBatch) -> list[Bools]:
    """Which rows to hold out, besides those that are, where these are too few to tell manners apart, [folds][N]."""
    if (n := len(train) // MOST_EFFECT_FOLDS) == 0:
        return []
    folds = min(MOST_EFFECT_FOLDS - 1, -(-(ENOUGH_HELD_OUT - len(held_out)) // n))
    return [np.arange(len(train)) // n == fold for fold in range(folds)]


def questions_for_effect(effect: Effect, variable: int, cardinality: int, n_actions: int, observed: Observed) -> list[Question]:
    """The questions about one unit; none if it never changes.

    Args:
        effect: how to ask; units of two values are asked where they go.
        variable: its number.
        cardinality: number of its values.
        n_actions: number of ways of actions, met or not.
        observed: the rows to ask.
    """
    if effect is Effect.ABSOLUTE or cardinality == 2 or (observed.now == observed.then).all():
        return ask(variable, cardinality, observed)
    return (
        _sums(effect, variable, cardinality, n_actions, observed)
        if effect in SUM_EFFECTS
        else _moves(variable, cardinality, observed)
    )


def _moves(variable: int, cardinality: int, observed: Observed) -> list[Question]:
    """How far a unit moves under the actions that ever moved it so far, whatever its present value, met or not.

    After the last value comes the first.
    """
    far, asked = (observed.then - observed.now) % cardinality, []
    for move in np.unique(far[far > 0]):
        leading = np.unique(observed.actions[far == move])
        rows = np.flatnonzero(np.isin(observed.actions, leading))
        every = (leading[:, None] * cardinality + np.arange(cardinality)).ravel()
        one = question(variable, far[rows], int(move), cardinality, observed.select(rows), every)
        asked.append(replace(one, values=(every % cardinality + move) % cardinality))
    return asked


def _sums(effect: Effect, variable: int, cardinality: int, n_actions: int, observed: Observed) -> list[Question]:
    """How far from the sum a unit ends within its bounds, and for either bound whether it ends there, given the sum.

    Sums that were never met are taken for the nearest one that was.
    """
    last, every = cardinality - 1, np.arange(n_actions * cardinality)
    sums, here = (
        effect.sum_of(*of, last) for of in ((every % cardinality, every // cardinality), (observed.now, observed.actions))
    )
    inside, asked = (observed.then > 0) & (observed.then < last), []
    for far in np.unique((observed.then - here)[inside]):
        rows = np.flatnonzero((here + far > 0) & (here + far < last))
        there = (sums + far > 0) & (sums + far < last)
        one = question(variable, (observed.then - here)[rows], int(far), cardinality, observed.select(rows), every[there])
        asked.append(_elsewhere(replace(one, values=sums[there] + far), cardinality))
    met = np.unique(here)
    nearest = np.searchsorted((met[:-1] + met[1:]) / 2, sums)
    for bound in np.intersect1d((0, last), observed.then):
        one = question(variable, observed.then, int(bound), cardinality, observed, every, nearest)
        asked.append(_elsewhere(one, cardinality))
    return asked


def _elsewhere(one: Question, cardinality: int) -> Question:
    """The question answered for pairs with other present values only: the present one has what the others leave."""
    other = one.pairs % cardinality != one.values
    return replace(one, values=one.values[other], pairs=one.pairs[other], context=one.context[other])


def smoothing_for_effect(effect: Effect, cardinality: int, n_actions: int, observed: Observed) -> Smoothing:
    """A unit's habit where it is asked about in a manner: what the manner asks at once is counted at once, too."""
    if effect is Effect.ABSOLUTE or cardinality == 2 or len(observed.now) == 0:
        return smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then)
    every = np.arange(n_actions * cardinality)
    if effect is Effect.RELATIVE:
        pools = Pools(every // cardinality, (observed.then - observed.now) % cardinality)
        return smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then, pools)
    value, last = every % cardinality, cardinality - 1
    sums, here = effect.sum_of(value, every // cardinality, last), effect.sum_of(observed.now, observed.actions, last)
    far, inside = observed.then - here, (observed.then > 0) & (observed.then < last)
    pools = Pools(np.zeros_like(every), np.where(inside, far - far.min(), np.ptp(far) + 1 + observed.then))
    smoothing = smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then, pools)
    met = np.isin(value - sums, far[inside]) & (value > 0) & (value < last)
    for bound in (0, last):
        met |= (value == bound) & np.isin(sums, here[observed.then == bound])
    return replace(smoothing, persistence=np.where(met, SELDOM, 0.0))
