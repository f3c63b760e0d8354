"""Toy MDPs of the benchmark."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from exact import toy_text_mdp
from worlds.registry import find_world
from worlds.toy_mdps import TableEnv, deep_sea, inventory


@pytest.mark.parametrize("name", ["Inventory", "DeepSea"])
def test_they_are_environments(name: str) -> None:
    env = find_world(name).make()
    check_env(env.unwrapped, skip_render_check=True)
    known = toy_text_mdp(env)
    states = list(known.observations)
    assert all(env.observation_space.contains(state) for state in states if np.ndim(state))
    returns = []
    for episode in range(300):
        env.reset(seed=episode)
        env.action_space.seed(episode)
        total, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    error = np.std(returns, ddof=1) / np.sqrt(len(returns))
    assert abs(np.mean(returns) - known.random_return()) < 5 * error
    assert known.optimal_return() > known.random_return() + 10 * error


def test_an_inventory_sells_what_is_there_and_no_more_than_is_asked_for() -> None:
    env = inventory(capacity=5, most=4, demand=2.0, start=1)
    for stock, order in np.ndindex(6, 5):
        outcomes = env.P[stock][order]
        assert sum(p for p, *_ in outcomes) == pytest.approx(1.0)
        assert [left for _, left, _, _ in outcomes] == list(range(min(stock + order, 5), -1, -1))
    p, left, reward, over = env.P[4][3][-1]  # all five go
    assert (left, over) == (0, False)
    assert reward == pytest.approx(6 * 5 - 3)
    assert p == pytest.approx(1 - np.exp(-2.0) * (1 + 2 + 2 + 8 / 6 + 16 / 24))


def test_in_deep_sea_only_steps_to_the_right_lead_to_the_treasure() -> None:
    known = toy_text_mdp(gym.make("mbagent/DeepSea-v0", size=6))
    assert known.optimal_return() == pytest.approx(0.99)
    assert known.random_return() == pytest.approx(2.0**-6 - 6 * 0.5 * 0.01 / 6)
    slippery = toy_text_mdp(gym.make("mbagent/DeepSea-v0", size=6, slip=0.2))
    assert 0.8**6 - 0.01 < slippery.optimal_return() < 0.8**6
    env: TableEnv = deep_sea(4)
    seen, _ = env.reset(seed=0)
    for row in range(4):
        assert (seen.sum(), seen[row].sum()) == (1, 1)
        seen, _, over, _, _ = env.step(0)
    assert over
    assert seen.sum() == 0
