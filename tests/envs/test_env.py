import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from mbagent_envs import GameEnv, InvalidActionError, Maneuverer
from mbagent_envs.random_keys import derive, draw_keys
from tests.envs.helpers import ID_ARGUMENTS, VARIANTS, Lottery

each_id = pytest.mark.parametrize("env_id", VARIANTS)
each_variant = pytest.mark.parametrize(("env_id", "arguments"), ID_ARGUMENTS)


def make(env_id: str, **arguments: Any) -> tuple[gym.Env[Any, Any], GameEnv]:
    env = gym.make(env_id, **arguments)
    inner = env.unwrapped
    assert isinstance(inner, GameEnv)
    return env, inner


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@each_variant
@pytest.mark.parametrize("render_mode", [None, "rgb_array", "ansi"])
def test_gymnasium_and_sb3_checkers_give_no_warning(env_id: str, arguments: dict[str, Any], render_mode: str | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(env_id, render_mode=render_mode, **arguments)
        gymnasium_check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env)
        sb3_check_env(env.unwrapped)
        env.close()


@each_id
def test_the_checkers_give_no_warning_about_windows(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(GameEnv.metadata, "render_fps", 1000)  # no waiting
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(env_id, render_mode="human")
        gymnasium_check_env(env.unwrapped)  # builds one environment for each render mode
        sb3_check_env(env)
        env.close()


@each_variant
def test_an_episode_is_determined_by_its_key(env_id: str, arguments: dict[str, Any]) -> None:
    env, inner = make(env_id, **arguments)
    game = inner.game
    obs, info = env.reset(seed=4)
    assert info == {}
    key = draw_keys(np.random.Generator(np.random.PCG64(4)), 1)  # as created by gymnasium.utils.seeding
    np.testing.assert_array_equal(obs, game.initial(derive(key, 0))[0])
    rng = np.random.default_rng(0)
    for t in range(1, game.max_episode_steps + 1):
        action = rng.integers(env.action_space.n)  # type: ignore[attr-defined]
        expected = game.transition(obs[None], np.array([action]), derive(key, t))
        next_obs, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(next_obs, expected[0])
        assert reward == inner.reward_fn(obs[None].astype(np.int64), np.array([action]), expected.astype(np.int64))[0]
        assert type(reward) is float
        assert terminated is False
        assert truncated is (t == game.max_episode_steps)
        obs = next_obs


def test_episodes_have_the_designed_lengths() -> None:
    lengths = {env_id: gym.spec(env_id).max_episode_steps for env_id in VARIANTS}
    assert list(lengths.values()) == [100, 100, 200]


@each_id
def test_unseeded_episodes_differ_and_returned_data_is_the_callers(env_id: str) -> None:
    env, _ = make(env_id)
    env.reset(seed=0)
    paths = []
    for _ in range(4):
        env.reset()
        path = [env.step(1)[0].copy() for _ in range(30)]
        paths.append(np.array(path).tobytes())
    assert len(set(paths)) == 4
    first, _ = env.reset(seed=1)
    first[:] = 1  # has no effect on the environment
    second = env.step(0)[0]
    env.reset(seed=1)
    np.testing.assert_array_equal(env.step(0)[0], second)


@each_id
def test_true_rules_are_available_without_changing_the_episode(env_id: str) -> None:
    env, inner = make(env_id)
    obs, _ = env.reset(seed=2)
    batch = np.repeat(obs[None], 50, axis=0)
    actions = np.arange(50) % len(inner.game.action_names)
    first = inner.transition(batch, actions, np.random.default_rng(5))
    np.testing.assert_array_equal(first, inner.transition(batch, actions.tolist(), np.random.default_rng(5)))
    following, probabilities = inner.transition_distribution(obs, 0)
    assert following.shape[1:] == obs.shape
    assert probabilities.sum() == pytest.approx(1)
    assert len(inner.reward_functions) >= 4
    after = env.step(0)[0]
    env.reset(seed=2)
    np.testing.assert_array_equal(env.step(0)[0], after)
    with pytest.raises(ValueError, match="observations must have shape"):
        inner.transition(obs, 0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="not a state of"):
        inner.transition(np.zeros_like(batch), actions, np.random.default_rng(0))
    with pytest.raises(InvalidActionError):
        inner.transition(batch, actions + 9, np.random.default_rng(0))
    with pytest.raises(ValueError, match="not a state of"):
        inner.transition_distribution(np.zeros_like(obs), 0)
    with pytest.raises(InvalidActionError):
        inner.transition_distribution(obs, 7)


@each_id
@pytest.mark.parametrize("action", [-1, 99, 0.5, "up", None, [0], True])
def test_a_wrong_action_is_one_clear_error_and_changes_nothing(env_id: str, action: Any) -> None:
    env, _ = make(env_id, disable_env_checker=True)
    env.reset(seed=0)
    with pytest.raises(InvalidActionError, match="actions must be 1 integer from 0 to") as caught:
        env.step(action)
    assert isinstance(caught.value, gym.error.InvalidAction)
    after = env.step(np.int64(1))[0]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(1)[0], after)


@each_id
def test_step_and_render_before_the_first_reset_raise_errors(env_id: str) -> None:
    env, inner = make(env_id, render_mode="ansi")
    for either in (env, inner):
        with pytest.raises(gym.error.ResetNeeded):
            either.step(0)
        with pytest.raises(gym.error.ResetNeeded):
            either.render()


@each_id
def test_an_episode_may_start_from_a_given_state(env_id: str) -> None:
    env, _ = make(env_id)
    env.reset(seed=0)
    for _ in range(20):
        state = env.step(0)[0]
    kept = state.copy()
    obs, _ = env.reset(seed=3, options={"state": state})
    np.testing.assert_array_equal(obs, kept)
    env.step(1)
    np.testing.assert_array_equal(state, kept)
    with pytest.raises(ValueError, match="not a state of"):
        env.reset(options={"state": np.zeros_like(state)})
    with pytest.raises(ValueError, match="reset has no option 'walls'; its options are 'state'"):
        env.reset(options={"walls": 3})
    env.reset(options={})


def test_a_refused_reset_leaves_the_episode_alone() -> None:
    env, _ = make("mbagent/FlierCatcher-v0")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="has no option"):
        env.unwrapped.reset(seed=99, options={"bogus": 1})
    after = env.step(1)[0]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(1)[0], after)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"wall_densty": 0.1},
            TypeError,
            "Maneuverer has no argument 'wall_densty'.*did you mean 'wall_density'",
        ),
        ({"bogus": 1}, TypeError, r"has no argument 'bogus' \(it takes size, wall_density\)"),
        ({"size": 1}, ValueError, "size must be at least 2"),
        ({"game": "Chess"}, ValueError, "there is no game 'Chess'; take one of GeyserRunner"),
        ({"game": "math:sqrt"}, ValueError, "there is no game"),
        ({"game": Maneuverer(), "size": 3}, TypeError, "go with a game's name or class"),
    ],
)
def test_unknown_and_impossible_arguments_are_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        gym.make("mbagent/Maneuverer-v0", **arguments)


def test_unknown_render_modes_are_named() -> None:
    with pytest.raises(ValueError, match="render_mode must be one of human, rgb_array, ansi or None"):
        GameEnv("Maneuverer", render_mode="svg")
    env = GameEnv("Maneuverer")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.render() is None


@each_variant
def test_specs_and_pickles_rebuild_the_environment(env_id: str, arguments: dict[str, Any]) -> None:
    env, inner = make(env_id, **arguments)
    assert env.spec is not None
    again = EnvSpec.from_json(env.spec.to_json()).make().unwrapped
    assert isinstance(again, GameEnv)
    assert repr(again.game) == repr(inner.game)
    env.reset(seed=0)
    copied = pickle.loads(pickle.dumps(inner))
    np.testing.assert_array_equal(copied.step(1)[0], env.step(1)[0])


@pytest.mark.parametrize("game", [Lottery(prize=3), Lottery, "tests.envs.helpers:Lottery"])
def test_any_game_becomes_an_environment_even_one_that_ends(game: Any) -> None:
    env = GameEnv(game) if isinstance(game, Lottery) else GameEnv(game, prize=3)
    env.reset(seed=0)
    for _ in range(100):
        _, reward, terminated, truncated, _ = env.step(1)
        assert truncated is False
        if terminated:
            break
    assert terminated is True
    assert reward == 3
