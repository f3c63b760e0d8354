"""Rewards that change during learning are distinguished from random rewards."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.data import TransitionBatch
from mbagent.models.reward import LearnedReward
from mbagent.models.reward_changes import triples, turn, wrong_until
from mbagent.spaces import FactoredSpace
from tests.models.test_reward import pictures

SIZE = 10


def walk(n: int, reward: Callable[[int, int, np.random.Generator], float], episode: int = 50, seed: int = 0) -> TransitionBatch:
    """A random walk on a ring; ``reward`` of (step, cell arrived at, random numbers)."""
    rng = np.random.default_rng(seed)
    at, cells, actions = 0, np.zeros(n + 1, dtype=np.int64), rng.integers(0, 3, n)
    states = np.zeros(n, dtype=np.int64)
    for t in range(n):
        if t % episode == 0:
            at = int(rng.integers(SIZE))
        states[t] = at
        at = (at + int(actions[t]) - 1) % SIZE
        cells[t] = at
    after = cells[:n]
    rewards = np.array([reward(t, int(cell), rng) for t, cell in enumerate(after)])
    return TransitionBatch(
        states[:, None], actions, after[:, None], np.zeros(n, dtype=np.bool_), rewards, np.arange(n) // episode
    )


def learned(rows: TransitionBatch) -> tuple[Any, Any]:
    """The report, and the learned reward of staying at each cell."""
    model, cells = LearnedReward((SIZE,), 3), np.arange(SIZE)[:, None]
    report = model.fit(rows)
    return report, model(cells, np.ones(SIZE, dtype=np.int64), cells)


def at(*cells: int) -> Any:
    return np.isin(np.arange(SIZE), cells) * 1.0


@pytest.mark.parametrize(("old", "new", "episode"), [(2500, 500, 50), (1000, 2000, 50), (2500, 800, 10**6)])
def test_recent_rewards_replace_old_ones(old: int, new: int, episode: int) -> None:
    report, rewards = learned(walk(old + new, lambda t, cell, rng: float(cell == (3 if t < old else 7)), episode))
    assert report.since == pytest.approx(old, abs=20)
    assert (report.right, report.contrary) == (1.0, 0.0)
    np.testing.assert_array_equal(rewards, at(7))
    assert report.advice is not None
    assert "set_reward" in report.advice
    assert "set_env" in report.advice
    assert "random" not in report.advice


def test_the_last_of_several_changes_counts() -> None:
    report, rewards = learned(walk(3000, lambda t, cell, rng: float(cell == (3, 7, 5)[t // 1000])))
    assert report.since == pytest.approx(2000, abs=20)
    np.testing.assert_array_equal(rewards, at(5))


def test_rewards_that_were_not_observed_again_are_kept() -> None:
    def reward(t: int, cell: int, rng: np.random.Generator) -> float:
        return -10.0 * (cell == 9) + (cell == (3 if t < 2500 else 6))

    rows = walk(4500, reward)
    away = (rows.states[:, 0] != 9) & (rows.next_states[:, 0] != 9)
    _, rewards = learned(rows.select((np.arange(4500) < 2500) | away))
    np.testing.assert_array_equal(rewards, at(6) - 10.0 * at(9))


def test_random_rewards_that_do_not_change_are_learned_from_all() -> None:
    report, rewards = learned(walk(3000, lambda t, cell, rng: float(cell == 3 and rng.random() < 0.3)))
    assert report.since == 0
    np.testing.assert_allclose(rewards, 0.3 * at(3), atol=0.1)


@pytest.mark.parametrize("episode", [1, 20, 100])
@pytest.mark.parametrize("seed", range(5))
def test_variation_between_episodes_is_no_change(episode: int, seed: int) -> None:
    goals = np.random.default_rng(seed).choice([3, 7], 3000)
    rows = walk(3000, lambda t, cell, rng: float(cell == goals[t // episode]), episode, seed)
    assert turn(triples(rows), rows.rewards.astype(np.int64), rows.episodes) == 0


def test_random_rewards_change_too() -> None:
    report, rewards = learned(walk(4000, lambda t, cell, rng: float(cell == 3 and rng.random() < (0.2 if t < 2500 else 0.8))))
    assert report.since == pytest.approx(2500, abs=100)
    assert rewards[3] == pytest.approx(0.8, abs=0.1)


def test_many_rewards_change_too() -> None:
    report, rewards = learned(walk(4000, lambda t, cell, rng: -abs(cell - (3 if t < 3000 else 7)) + 0.01 * rng.normal()))
    assert report.since == pytest.approx(3000, abs=20)
    np.testing.assert_allclose(rewards, -abs(np.arange(SIZE) - 7), atol=0.2)


def test_transitions_that_never_recur_are_predicted_by_their_common_features() -> None:
    rows, planes = pictures(2000), FactoredSpace(spaces.MultiBinary((2, 5, 5))).planes
    model = LearnedReward((2,) * 50, 2, planes)
    report = model.fit(replace(rows, rewards=np.where(np.arange(2000) < 1000, rows.rewards, -rows.rewards)))
    assert report.since == pytest.approx(1000, abs=50)
    tests = pictures(300, 1)
    np.testing.assert_array_equal(model(tests.states, tests.actions, tests.next_states), -tests.rewards)


def test_rewards_observed_late_are_no_change() -> None:
    rows, planes = pictures(2000), FactoredSpace(spaces.MultiBinary((2, 5, 5))).planes
    late = rows.select(np.argsort(rows.rewards != 0, kind="stable"))
    assert LearnedReward((2,) * 50, 2, planes).fit(replace(late, episodes=rows.episodes)).since == 0


def test_a_reward_function_is_wrong_before_a_change_or_occasionally() -> None:
    rows = walk(3000, lambda t, cell, rng: 0.0)
    of_three, t = rows.next_states[:, 0] == 3, np.arange(3000)
    assert wrong_until(rows, of_three & (t < 2000)) == pytest.approx(2000, abs=50)
    assert wrong_until(rows, of_three & (t >= 2000)) is None
    assert wrong_until(rows, of_three & (np.random.default_rng(0).random(3000) < 0.3)) is None
    assert wrong_until(rows, of_three & (t < 2990)) is None
