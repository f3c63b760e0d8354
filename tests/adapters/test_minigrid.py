"""MiniGrid fully observed; skipped where the extra "minigrid" is missing."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mbagent import ModelLearningAgent
from mbagent.adapters.minigrid import make_minigrid, minigrid_factory

pytest.importorskip("minigrid")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_a_world_passes_gymnasiums_check_and_shows_the_whole_grid() -> None:
    env = make_minigrid("MiniGrid-Empty-5x5-v0")
    assert env.observation_space.shape == (5, 5, 3)
    check_env(env, skip_render_check=True)
    first, _ = pickle.loads(pickle.dumps(minigrid_factory("MiniGrid-Empty-5x5-v0")))().reset(seed=0)
    second, _ = env.reset(seed=0)
    np.testing.assert_array_equal(first, second)


def test_what_is_carried_is_shown() -> None:
    env = make_minigrid("MiniGrid-Fetch-5x5-N2-v0", carried=True)
    env.reset(seed=0)
    inner: Any = env.unwrapped
    before, *_ = env.step(inner.actions.left)
    inner.carrying = next(thing for thing in inner.grid.grid if thing is not None and thing.can_pickup())
    after, *_ = env.step(inner.actions.left)
    assert (before[-1, -1] != after[-1, -1]).any()
    np.testing.assert_array_equal(after[-1, -1], inner.carrying.encode())


def test_a_world_is_learned_with_the_values_met() -> None:
    env = make_minigrid("MiniGrid-Empty-5x5-v0")
    with pytest.warns(UserWarning, match="reward_fn"):
        agent = ModelLearningAgent("MctsPolicy", env, seed=0).learn(3000)
    assert max(agent.model.cardinalities) < 8
    obs, _ = env.reset(seed=1)
    for _ in range(20):
        action, _ = agent.predict(obs)
        obs, reward, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    assert terminated
    assert float(reward) > 0.9
