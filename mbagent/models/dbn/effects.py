"""Effect parametrisations of ordinal variables: the next value, its change, or its deviation from a sum.

Held-out transitions decide which one is used. The second operand of a sum is the action's index, an action component, or another
factor's value, as in stock plus order minus demand. For saturating sums such as inventory levels, the distribution of the
residual is shared by all (stock, order) pairs; at a bound, only the unclipped sum is relevant. Back-off statistics of a variable
given its value and the action (persistence, and the probability of a value never observed) smooth the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from mbagent.data import TransitionBatch
from mbagent.models.dbn.features import Layout, Observed, Question, action_features, ask, question
from mbagent.models.held_out import PERFECT_LOG_PROB, better, thinned
from mbagent.types import Bools, Floats, Ints

THETAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
"""Parameters of Ewens' formula to choose from."""


@dataclass(frozen=True)
class Smoothing:
    """Statistics of a variable after each (action class, value) pair, regardless of all other features.

    Attributes:
        persistence: share of a pair's rows in which the variable kept its value, [pairs]; 1 without rows.
        unseen_mass: probability of outcomes never observed after that pair, [pairs]; without rows, as after one row.
        base: smoothed frequency of each value among changes, [cardinality], summing to one.
    """

    persistence: Floats
    unseen_mass: Floats
    base: Floats


@dataclass(frozen=True)
class Pools:
    """Pairs whose rows are counted together for the unseen mass.

    Attributes:
        of: index of each pair's pool, int64 [pairs].
        positives: outcome of each row, numbered consistently within a pool, int64 [N].
    """

    of: Ints
    positives: Ints


def smoothing_of(cardinality: int, n_actions: int, actions: Ints, now: Ints, then: Ints, pools: Pools | None = None) -> Smoothing:
    """Statistics of a variable in N rows; without ``pools``, each (action, current value) pair is a pool and outcomes are values.

    The unseen mass decreases with the number of rows as in Ewens' sampling formula, theta / (rows + theta). Theta has the best
    leave-one-out likelihood of the outcomes: it is large if many different outcomes follow a pair, and close to zero if the same
    outcomes recur.
    """
    size = n_actions * cardinality
    pair = actions * cardinality + now
    visits = np.bincount(pair, minlength=size).astype(np.float64)
    stayed = np.bincount(pair[now == then], minlength=size)
    persistence = np.where(visits > 0, stayed / np.maximum(visits, 1), 1.0)
    changes = np.bincount(then[now != then], minlength=cardinality) + 0.5
    base = changes / changes.sum()
    if cardinality == 2 or len(pair) == 0:
        return Smoothing(persistence, np.zeros(size), base)
    if pools is None:
        return Smoothing(persistence, _unseen_mass(np.arange(size), pair, then, base[then]), base)
    _, positives, times = np.unique(pools.positives, return_inverse=True, return_counts=True)
    share = (times + 0.5) / (times + 0.5).sum()
    return Smoothing(persistence, _unseen_mass(pools.of, pools.of[pair], positives, share[positives]), base)


def _unseen_mass(pool_of: Ints, pool: Ints, positives: Ints, base: Floats) -> Floats:
    """Probability of unseen outcomes after each pair.

    Args:
        pool_of: pool of each pair, int64 [pairs].
        pool: pool of each row, int64 [N].
        positives: outcome of each row, int64 [N].
        base: probability of that outcome without any data, [N].
    """
    visits = np.bincount(pool, minlength=int(pool_of.max()) + 1).astype(np.float64)
    _, first, times = np.unique(pool * (int(positives.max()) + 1) + positives, return_index=True, return_counts=True)
    n, c, likely = visits[pool[first]], times.astype(np.float64), base[first]

    def log_probs(theta: float) -> float:
        again = np.where(c > 1, np.log(np.maximum(c - 1, 1)), np.log(theta * likely))
        return float((c * (again - np.log(n - 1 + theta))).sum())

    theta = max(THETAS, key=log_probs)
    return np.asarray(theta / (np.maximum(visits, 1.0) + theta))[pool_of]


SURE_GAIN = 5.0
"""Standard errors by which the slope of an operand must differ from zero."""

MOST_LOOKED_AT = 5000
"""Maximum number of rows in the regression for operands."""

MOST_CANDIDATES = 200
"""Maximum number of ordered factors and action components; with more, no operands are searched for."""

MOST_NODES = 50_000
"""Maximum number of nodes for a sum with an operand: its values times the factor's, times the number of different residuals."""


@dataclass(frozen=True)
class Operand:
    """Second operand of a sum: a factor, the action, or an action component.

    Attributes:
        cardinality: number of its values.
        factor: index of the factor, or -1.
        stride: of an action component: its value is ``action // stride % cardinality``.
        feature: index of the component's first feature among those of actions.
        whole: whether it is the action itself, which has no components.
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
        """Index of each value's feature, int64 [cardinality]."""
        if self.factor >= 0:
            own = (layout.factor == self.factor) & (layout.value == layout.top)
            return np.flatnonzero(own)[np.argsort(layout.value[own])]
        return len(layout.factor) + self.feature + np.arange(self.cardinality)


def candidates(cardinalities: Sequence[int], parts: Sequence[int]) -> list[Operand]:
    """Possible operands: all factors and action components with more than two values."""
    factors = [Operand(n, factor=f) for f, n in enumerate(cardinalities) if n > 2]
    features = enumerate(action_features(parts))
    return factors + [Operand(n, -1, stride, i, len(parts) == 1) for i, (stride, n, value) in features if n > 2 and value == 0]


def likely_operands(factors: Sequence[int], among: Sequence[Operand], rows: TransitionBatch) -> list[tuple[Operand, int] | None]:
    """Most significant operand of each factor's change, with the sign of its slope (1 or -1); None if none is significant.

    The slopes are those of a least-squares regression on all candidates together; significance is by t statistics.

    Args:
        factors: indices of the factors, themselves among the candidates.
        among: the candidate operands.
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
    residual = ((change - x @ slopes) ** 2).sum(axis=0) / (len(some) - len(among) - 1)
    t = slopes / np.sqrt(np.outer(np.diag(inverse), residual) + 1e-12)
    found: list[tuple[Operand, int] | None] = []
    for i, factor in enumerate(factors):
        own = [operand.factor == factor for operand in among]
        t[own, i] = 0.0
        best = int(np.abs(t[:, i]).argmax())
        likely = (among[best], int(np.sign(t[best, i]))) if abs(t[best, i]) > SURE_GAIN else None
        found.append(likely if likely and _entries(*likely, among[own.index(True)], some) <= MOST_NODES else None)
    return found


def _entries(operand: Operand, sign: int, factor: Operand, rows: TransitionBatch) -> int:
    """Upper bound on the nodes that a factor's sum with its operand needs; none if the operand is the whole action."""
    residual = rows.after[:, factor.factor].astype(np.int64) - factor.of(rows) - sign * operand.of(rows)
    return factor.cardinality * operand.cardinality * (len(np.unique(residual)) + 2) * (not operand.whole)


def chained(entries: Ints, features: Ints, add: Callable[[int, int, int], int], zero: int) -> Ints:
    """Chains of nodes, one for each (current value, next value), that select the node of the operand's value.

    Args:
        entries: (operand's value, current value, next value, node), int64 [N, 4].
        features: those of the operand's values.
        add: adds a node (feature, off, on) and returns its index.
        zero: node for values of the operand without an entry.

    Returns:
        (current value, next value, first node) of each chain, int64 [M, 3].
    """
    found: dict[tuple[int, int], int] = {}
    for operand, now, value, node in entries.tolist():
        found[now, value] = add(int(features[operand]), found.get((now, value), zero), node)
    return np.asarray([(now, value, node) for (now, value), node in found.items()], dtype=np.int64).reshape(-1, 3)


def for_all_actions(smoothing: Smoothing, n_operand: int, n_action_classes: int) -> Smoothing:
    """Converts smoothing of (operand's value, value) pairs to (action class, value) pairs."""
    persistence, unseen_mass = (
        np.tile(array.reshape(n_operand, -1).max(axis=0), n_action_classes)
        for array in (smoothing.persistence, smoothing.unseen_mass)
    )
    return replace(smoothing, persistence=persistence, unseen_mass=unseen_mass)


SELDOM = 1e-9
"""Persistence assumed for values that a sum can lead back to: the current value gets what the other values leave."""


class Effect(Enum):
    """Targets of a factor: the next value, its change, or its deviation from a sum or difference with an operand.

    Clipped sums and differences are limited to the factor's bounds before the random deviation is added; others are not.
    """

    ABSOLUTE = "goes"
    RELATIVE = "moves"
    SUM = "adds"
    DIFFERENCE = "takes"
    CLIPPED_SUM = "fills"
    CLIPPED_DIFFERENCE = "drains"

    def sum_of(self, values: Ints, actions: Ints, last: int) -> Ints:
        """Sums or differences of current values and operands, limited to 0 ... ``last`` if clipped."""
        sums = values + actions if self in (Effect.SUM, Effect.CLIPPED_SUM) else values - actions
        return np.clip(sums, 0, last) if self in (Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE) else sums


class EffectModel(NamedTuple):
    """An effect with the operand of its sum; None for the action class's index."""

    effect: Effect
    operand: Operand | None = None


ABSOLUTE_EFFECT = EffectModel(Effect.ABSOLUTE)
"""The targets are the next values."""

SUM_EFFECTS = (Effect.SUM, Effect.DIFFERENCE, Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE)
"""Effects that are sums or differences."""

SUM_ERRORS = 1.0
"""Standard errors by which a sum must improve held-out likelihood, since the numbers of actions may be arbitrary."""

ENOUGH_HELD_OUT, MOST_EFFECT_FOLDS = 1000, 6
"""Held-out rows that are enough to choose an effect; with fewer, further folds are held out, up to this number in all."""


def best_effect_models(
    log_probs: Callable[[Sequence[EffectModel]], Floats],
    n_factors: int,
    operands: Callable[[], Sequence[tuple[Operand, int] | None]],
) -> list[EffectModel]:
    """Effect of each of K factors with the best held-out likelihood; sums are tried only for unpredictable factors.

    Args:
        log_probs: log-probabilities of held-out next values under given effects of the factors, [N, K].
        n_factors: K.
        operands: the most significant operand of each factor, and whether it is added (1) or subtracted (-1).
    """
    logs, changes = (log_probs([effect_model] * n_factors) for effect_model in (ABSOLUTE_EFFECT, EffectModel(Effect.RELATIVE)))
    relative = (changes - logs).sum(axis=0) > 0.0
    best, logs = [EffectModel(Effect.RELATIVE) if r else ABSOLUTE_EFFECT for r in relative], np.where(relative, changes, logs)
    random = np.flatnonzero(logs.mean(axis=0) < PERFECT_LOG_PROB).tolist()
    likely = operands() if random else []
    if not any(likely[i] for i in random):
        return best
    rounds = [
        [_sum_effect(effects, *one) if one else usual for one, usual in zip(likely, best, strict=True)]
        for effects in ((Effect.SUM, Effect.DIFFERENCE), (Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE))
    ]
    sums = np.stack([log_probs(effect_models) for effect_models in rounds])
    for i in random:
        most = int(sums[:, :, i].mean(axis=1).argmax())
        if better(sums[most, :, i], logs[:, i], SUM_ERRORS):
            best[i] = rounds[most][i]
    return best


def _sum_effect(effects: tuple[Effect, Effect], operand: Operand, sign: int) -> EffectModel:
    """The sum or difference with an operand; the whole action needs none, since it is part of every pair."""
    return EffectModel(effects[sign < 0], None if operand.whole else operand)


def more_folds(train: TransitionBatch, held_out: TransitionBatch) -> list[Bools]:
    """Further folds to hold out if there are too few held-out rows to choose an effect, bool [folds][N]."""
    if (n := len(train) // MOST_EFFECT_FOLDS) == 0:
        return []
    folds = min(MOST_EFFECT_FOLDS - 1, -(-(ENOUGH_HELD_OUT - len(held_out)) // n))
    return [np.arange(len(train)) // n == fold for fold in range(folds)]


def questions_for_effect(effect: Effect, variable: int, cardinality: int, n_actions: int, observed: Observed) -> list[Question]:
    """The questions about one variable under an effect; none if it never changes.

    Args:
        effect: the effect; variables of two values always have absolute effects.
        variable: its index.
        cardinality: number of its values.
        n_actions: number of action classes (or values of the operand), observed or not.
        observed: its transitions.
    """
    if effect is Effect.ABSOLUTE or cardinality == 2 or (observed.now == observed.then).all():
        return ask(variable, cardinality, observed)
    return (
        _sum_questions(effect, variable, cardinality, n_actions, observed)
        if effect in SUM_EFFECTS
        else _change_questions(variable, cardinality, observed)
    )


def _change_questions(variable: int, cardinality: int, observed: Observed) -> list[Question]:
    """Questions about each observed change of a variable, under the actions after which it was observed.

    They apply to all current values, observed or not. Changes are modulo the cardinality.
    """
    changes, questions = (observed.then - observed.now) % cardinality, []
    for change in np.unique(changes[changes > 0]):
        actions = np.unique(observed.actions[changes == change])
        rows = np.flatnonzero(np.isin(observed.actions, actions))
        every = (actions[:, None] * cardinality + np.arange(cardinality)).ravel()
        one = question(variable, changes[rows], int(change), cardinality, observed.select(rows), every)
        questions.append(replace(one, values=(every % cardinality + change) % cardinality))
    return questions


def _sum_questions(effect: Effect, variable: int, cardinality: int, n_actions: int, observed: Observed) -> list[Question]:
    """One question per deviation from the sum, inside the bounds; one per bound, conditioned on the sum.

    For the bounds, a sum that was never observed is replaced by the nearest observed one.
    """
    last, every = cardinality - 1, np.arange(n_actions * cardinality)
    sums, here = (
        effect.sum_of(*of, last) for of in ((every % cardinality, every // cardinality), (observed.now, observed.actions))
    )
    inside, questions = (observed.then > 0) & (observed.then < last), []
    for deviation in np.unique((observed.then - here)[inside]):
        rows = np.flatnonzero((here + deviation > 0) & (here + deviation < last))
        valid = (sums + deviation > 0) & (sums + deviation < last)
        one = question(variable, (observed.then - here)[rows], int(deviation), cardinality, observed.select(rows), every[valid])
        questions.append(_without_current_value(replace(one, values=sums[valid] + deviation), cardinality))
    known = np.unique(here)
    nearest = np.searchsorted((known[:-1] + known[1:]) / 2, sums)
    for bound in np.intersect1d((0, last), observed.then):
        one = question(variable, observed.then, int(bound), cardinality, observed, every, nearest)
        questions.append(_without_current_value(one, cardinality))
    return questions


def _without_current_value(one: Question, cardinality: int) -> Question:
    """The question without pairs that predict their current value, which gets the remaining probability."""
    other = one.pairs % cardinality != one.values
    return replace(one, values=one.values[other], pairs=one.pairs[other], context=one.context[other])


def smoothing_for_effect(effect: Effect, cardinality: int, n_actions: int, observed: Observed) -> Smoothing:
    """Smoothing of a variable under an effect; rows that the effect pools are counted together."""
    if effect is Effect.ABSOLUTE or cardinality == 2 or len(observed.now) == 0:
        return smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then)
    every = np.arange(n_actions * cardinality)
    if effect is Effect.RELATIVE:
        pools = Pools(every // cardinality, (observed.then - observed.now) % cardinality)
        return smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then, pools)
    value, last = every % cardinality, cardinality - 1
    sums, here = effect.sum_of(value, every // cardinality, last), effect.sum_of(observed.now, observed.actions, last)
    deviation, inside = observed.then - here, (observed.then > 0) & (observed.then < last)
    pools = Pools(np.zeros_like(every), np.where(inside, deviation - deviation.min(), np.ptp(deviation) + 1 + observed.then))
    smoothing = smoothing_of(cardinality, n_actions, observed.actions, observed.now, observed.then, pools)
    possible = np.isin(value - sums, deviation[inside]) & (value > 0) & (value < last)
    for bound in (0, last):
        possible |= (value == bound) & np.isin(sums, here[observed.then == bound])
    return replace(smoothing, persistence=np.where(possible, SELDOM, 0.0))
