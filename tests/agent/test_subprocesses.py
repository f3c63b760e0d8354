"""Environments in subprocesses: requests of the agent, and the state after one of them ends."""

import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from mbagent import ModelLearningAgent
from tests.worlds import Corridor

pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")  # forks are quick

LEARNED = r"The environment has no reward_fn, so the agent plans with a reward learned"


class Paid(Corridor):
    """A corridor with a reward function."""

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return (next_obs == self.n - 1).astype(float)


class Unpicklable(Paid):
    """A corridor whose bound methods cannot be pickled."""

    def __init__(self) -> None:
        super().__init__(limit=20)
        self.lock = threading.Lock()


class Anonymous(Corridor):
    """A corridor whose reward function has no name and so cannot be pickled."""

    def __init__(self) -> None:
        super().__init__(limit=20)
        self.reward_fn = lambda obs, action, next_obs: (next_obs == 4).astype(float)


class Breaking(Corridor):
    """A corridor in which one step raises an error or terminates its process."""

    def __init__(self, after: int, error: type[Exception] | None = ValueError) -> None:
        super().__init__(limit=20)
        self.left, self.error = after, error

    def step(self, action: int) -> Any:
        self.left -= 1
        if self.left == 0:
            if self.error is None:
                os._exit(3)
            raise self.error("the pump is broken")
        return super().step(action)


@pytest.fixture
def started() -> Iterator[list[SubprocVecEnv]]:
    """Vector environments that are closed at the end of the test."""
    made: list[SubprocVecEnv] = []
    yield made
    for env in made:
        for process in env.processes:
            process.kill()
            process.join()
        for remote in env.remotes:
            remote.close()


Start = Callable[..., VecEnv]


@pytest.fixture
def start(started: list[SubprocVecEnv]) -> Start:
    def starting(*makers: Callable[[], gym.Env[Any, Any]], method: str = "fork") -> VecEnv:
        started.append(SubprocVecEnv(list(makers), start_method=method))
        return started[-1]

    return starting


def agent_in(env: VecEnv, **kwargs: Any) -> ModelLearningAgent:
    return ModelLearningAgent("MctsPolicy", env, seed=0, model="tabular", **kwargs)


def goes_right(agent: ModelLearningAgent) -> bool:
    return bool((agent.predict(np.arange(4))[0] == 1).all())


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor])
def test_environments_without_reward_fn_are_learned_in_other_processes(wrap: Callable[[VecEnv], VecEnv], start: Start) -> None:
    def make() -> gym.Env[Any, Any]:
        return Corridor(limit=20)

    agent = agent_in(wrap(start(make, make)))
    with pytest.warns(UserWarning, match=LEARNED):
        agent.learn(400, log_interval=None)
    assert goes_right(agent)
    assert evaluate_policy(agent, VecMonitor(start(make, make)), n_eval_episodes=2) == (1.0, 0.0)


@pytest.mark.parametrize("make", [Paid, lambda: Monitor(Paid())])
def test_a_picklable_reward_fn_is_used(make: Callable[[], gym.Env[Any, Any]], start: Start) -> None:
    agent = agent_in(start(make, make)).learn(400, log_interval=None)
    assert agent.goals.source == "environment"
    assert goes_right(agent)


@pytest.mark.parametrize("make", [Unpicklable, Anonymous, lambda: Monitor(Unpicklable()), lambda: Monitor(Anonymous())])
def test_a_reward_fn_that_cannot_be_pickled_ends_no_process(make: Callable[[], gym.Env[Any, Any]], start: Start) -> None:
    agent = agent_in(start(make, make))
    with pytest.warns(UserWarning, match=r"reward_fn cannot be pickled.*reward=fn.* a reward learned"):
        agent.learn(400, log_interval=None)
    assert goes_right(agent)


def test_forkserver_processes_are_supported(start: Start) -> None:
    agent = agent_in(start(Anonymous, method="forkserver"))
    with pytest.warns(UserWarning, match="cannot be pickled"):
        agent.learn(100, log_interval=None)


@pytest.mark.parametrize("broken", [0, 1])
@pytest.mark.parametrize("error", [ValueError, None])
def test_a_process_that_ends_costs_no_step_that_was_recorded(
    broken: int, error: type[Exception] | None, start: Start, tmp_path: Path
) -> None:
    makers: list[Callable[[], gym.Env[Any, Any]]] = [lambda: Corridor(limit=20)] * 2
    makers[broken] = lambda: Breaking(150, error)
    agent = agent_in(start(*makers))
    with pytest.raises(RuntimeError, match=r"process of the SubprocVecEnv has ended.*learn\(0\).*set_env") as caught:
        agent.learn(1000, log_interval=None)
    assert isinstance(caught.value.__cause__, EOFError | ConnectionError)
    assert len(agent.experience.dataset) == 298
    with pytest.raises(RuntimeError, match="process of the SubprocVecEnv has ended"):
        agent.learn(10)
    with pytest.warns(UserWarning, match=LEARNED):
        agent.learn(0)
    assert goes_right(agent)
    agent.save(tmp_path / "kept.zip", include=["transitions"])
    with pytest.warns(UserWarning, match=LEARNED):
        agent.set_env(DummyVecEnv([lambda: Corridor(limit=20)] * 2))
    agent.learn(100, log_interval=None, reset_num_timesteps=False)
    assert len(agent.experience.dataset) == 398
    assert goes_right(agent)


def test_a_process_that_ends_before_the_first_step_is_named(start: Start) -> None:
    env = start(lambda: Corridor(limit=20))
    agent = agent_in(env)
    env.close()
    with pytest.raises(RuntimeError, match="process of the SubprocVecEnv has ended"):
        agent.learn(10)
    with pytest.raises(ValueError, match="there are none"):
        agent.learn(0)
    with pytest.raises(RuntimeError, match="process of the SubprocVecEnv has ended"):
        agent_in(env).learn(10)


@pytest.mark.parametrize("error", [ValueError, EOFError, BrokenPipeError])
def test_an_error_of_an_environment_in_this_process_passes_unchanged(error: type[Exception]) -> None:
    broken = Breaking(150, error)
    agent = agent_in(DummyVecEnv([lambda: broken]))
    with pytest.raises(error, match="the pump is broken"):
        agent.learn(1000, log_interval=None)
    assert len(agent.experience.dataset) == 149
    at = broken.at = 2  # a position that no reset produces
    with pytest.warns(UserWarning, match=LEARNED):
        agent.learn(0)
    assert broken.at == at
    assert goes_right(agent)
    agent.learn(
        50, log_interval=None, reset_num_timesteps=False
    )  # begins with a reset, so no transition starts at the old position
    rows = agent.experience.dataset.rows()
    assert len(rows) == 199
    assert rows.states[149, 0] == 0
    assert (abs(rows.states - rows.next_states) <= 1).all()
