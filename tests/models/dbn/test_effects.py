"""Sums of a factor's value and the action's number, with random deviations, within bounds."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.dbn.effects import SUM_EFFECTS, Effect, questions_for_effect
from mbagent.models.dbn.features import Observed
from mbagent.types import Ints
from tests.models.helpers import dataset

LAST, ORDERS, DEMAND = 12, 6, 3.0
EVERY = np.stack(np.meshgrid(np.arange(LAST + 1), np.arange(ORDERS), indexing="ij"), axis=-1).reshape(-1, 2)


def following(effect: Effect, value: Ints, action: Ints, noise: Ints) -> Ints:
    """Next level of a stock that orders increase and random demand decreases, or of a queue with service and random arrivals."""
    stocks = effect in (Effect.SUM, Effect.CLIPPED_SUM)
    level = value + action if stocks else value - action
    if effect in (Effect.CLIPPED_SUM, Effect.CLIPPED_DIFFERENCE):  # the sum is clipped before the noise is added
        level = level.clip(0, LAST)
    after: Ints = np.clip(level - noise if stocks else level + noise, 0, LAST)
    return after


def transitions(n: int, effect: Effect) -> tuple[Ints, Ints, Ints]:
    """Random states [n, 1], actions [n] and next states [n, 1]."""
    rng = np.random.default_rng(0)
    value, action = rng.integers(LAST + 1, size=n), rng.integers(ORDERS, size=n)
    return value[:, None], action, following(effect, value, action, rng.poisson(DEMAND, n))[:, None]


def truth(effect: Effect) -> NDArray[np.float64]:
    """True distribution of the next value for every pair (value, action), [pairs, values]."""
    probs = np.zeros((len(EVERY), LAST + 1))
    for noise in range(60):
        after = following(effect, EVERY[:, 0], EVERY[:, 1], np.full(len(EVERY), noise))
        probs[np.arange(len(EVERY)), after] += stats.poisson.pmf(noise, DEMAND)
    return probs


@pytest.mark.parametrize("effect", SUM_EFFECTS)
@pytest.mark.parametrize(("n", "mean", "most"), [(500, 0.1, 0.5), (1500, 0.06, 0.15)])
def test_stocks_and_queues_are_learned_from_few_transitions(effect: Effect, n: int, mean: float, most: float) -> None:
    model = DecisionGraphModel((LAST + 1,), ORDERS)
    model.fit(dataset((LAST + 1,), ORDERS, *transitions(n, effect)))
    found = model.marginals(EVERY[:, :1], EVERY[:, 1])[:, : LAST + 1]
    distance = 0.5 * np.abs(found - truth(effect)).sum(axis=1)
    assert distance.mean() < mean  # 1,500 transitions are 19 of each pair; their frequencies have a distance of 0.2
    assert distance.max() < most


def test_arbitrary_numbers_of_actions_are_not_added() -> None:
    rng = np.random.default_rng(1)
    states, actions = rng.integers(9, size=(1500, 1)), rng.integers(5, size=1500)
    step = np.array([2, -1, 0, 1, -2])[actions] * rng.integers(2, size=1500)
    model = DecisionGraphModel((9,), 5)
    model.fit(dataset((9,), 5, states, actions, (states + step[:, None]) % 9))
    probs = model.marginals(np.repeat(np.arange(9), 5)[:, None], np.tile(np.arange(5), 9))[:, :9]
    moves = np.array([2, -1, 0, 1, -2])
    expected = np.zeros((45, 9))
    for i in range(45):
        expected[i, i // 5] += 0.5
        expected[i, (i // 5 + moves[i % 5]) % 9] += 0.5
    distance = 0.5 * np.abs(probs - expected).sum(axis=1)
    assert distance.mean() < 0.04  # the standard error of a rate from 300 coins is 0.03


def test_questions_of_sums_cover_every_value_but_the_current_one_once() -> None:
    now, actions, then = (part.ravel() for part in transitions(4000, Effect.SUM))
    pair = actions * (LAST + 1) + now
    questions = questions_for_effect(Effect.SUM, 0, LAST + 1, ORDERS, Observed(pair, actions, now, then))
    entries = np.concatenate([np.stack([question.pairs, question.values], axis=1) for question in questions])
    assert len(np.unique(entries, axis=0)) == len(entries)
    assert (entries[:, 0] % (LAST + 1) != entries[:, 1]).all()
    assert (entries[:, 1].min(), entries[:, 1].max()) == (0, LAST)
    observed = np.unique(np.stack([pair, then], axis=1)[now != then], axis=0)
    assert {tuple(row) for row in observed.tolist()} <= {tuple(row) for row in entries.tolist()}
    bound = [question for question in questions if len(np.unique(question.values)) == 1 and question.values[0] == 0][-1]
    assert bound.target.context.max() + 1 == LAST + ORDERS  # one for each sum
    assert (bound.target.positives.sum(), bound.target.counts.sum()) == ((then == 0).sum(), len(then))


def test_unobserved_orders_are_predicted_from_observed_ones() -> None:
    states, actions, after = transitions(5000, Effect.SUM)
    some = actions < ORDERS - 1
    model = DecisionGraphModel((LAST + 1,), ORDERS)
    model.fit(dataset((LAST + 1,), ORDERS, states[some], actions[some], after[some]))
    new = EVERY[EVERY[:, 1] == ORDERS - 1][: LAST - ORDERS]
    found = model.marginals(new[:, :1], new[:, 1])[:, : LAST + 1]
    distance = 0.5 * np.abs(found - truth(Effect.SUM)[EVERY[:, 1] == ORDERS - 1][: len(new)]).sum(axis=1)
    assert distance.max() < 0.15
