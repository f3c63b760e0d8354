"""Errors of an environment are attributed to it in one sentence, and do not affect what was learned before."""

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import mbagent_envs  # noqa: F401  (registers the games)
from mbagent import ModelLearningAgent
from tests.worlds import Corridor

PAIR = spaces.Dict({"a": spaces.Discrete(5), "b": spaces.Discrete(5)})
TWO = spaces.Tuple((spaces.Discrete(5), spaces.Discrete(5)))


class Changed(Corridor):
    """A corridor with another space and modified results."""

    def __init__(
        self,
        space: spaces.Space[Any] | None = None,
        show: Callable[[int], Any] = lambda at: at,
        reset: Callable[[Any], Any] = lambda returned: returned,
        step: Callable[[Any], Any] = lambda returned: returned,
    ) -> None:
        super().__init__(limit=20)
        self.observation_space = self.observation_space if space is None else space
        self.changes = show, reset, step

    def reset(self, **kwargs: Any) -> Any:
        obs, info = super().reset(**kwargs)
        return self.changes[1]((self.changes[0](obs), info))

    def step(self, action: int) -> Any:
        obs, *rest = super().step(action)
        return self.changes[2]((self.changes[0](obs), *rest))


def learned(env: Any) -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", env, reward=lambda obs, action, next_obs: np.zeros(len(action)), seed=0).learn(50)


@pytest.mark.parametrize(
    ("space", "show", "message"),
    [
        (spaces.Discrete(5, start=1), lambda at: at, r"holds the value 0, which lies outside Discrete\(5, start=1\) \(1 to 5\)"),
        (spaces.Discrete(3), lambda at: at, r"holds the value 3, which lies outside Discrete\(3\) \(0 to 2\)"),
        (spaces.MultiDiscrete([2, 3]), lambda at: np.array([0, at]), r"the value 3 at index \[1\], .* \(0 to 2\)"),
        (spaces.Box(0, 255, (1,), np.uint8), lambda at: np.array([255 + at]), r"the value 256 at index \[0\]"),
        (None, lambda at: np.array([at]), r"array\(\[0\]\) has one dimension more than Discrete\(5\)"),
        (None, lambda at: at + 0.5, r"holds the value 0\.5, but Discrete\(5\) has whole numbers only"),
        (None, lambda at: None, r"must be numbers of Discrete\(5\), got None"),
        (spaces.MultiBinary(3), lambda at: np.zeros(4, np.int8), r"has shape \(4,\), but MultiBinary\(3\) needs \(3,\)"),
        (PAIR, lambda at: {"a": at}, "lacks the key 'b'"),
        (PAIR, lambda at: {"a": at, "b": at, "c": 0}, "has the undeclared key 'c'"),
        (PAIR, lambda at: at, "must be a dict with the keys"),
        (TWO, lambda at: (at,), "must be a tuple of 2 parts"),
    ],
)
def test_observations_that_are_not_of_the_space_are_the_environments_mistake(
    space: spaces.Space[Any] | None, show: Callable[[int], Any], message: str
) -> None:
    with pytest.raises(ValueError, match=f"environment violates its own observation_space: the observation .*{message}.*; fix"):
        learned(Changed(space, show))


def test_observations_of_vector_environments_are_checked_too() -> None:
    with pytest.raises(ValueError, match=r"environment violates its own observation_space: .* value 3"):
        learned(DummyVecEnv([lambda: Changed(spaces.Discrete(3))]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"step": lambda r: (r[0], np.array([r[1]]), *r[2:])},
            r"step returned the reward array\(\[0\.\]\) instead of one number",
        ),
        ({"step": lambda r: (r[0], np.zeros(2), *r[2:])}, r"the reward array\(\[0\., 0\.\]\) instead of one number"),
        ({"step": lambda r: (r[0], None, *r[2:])}, "the reward None instead of one number"),
        ({"step": lambda r: (r[0], "x", *r[2:])}, "the reward 'x' instead of one number"),
        ({"step": lambda r: (*r[:4], None)}, "the info None instead of a dict"),
        ({"step": lambda r: r[:4]}, "step returned 4 values instead of Gymnasium's .observation, reward"),
        ({"reset": lambda r: r[0]}, "reset returned 0 instead of Gymnasium's .observation, info"),
    ],
)
def test_results_of_another_form_are_the_environments_mistake(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=f"The environment.*{message}.*; fix the environment"):
        learned(Changed(**changes))


def test_rewards_of_any_numeric_type_are_accepted() -> None:
    env = Changed(step=lambda r: (r[0], np.array(r[1], dtype=np.int64), *r[2:]))
    assert set(learned(env).transitions.rows().rewards) == {0.0, 1.0}


def test_transitions_before_an_error_are_kept() -> None:
    agent, env = learned(Corridor(limit=20)), Changed(step=lambda r: r if env.steps < 3 else r[:4])
    agent.set_env(env)
    with pytest.raises(TypeError, match="returned 4 values"):
        agent.learn(50)
    assert len(agent.transitions) == 52
    agent.set_env(Corridor(limit=20))
    assert len(agent.learn(10).transitions) == 62


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make_vec("mbagent/GeyserRunner-v0", num_envs=2), "vector environment of Gymnasium .*make_vec_env"),
        (lambda: gym.make_vec("FrozenLake-v1", num_envs=2, vectorization_mode="sync"), "SyncVectorEnv.*make_vec_env"),
        (lambda: Corridor, "env must be a Gymnasium environment, .* got <class"),
        (lambda: 5, "env must be a Gymnasium environment, .* got 5"),
    ],
)
def test_environments_that_sb3_does_not_support_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        ModelLearningAgent("MctsPolicy", make())


def test_normalized_observations_are_refused() -> None:
    env = VecNormalize(DummyVecEnv([lambda: Changed(spaces.Box(0, 9, (1,), np.int64), lambda at: np.array([at]))]))
    with pytest.raises(ValueError, match="norm_obs=False"):
        ModelLearningAgent("MctsPolicy", env)


class Walk(Corridor):
    """A corridor with a given ``reward_fn``."""

    def __init__(self, reward_fn: Any) -> None:
        super().__init__(limit=20)
        self.reward_fn = reward_fn


class Broken(Corridor):
    """A corridor whose ``reward_fn`` cannot be read."""

    @property
    def reward_fn(self) -> Any:
        raise RuntimeError("not before the first step")


class Helper(Corridor):
    """A corridor with an unrelated method called ``reward_fn``."""

    def reward_fn(self) -> float:
        return float(self.at == self.n - 1)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Helper(limit=20), r"cannot be used as a goal \(.* Helper.reward_fn takes \(\) -> float\)"),
        (Walk(0.5), r"cannot be used as a goal \(.* got 0\.5\)"),
        (Broken(limit=20), r"cannot be read \(RuntimeError: not before the first step\)"),
        (Walk(lambda *args: args[0].nothing), r"fails on its own observations \(AttributeError"),
        (Walk(lambda obs, action, next_obs: None), r"fails on its own observations \(TypeError: .*returned None"),
        (
            Walk(lambda obs, action, next_obs: float(next_obs[0] == 4)),
            r"fails on its own observations \(ValueError: .*one number for",
        ),
        (Walk(lambda obs, action, next_obs: next_obs * 1.0), r"differs from \d+ of the 300 rewards"),
        (Walk(None), "has no reward_fn"),
    ],
)
def test_a_reward_fn_that_is_no_reward_function_is_named_and_the_reward_is_learned(env: Corridor, message: str) -> None:
    agent = ModelLearningAgent("MctsPolicy", env, seed=0, model="tabular")
    with pytest.warns(UserWarning, match=f"The environment.*{message}.*, so the agent plans with a reward learned"):
        agent.learn(300, log_interval=None)
    assert agent.goals.source == "learned"
    assert int(agent.predict(np.array(3))[0]) == 1


class Seeker(Corridor):
    """An endless corridor with reward 1 at a cell, which can be changed; with or without a ``reward_fn``."""

    def __init__(self, knows: bool) -> None:
        super().__init__(limit=20)
        self.goal = 1
        if knows:
            self.reward_fn = lambda obs, action, next_obs: (next_obs == self.goal) * 1.0

    def set_goal(self, goal: int) -> None:
        self.goal = goal

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        obs, _, _, truncated, info = super().step(action)
        return obs, float(obs == self.goal), False, truncated, info


@pytest.mark.parametrize(("knows", "source"), [(False, "learned"), (True, "environment")])
def test_plans_follow_rewards_that_change_during_learning(knows: bool, source: str) -> None:
    agent = ModelLearningAgent("MctsPolicy", Seeker(knows), seed=0, model="tabular")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The environment has no reward_fn")
        agent.learn(1500, log_interval=None)
        assert int(agent.predict(np.array(2))[0]) == 0
        agent.get_env().env_method("set_goal", 3)  # type: ignore[union-attr]
        with pytest.warns(UserWarning, match=r"The environment's rewards changed after about 1,5\d\d steps.* set_env"):
            agent.learn(800, log_interval=None)
        assert int(agent.predict(np.array(2))[0]) == 1
        assert agent.goals.source == source
        agent.set_env(agent.get_env())  # type: ignore[arg-type]
        agent.learn(400, log_interval=None)  # earlier rewards are ignored, so there is no warning
    assert int(agent.predict(np.array(2))[0]) == 1
