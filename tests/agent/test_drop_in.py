"""Agents in environments with many kinds of spaces."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import ModelLearningAgent
from mbagent.wrappers import Bits, Flat, History
from tests.worlds import Corridor


class Bytes(gym.ObservationWrapper[Any, Any, Any]):
    """A corridor with observations of bytes, or an image; only a few of the declared values ever occur."""

    def __init__(self, env: gym.Env[Any, Any], image: bool = False) -> None:
        super().__init__(env)
        self.image = image
        self.observation_space = spaces.Box(0, 255, (3, 5, 2) if image else (3,), dtype=np.uint8)

    def observation(self, observation: int) -> np.ndarray:
        if not self.image:
            return np.array([10 * observation, 7, 200 * (observation == 3)], dtype=np.uint8)
        shown = np.full((3, 5, 2), 3, dtype=np.uint8)
        shown[1, observation] = 10, 128
        return shown


class Converted(gym.ObservationWrapper[Any, Any, Any]):
    """A corridor with converted observations."""

    def __init__(self, space: spaces.Space[Any], form: Any) -> None:
        super().__init__(Corridor(limit=50))
        self.observation_space, self.form = space, form

    def observation(self, observation: int) -> Any:
        return self.form(observation)


def agent_for(env: gym.Env[Any, Any], steps: int = 400, **kwargs: Any) -> ModelLearningAgent:
    with pytest.warns(UserWarning, match="reward_fn"):
        return ModelLearningAgent("MctsPolicy", env, seed=0, **kwargs).learn(steps)


def goes_right(agent: ModelLearningAgent, env: gym.Env[Any, Any]) -> bool:
    obs, _ = env.reset(seed=0)
    for step in range(1, 5):
        action, _ = agent.predict(obs, deterministic=True)
        obs, _, terminated, _, _ = env.step(action)
        if terminated:
            return step == 4
    return False


NESTED = spaces.Dict({"a": spaces.Tuple((spaces.Discrete(5, start=-2), spaces.MultiBinary((2, 1)))), "b": spaces.Discrete(1)})
WORLDS: dict[str, Callable[[], gym.Env[Any, Any]]] = {
    "one number": lambda: Corridor(limit=50),
    "bytes": lambda: Bytes(Corridor(limit=50)),
    "image": lambda: Bytes(Corridor(limit=50), image=True),
    "one large number": lambda: Converted(spaces.Discrete(100_000), lambda at: at * 10_000),
    "bits": lambda: Bits(Converted(spaces.Discrete(5000, start=3), lambda at: at + 3)),
    "wide integers": lambda: Converted(
        spaces.Box(-(2**60), 2**60, (1,), dtype=np.int64), lambda at: np.array([(at - 2) * 10**15])
    ),
    "dict": lambda: Converted(
        spaces.Dict({"a": spaces.MultiDiscrete([2, 3], start=[4, 0]), "b": spaces.Discrete(1)}),
        lambda at: {"a": np.array([4 + at % 2, at // 2]), "b": 0},
    ),
    "tuple": lambda: Converted(spaces.Tuple((spaces.Discrete(2), spaces.Discrete(3))), lambda at: (at % 2, at // 2)),
    "nested": lambda: Flat(Converted(NESTED, lambda at: {"a": (at - 2, np.array([[at == 4], [0]], dtype=np.int8)), "b": 0})),
    "bytes with a past": lambda: History(Bytes(Corridor(limit=50)), 1),
}


@pytest.mark.parametrize("world", WORLDS)
def test_any_observation_space_is_learned_and_planned_on(world: str) -> None:
    env = WORLDS[world]()
    agent = agent_for(env)
    assert goes_right(agent, env)
    env.observation_space.seed(0)
    for _ in range(5):  # most of the declared values were never observed
        assert env.action_space.contains(int(agent.predict(env.observation_space.sample())[0]))


@pytest.mark.parametrize(
    ("space", "right"),
    [
        (spaces.Discrete(2, start=5), 6),
        (spaces.MultiDiscrete([2, 2]), np.array([1, 1])),
        (spaces.MultiBinary((1, 2)), np.array([[1, 1]])),
    ],
    ids=str,
)
def test_any_action_space_is_planned_with(space: spaces.Space[Any], right: Any) -> None:
    def act(action: Any) -> int:
        assert space.contains(action)
        return int(np.array_equal(action, right))

    env = gym.wrappers.TransformAction(Corridor(limit=50), act, space)
    assert goes_right(agent_for(env), env)


def test_nested_spaces_are_refused_with_a_solution() -> None:
    with pytest.raises(TypeError, match=r"mbagent\.wrappers\.Flat"):
        ModelLearningAgent("MctsPolicy", Converted(NESTED, lambda at: None))


def test_parts_of_one_name_are_refused() -> None:
    space = spaces.Dict({"a.b": spaces.Discrete(2), "a": spaces.Dict({"b": spaces.Discrete(2)})})
    with pytest.raises(ValueError, match=r"'a\.b'"):
        Flat(Converted(space, lambda at: None))
    with pytest.raises(TypeError, match="Discrete"):
        Bits(Converted(space, lambda at: None))


def test_digits_and_numbers_are_inverses() -> None:
    env = Bits(Converted(spaces.Discrete(5000, start=-7), lambda at: at))
    for number in (-7, 0, 4992):
        assert env.number(env.observation(number)) == number


@pytest.mark.parametrize("image", [False, True])
def test_values_first_observed_after_the_fit_are_replaced_by_the_nearest(image: bool) -> None:
    env = Bytes(Corridor(limit=50), image)
    agent = agent_for(env)
    obs, _ = env.reset(seed=0)
    strange = np.where(obs == obs.min(), obs + 1, obs).astype(np.uint8)
    action, _ = agent.predict(strange)
    assert env.action_space.contains(int(action))
    np.testing.assert_array_equal(agent.predict(strange)[0], agent.predict(obs)[0])
    assert len(agent.explain(strange).values) == 2


def test_values_observed_later_are_learned_later() -> None:
    env = Bytes(Corridor(n=3, limit=50))
    agent = agent_for(env)
    assert agent.model.cardinalities == (3, 1, 1)
    with pytest.warns(UserWarning, match="reward_fn"):
        agent.set_env(Bytes(Corridor(n=5, limit=50)))
    agent.learn(600)
    assert agent.model.cardinalities == (5, 1, 2)
    assert len(agent.transitions) == 1000
    assert goes_right(agent, Bytes(Corridor(limit=50)))


def test_observed_values_are_saved(tmp_path: Path) -> None:
    env = Bytes(Corridor(limit=50))
    agent = agent_for(env)
    agent.save(tmp_path / "agent.zip", include=["transitions"])
    loaded = ModelLearningAgent.load(tmp_path / "agent.zip", env=Bytes(Corridor(limit=50)))
    assert loaded.model.cardinalities == (5, 1, 2)
    assert goes_right(loaded, env)
    assert len(loaded.transitions) == 400
    fresh = ModelLearningAgent("MctsPolicy", env, seed=0, reward=lambda obs, action, next_obs: next_obs[:, 0] == 40)
    before = fresh.model
    wrong = {**agent.get_parameters()["policy"], "model.nonsense": np.zeros(1)}
    with pytest.raises(ValueError, match="nonsense"):
        fresh.set_parameters({"policy": wrong})
    assert fresh.model is before
    fresh.set_parameters(agent.get_parameters())
    obs, _ = env.reset()
    agent.set_reward(lambda obs, action, next_obs: next_obs[:, 0] == 40)
    np.testing.assert_array_equal(fresh.explain(obs).values, agent.explain(obs).values)


def test_goals_get_the_environments_own_values() -> None:
    seen: set[int] = set()

    def goal(obs: Any, action: Any, next_obs: Any) -> Any:
        seen.update(np.unique(next_obs[:, 0]).tolist())
        return next_obs[:, 0] == 40

    env = Bytes(Corridor(limit=50))
    agent = ModelLearningAgent("MctsPolicy", env, seed=0, reward=goal).learn(400)
    assert goes_right(agent, env)
    assert seen == {0, 10, 20, 30, 40}
    agent.set_reward(lambda obs, action, next_obs: next_obs[:, 0] == 0)
    obs, _ = env.reset()
    assert agent.predict(obs)[0] == 0
