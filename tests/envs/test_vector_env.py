from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mbagent_envs import GameEnv, GameVectorEnv, InvalidActionError
from tests.envs.helpers import ID_ARGUMENTS, VARIANTS, Lottery

each_id = pytest.mark.parametrize("env_id", VARIANTS)
each_variant = pytest.mark.parametrize(("env_id", "arguments"), ID_ARGUMENTS)
MODES = list(AutoresetMode)


def pair(env_id: str, autoreset: AutoresetMode, **arguments: Any) -> tuple[gym.vector.VectorEnv, gym.vector.VectorEnv]:
    """Return this project's vector environment and Gymnasium's: three copies, episodes of seven steps."""
    arguments = {"num_envs": 3, "max_episode_steps": 7, **arguments}
    own = gym.make_vec(env_id, autoreset_mode=autoreset.value, **arguments)
    options = {"autoreset_mode": autoreset}
    sync = gym.make_vec(env_id, vectorization_mode="sync", vector_kwargs=options, **arguments)
    assert isinstance(own.unwrapped, GameVectorEnv)
    return own, sync


def assert_same(own: Any, sync: Any) -> None:
    if isinstance(sync, dict):
        assert own.keys() == sync.keys()
        for key in sync:
            assert_same(own[key], sync[key])
    elif isinstance(sync, tuple):
        assert len(own) == len(sync)
        for one, other in zip(own, sync, strict=True):
            assert_same(one, other)
    elif sync.dtype == object:
        assert [x is None for x in own] == [x is None for x in sync]
        for one, other in zip(own, sync, strict=True):
            np.testing.assert_array_equal(one, other)
    else:
        assert own.dtype == sync.dtype
        np.testing.assert_array_equal(own, sync)


@each_variant
@pytest.mark.parametrize("mode", MODES)
def test_copies_follow_the_single_environments(env_id: str, arguments: dict[str, Any], mode: AutoresetMode) -> None:
    own, sync = pair(env_id, mode, **arguments)
    assert own.metadata["autoreset_mode"] is mode
    for space in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(own, space) == getattr(sync, space)
    assert_same(own.reset(seed=11), sync.reset(seed=11))
    rng = np.random.default_rng(0)
    for t in range(1, 40):
        actions = rng.integers(own.single_action_space.n, size=3)  # type: ignore[attr-defined]
        result = own.step(actions)
        assert_same(result, sync.step(actions))
        if mode is AutoresetMode.DISABLED and result[3].any():
            mask = result[2] | result[3]
            assert_same(own.reset(options={"reset_mask": mask}), sync.reset(options={"reset_mask": mask.copy()}))
        if t == 20:
            assert_same(own.reset(), sync.reset())
    assert own.np_random_seed == sync.np_random_seed


def test_the_default_is_next_step_and_the_games_own_length() -> None:
    own = gym.make_vec("mbagent/Maneuverer-v0", num_envs=2)
    assert own.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    own.reset(seed=0)
    ends = [own.step(np.zeros(2, dtype=np.int64))[3].tolist() for _ in range(202)]
    assert [t + 1 for t, end in enumerate(ends) if end[0]] == [100, 201]  # one call of every 101 is the reset
    endless = gym.make_vec("mbagent/Maneuverer-v0", num_envs=2, max_episode_steps=-1)
    endless.reset(seed=0)
    assert not any(endless.step(np.zeros(2, dtype=np.int64))[3].any() for _ in range(150))


@pytest.mark.parametrize("mode", MODES)
def test_games_that_end_restart_at_the_right_time(mode: AutoresetMode) -> None:
    own = GameVectorEnv(Lottery(), num_envs=4, autoreset_mode=mode)
    sync = gym.vector.SyncVectorEnv(
        [lambda: gym.wrappers.TimeLimit(GameEnv(Lottery()), 50)] * 4,
        autoreset_mode=mode,
    )
    assert_same(own.reset(seed=0), sync.reset(seed=0))
    ended = 0
    for t in range(120):
        actions = np.array([1, 1, t % 2, 0])
        result = own.step(actions)
        assert_same(result, sync.step(actions))
        done = result[2] | result[3]
        ended += int(done.sum())
        if mode is AutoresetMode.DISABLED and done.any():
            with pytest.raises(gym.error.ResetNeeded, match="have ended"):
                own.step(actions)
            assert_same(own.reset(options={"reset_mask": done}), sync.reset(options={"reset_mask": done.copy()}))
    assert ended > 50


@each_id
def test_seeds_may_be_listed(env_id: str) -> None:
    own, sync = pair(env_id, AutoresetMode.NEXT_STEP)
    seeds: Any = [5, None, 3]
    obs, expected = own.reset(seed=seeds)[0], sync.reset(seed=seeds)[0]
    np.testing.assert_array_equal(obs[[0, 2]], expected[[0, 2]])
    with pytest.raises(ValueError, match="seed must be one integer or 3 of them"):
        own.reset(seed=[1, 2])  # type: ignore[arg-type]


@each_id
def test_copies_may_start_from_given_states(env_id: str) -> None:
    own, sync = pair(env_id, AutoresetMode.NEXT_STEP)
    own.reset(seed=0)
    states = [own.step(np.zeros(3, dtype=np.int64))[0] for _ in range(5)][-1]
    np.testing.assert_array_equal(own.reset(options={"state": states})[0], states)
    one = {"state": states[1]}
    assert_same(own.reset(seed=1, options=one), sync.reset(seed=1, options=one))
    assert_same(own.step(np.zeros(3, dtype=np.int64)), sync.step(np.zeros(3, dtype=np.int64)))
    with pytest.raises(ValueError, match="one observation or 3"):
        own.reset(options={"state": states[:2]})
    with pytest.raises(ValueError, match="not a state of"):
        own.reset(options={"state": np.zeros_like(states)})
    with pytest.raises(ValueError, match="reset has no option 'bogus'; its options are 'state', 'reset_mask'"):
        own.reset(options={"bogus": 1})
    with pytest.raises(ValueError, match="reset_mask"):
        own.reset(options={"reset_mask": np.zeros(3, dtype=np.bool_)})


@each_id
def test_returned_data_is_the_callers(env_id: str) -> None:
    own = gym.make_vec(env_id, num_envs=2)
    obs, _ = own.reset(seed=0)
    obs[:] = 1
    actions = np.zeros(2, dtype=np.int64)
    first = own.step(actions)[0]
    kept = first.copy()
    own.step(actions)
    np.testing.assert_array_equal(first, kept)
    own.reset(seed=0)
    np.testing.assert_array_equal(own.step(actions)[0], kept)


@each_id
def test_mistakes_are_named(env_id: str) -> None:
    own = gym.make_vec(env_id, num_envs=2)
    with pytest.raises(gym.error.ResetNeeded):
        own.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(gym.error.ResetNeeded):
        own.reset(options={"reset_mask": np.array([True, False])})
    own.reset(seed=0)
    for actions in (np.array([0, 9]), np.zeros(3, dtype=np.int64), np.zeros(2)):
        with pytest.raises(InvalidActionError, match="actions must be 2 integers"):
            own.step(actions)
    for arguments, error, message in (
        ({"num_envs": 0}, ValueError, "num_envs must be at least 1"),
        ({"max_episode_steps": 0}, ValueError, "max_episode_steps must be at least 1"),
        ({"render_mode": "human"}, ValueError, "shows one game"),
        ({"bogus": 1}, TypeError, "has no argument 'bogus'"),
        ({"autoreset_mode": "never"}, ValueError, "never"),
    ):
        with pytest.raises(error, match=message):
            gym.make_vec(env_id, **{"num_envs": 2, **arguments})  # type: ignore[arg-type]


@each_id
@pytest.mark.parametrize("render_mode", ["rgb_array", "ansi"])
def test_every_copy_is_drawn(env_id: str, render_mode: str) -> None:
    own, sync = pair(env_id, AutoresetMode.NEXT_STEP, render_mode=render_mode)
    with pytest.raises(gym.error.ResetNeeded):
        own.render()
    own.reset(seed=0)
    sync.reset(seed=0)
    pictures, expected = own.render(), sync.render()
    assert pictures is not None
    assert expected is not None
    assert len(pictures) == 3
    for one, other in zip(pictures, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    blind = gym.make_vec(env_id, num_envs=2)
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert blind.render() is None


def test_gymnasium_wrappers_count_episodes() -> None:
    envs = gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec("mbagent/FlierCatcher-v0", num_envs=2))
    envs.reset(seed=0)
    for _ in range(200):
        *_, infos = envs.step(np.ones(2, dtype=np.int64))
    assert infos["episode"]["l"].tolist() == [200, 200]
