"""MinAtar games as planes of bits; skipped where the extra "minatar" is missing."""

import pickle

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from mbagent.adapters.minatar import MinAtarEnv, make_minatar

pytest.importorskip("minatar")


def test_a_game_passes_gymnasiums_check_and_can_be_pickled() -> None:
    env = MinAtarEnv("breakout")
    check_env(env, skip_render_check=True)
    first, _ = pickle.loads(pickle.dumps(env)).reset(seed=3)
    second, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, second)
    assert env.observation_space.shape == (4, 10, 10)
    assert env.action_space == spaces.Discrete(3)


def test_history_is_shown_and_episodes_have_a_limit() -> None:
    env = make_minatar("breakout", k=1, max_episode_steps=3)
    assert env.observation_space.shape == (4 + 4 + 3, 10, 10)
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(3)] == [False, False, True]
    assert make_minatar("breakout", k=0).observation_space.shape == (4, 10, 10)


def test_an_unknown_game_is_named() -> None:
    with pytest.raises(ValueError, match="no game 'pong'"):
        MinAtarEnv("pong")
