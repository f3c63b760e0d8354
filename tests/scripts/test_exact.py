import gymnasium as gym
import numpy as np
import pytest

from exact import optimal_q, toy_text_mdp


def test_frozen_lake_has_the_known_returns() -> None:
    lake = toy_text_mdp(gym.make("FrozenLake-v1", map_name="4x4", is_slippery=True))
    assert lake.optimal_return() == pytest.approx(0.744, abs=5e-4)
    assert lake.random_return() == pytest.approx(0.014, abs=5e-4)


def test_returns_of_policies_are_those_of_play() -> None:
    cliff = toy_text_mdp(gym.make("CliffWalking-v1", max_episode_steps=200))
    right = np.where(cliff.observations == 36, 0, np.where(cliff.observations % 12 == 11, 2, 1))  # along the cliff's edge
    assert cliff.optimal_return() == cliff.policy_return(right) == -13.0
    assert cliff.policy_return(np.zeros(48, dtype=np.int64)) == -200.0  # up, and against the border


def test_a_table_without_a_step_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="max_episode_steps"):
        toy_text_mdp(gym.make("CliffWalking-v1"))


@pytest.mark.parametrize("ends", [None, np.array([False, True])])
def test_discounted_values_solve_the_bellman_equation(ends: np.ndarray | None) -> None:
    rng = np.random.default_rng(0)
    successors, probabilities = np.tile([0, 1], (2, 3, 1)), rng.dirichlet([1.0, 1.0], size=(2, 3))
    rewards = np.array([0.5, 2.0])
    q = optimal_q(successors, probabilities, rewards, ends, gamma=0.9)
    following = q.max(axis=1) * (1.0 if ends is None else ~ends)
    np.testing.assert_allclose(q, probabilities @ (rewards + 0.9 * following), rtol=1e-12)
