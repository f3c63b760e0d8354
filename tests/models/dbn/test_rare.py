"""Outcomes far below one percent take part in plans, with the probability estimated from counts; noise of the fit does not."""

import numpy as np
import pytest

from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.mdp import StateGraph
from tests.models.helpers import dataset

RISK = 0.004

Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def gearbox(n: int, n_coins: int, seed: int, ends: bool = True) -> Rows:
    """Gear 0 ... 2, whether it is broken, and coins that are drawn at every step; action 1 shifts up and may break it."""
    rng = np.random.default_rng(seed)
    gear, action = rng.integers(3, size=n), rng.integers(2, size=n)
    broken = (action == 1) & (rng.random(n) < RISK)
    before = np.column_stack([gear, np.zeros(n, dtype=np.int64), rng.integers(2, size=(n, n_coins))])
    after = np.column_stack([np.clip(gear + 2 * action - 1, 0, 2), broken, rng.integers(2, size=(n, n_coins))])
    return before, action, after, broken & ends


def learned(n_coins: int, **kwargs: bool) -> DecisionGraphModel:
    cardinalities = (3, 2) + (2,) * n_coins
    model = DecisionGraphModel(cardinalities, 2)
    model.fit(dataset(cardinalities, 2, *gearbox(15_000, n_coins, 0, **kwargs)))
    return model


def listed(model: DecisionGraphModel, state: list[int], n: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(states, terminated, probabilities) after each action, from the compiled kernel, which must agree with ``successors``."""
    graph = StateGraph(model)
    graph.expand(graph.add(np.array([state]), np.zeros(1, dtype=np.int64)), n, seed=3)
    found = model.successors(np.array([state, state]), np.arange(2), n, seed=3)
    parts = []
    for action in range(2):
        edges = slice(graph.first[0, action], graph.first[0, action] + graph.counts[0, action])
        span = slice(*found.offsets[action : action + 2])
        states, chances = graph.states[graph.next_nodes[edges]], graph.probabilities[edges]
        np.testing.assert_array_equal(states, found.states[span])
        np.testing.assert_allclose(chances, found.probabilities[span], atol=1e-12)
        parts.append((states, graph.terminated[edges], chances))
    return parts


@pytest.mark.parametrize("n_coins", [0, 6])
@pytest.mark.parametrize("ends", [True, False])
def test_observed_outcomes_are_listed_however_few_draws_there_are(n_coins: int, ends: bool) -> None:
    model = learned(n_coins, ends=ends)
    _, action, after, _ = gearbox(15_000, n_coins, 0)
    share = after[action == 1, 1].mean()
    for n in (4, 16):
        safe, risky = listed(model, [1, 0] + [0] * n_coins, n)
        assert not safe[0][:, 1].any()
        assert not safe[1].any()
        broken = risky[0][:, 1] == 1
        assert risky[2][broken].sum() == pytest.approx(share, rel=0.1)  # a posterior mean: near the share
        assert (risky[1] == (broken & ends)).all()
        assert risky[2].sum() == pytest.approx(1.0)


def test_unobserved_outcomes_are_not_listed() -> None:
    model = learned(0)
    safe, risky = listed(model, [2, 0], 16)
    assert safe[0].tolist() == [[1, 0]]
    assert risky[0].tolist() == [[2, 0], [2, 1]]


def test_rare_value_of_many_and_rare_persistence_are_listed() -> None:
    rng = np.random.default_rng(1)
    before = rng.integers(5, size=12_000)
    u = rng.random(12_000)
    after = np.where(u < 0.004, 0, np.where(u < 0.010, before, (before + 1) % 5))
    model = DecisionGraphModel((5,), 1)
    model.fit(dataset((5,), 1, before[:, None], np.zeros(12_000, dtype=np.int64), after[:, None], np.zeros(12_000, dtype=bool)))
    found = model.successors(np.array([[2]]), np.zeros(1, dtype=np.int64), 4, seed=0)
    chances = dict(zip(found.states[:, 0].tolist(), found.probabilities.tolist(), strict=True))
    own = before == 2
    assert chances == pytest.approx({k: (after[own] == k).mean() for k in (0, 2, 3)}, rel=0.35)
    assert set(chances) == {0, 2, 3}


def test_rare_resets_are_listed() -> None:
    rng = np.random.default_rng(5)
    n, bits = 20_000, 12
    before, action = rng.integers(2, size=(n, bits)), rng.integers(2, size=n)
    after = before.copy()
    after[np.arange(n), action] = 1
    reset = rng.random(n) < 0.004
    after[reset] = rng.integers(2, size=(reset.sum(), bits))
    model = DecisionGraphModel((2,) * bits, 2)
    report = model.fit(dataset((2,) * bits, 2, before, action, after, np.zeros(n, dtype=bool)))
    assert model.fitted.has_reset, report
    for chances in (part[2] for part in listed(model, [0, 1] * 6, 4)):
        assert chances.sum() == pytest.approx(1.0)
        assert 0.002 < chances[chances < 0.5].sum() < 0.008


@pytest.mark.parametrize("risk", [RISK, 0.0015])
def test_two_rare_changes_that_occur_together_are_one_outcome(risk: float) -> None:
    rng = np.random.default_rng(0)
    n = 15_000
    action = rng.integers(2, size=n)
    both = (action == 1) & (rng.random(n) < risk)
    before = np.column_stack([np.zeros((n, 2), dtype=np.int64), rng.integers(2, size=(n, 2))])
    after = np.column_stack([both, both, rng.integers(2, size=(n, 2))])
    model = DecisionGraphModel((2, 2, 2, 2), 2)
    model.fit(dataset((2, 2, 2, 2), 2, before, action, after, np.zeros(n, dtype=bool)))
    states, ends, chances = listed(model, [0, 0, 0, 0], 16)[1]
    assert not ends.any()
    assert (states[:, 0] == states[:, 1]).all()
    assert chances[states[:, 0] == 1].sum() == pytest.approx(both[action == 1].mean(), rel=0.1)
    drawn, _ = model.sample(np.zeros((4000, 4), dtype=np.int64), np.ones(4000, dtype=np.int64), np.random.default_rng(1))
    assert (drawn[:, 0] == drawn[:, 1]).all()
