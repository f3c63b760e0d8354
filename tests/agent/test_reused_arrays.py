"""Environments that reuse their arrays and dicts are learned as if they returned new ones."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from mbagent import LearnedEnv, ModelLearningAgent

N = 3


def goal(obs: Any, action: Any, next_obs: Any) -> Any:
    return np.zeros(len(action))


class Switches(gym.Env[Any, Any]):
    """Turns on one switch per step; terminates when all are on. Its observations are arrays that reset overwrites."""

    def __init__(self, kind: str = "array", limit: int | None = None, copies: bool = False, infos: bool = False) -> None:
        self.on, self.count = np.zeros(N, np.int8), np.zeros(1, np.int64)
        self.info: dict[str, Any] = {}
        self.shown: Any
        self.limit, self.copies, self.infos = limit, copies, infos
        bits, number = spaces.MultiBinary(N), spaces.MultiDiscrete([N + 1])
        self.observation_space, self.shown = {
            "array": (bits, self.on),
            "dict": (spaces.Dict({"on": bits, "count": number}), {"on": self.on, "count": self.count}),
            "tuple": (spaces.Tuple((bits, number)), (self.on, self.count)),
            "replaced": (spaces.Dict({"on": bits}), {"on": self.on}),
        }[kind]
        self.kind, self.steps, self.action_space = kind, 0, spaces.MultiDiscrete([N])

    def show(self) -> Any:
        if self.kind == "replaced":
            self.shown["on"] = self.on.copy()  # the dict is reused, but not its array
        return self.on.copy() if self.copies else self.shown

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.on[:], self.count[:], self.steps = 0, 0, 0
        if self.infos:
            self.info.clear()
        return self.show(), self.info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.on[action[0]] = 1
        self.count[0], self.steps = self.on.sum(), self.steps + 1
        action[:] = 0  # the environment may modify the action's array during the step
        self.info["steps"] = self.steps
        return self.show(), 0.0, bool(self.on.all()), self.steps == self.limit, self.info if self.infos else {}


def learned(env: Any, steps: int = 300) -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", env, reward=goal, model="tabular", exploration="random", seed=0).learn(
        steps, log_interval=None
    )


def expected(states: Any, actions: Any) -> Any:
    after = states[:, :N].copy()
    after[np.arange(len(after)), actions] = 1
    return after


@pytest.mark.parametrize("kind", ["array", "dict", "tuple", "replaced"])
@pytest.mark.parametrize("limit", [None, 4])
def test_every_transition_is_recorded_as_it_was(kind: str, limit: int | None) -> None:
    agent = learned(Switches(kind, limit, infos=True))
    rows = agent.transitions.rows()
    first = agent.policy.factored.names.index("on[0]") if kind == "dict" else 0
    on, after = rows.states[:, first : first + N], rows.next_states[:, first : first + N]
    np.testing.assert_array_equal(after, expected(on, rows.actions))
    np.testing.assert_array_equal(rows.terminated, after.all(axis=1))
    assert rows.terminated.any()
    assert not on.all(axis=1).any()


def test_additional_wrappers_change_nothing() -> None:
    rows = learned(Monitor(gym.wrappers.TimeLimit(Switches(), 4))).transitions.rows()
    np.testing.assert_array_equal(rows.next_states, expected(rows.states, rows.actions))


def test_overwritten_last_observations_are_reported() -> None:
    with pytest.warns(UserWarning, match=r"All \d+ episodes so far ended with the observation .* obs\.copy"):
        learned(DummyVecEnv([Switches, lambda: Switches(limit=4)]))


def test_a_missing_last_observation_is_named() -> None:
    with pytest.raises(ValueError, match=r"without infos\[0\]\['terminal_observation'\]"):
        learned(DummyVecEnv([lambda: Switches(infos=True)]))


class Loop(gym.Env[Any, Any]):
    """Episodes of one step that end in a random one of n start states, as does the reset."""

    def __init__(self, n: int) -> None:
        self.observation_space, self.action_space = spaces.Discrete(n), spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        return self.draw(), {}

    def draw(self) -> int:
        return int(self.np_random.integers(int(self.observation_space.n)))  # type: ignore[attr-defined]

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
        return self.draw(), 0.0, True, False, {}


@pytest.mark.parametrize("make", [lambda: Switches(copies=True), lambda: Loop(1), lambda: Loop(2)])
def test_correct_vector_environments_are_not_reported(make: Any) -> None:
    assert len(learned(DummyVecEnv([make, make])).transitions) == 300  # warnings are errors here


class OneBuffer(VecEnvWrapper):
    """A vector environment that returns the same arrays at every step."""

    def reset(self) -> Any:
        first: Any = self.venv.reset()
        self.obs, self.rewards, self.dones = first.copy(), np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        return self.obs

    def step_wait(self) -> Any:
        step: Any = self.venv.step_wait()
        self.obs[:], _, self.dones[:], infos = step
        self.rewards[:] = self.obs.sum(axis=1)
        return self.obs, self.rewards, self.dones, infos


def test_buffers_of_vector_environments_are_copied() -> None:
    rows = learned(OneBuffer(DummyVecEnv([lambda: Switches(copies=True)] * 2))).transitions.rows()
    np.testing.assert_array_equal(rows.next_states, expected(rows.states, rows.actions))
    going = ~rows.terminated
    np.testing.assert_array_equal(rows.rewards[going], rows.next_states[going].sum(axis=1))


def test_a_learned_environment_returns_arrays_of_its_callers() -> None:
    env = LearnedEnv(learned(Switches()))
    first, _ = env.reset(seed=0)
    first[:] = 1
    second, _ = env.reset(seed=0)
    assert not second.any()
    after, *_ = env.step(np.array([1]))
    after[:] = 1
    np.testing.assert_array_equal(env.step(np.array([0]))[0], [1, 1, 0])
