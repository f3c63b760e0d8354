"""An environment as a model of itself, compared with the table of its rules."""

import gymnasium as gym
import numpy as np
import pytest

from mbagent.models.tabular import toy_text_model
from worlds.snapshots import DRAWS, SnapshotModel


def test_outcomes_are_those_of_the_rules() -> None:
    env = gym.make("FrozenLake-v1", map_name="4x4")
    tried, (known, _) = SnapshotModel(env), toy_text_model(env)
    np.testing.assert_array_equal(tried.start_states(10), [[0]])
    states, actions = np.zeros((4, 1), dtype=np.int64), np.arange(4)
    found, truth = tried.successors(states, actions, 1, 0), known.successors(states, actions, 100, 0)
    for row in range(4):
        mine, theirs = (
            {int(s.states[i, 0]): s.probabilities[i] for i in range(s.offsets[row], s.offsets[row + 1])} for s in (found, truth)
        )
        assert mine.keys() == theirs.keys()
        for state, p in theirs.items():
            assert abs(mine[state] - p) < 5 * np.sqrt(p * (1 - p) / DRAWS) + 1e-12
    logs = tried.log_prob(states[found.rows], actions[found.rows], found.states, found.terminated)
    np.testing.assert_allclose(np.exp(logs), found.probabilities)
    np.testing.assert_allclose(tried.marginals(states, actions).sum(axis=1), 1.0)
    drawn, over = tried.sample(states, actions, np.random.default_rng(0))
    assert not over.any()
    assert set(drawn[:, 0]) <= {0, 1, 4}
    assert (tried.reward(np.zeros(4, dtype=np.int64), actions, drawn[:, 0]) == 0.0).all()
    with pytest.raises(ValueError, match="never observed"):
        tried.successors(np.array([[15]]), np.array([0]), 1, 0)


def test_rewards_and_ends_are_those_met() -> None:
    env = gym.make("CliffWalking-v1", max_episode_steps=50)
    tried = SnapshotModel(env)
    at, path = np.array([[36]]), [0, *[1] * 11, 2]
    for action in path:
        found = tried.successors(at, np.array([action]), 1, 0)
        assert len(found.probabilities) == 1
        assert tried.reward(at[:, 0], np.array([action]), found.states[:, 0])[0] == -1.0
        at = found.states
    assert found.terminated[0]
    assert at[0, 0] == 47
