"""Threads that share an agent: results are those of a single thread, and failed calls have no lasting effect."""

import copy
import pickle
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

from mbagent import LearnedEnv, ModelLearningAgent
from tests.worlds import Corridor

CATCHER = "mbagent/FlierCatcher-v0"
WAIT = 120.0
"""Seconds after which a running thread fails the test; far above the usual time."""


@pytest.fixture(scope="module")
def catcher() -> ModelLearningAgent:
    """An agent for an MDP that is too large to be solved completely."""
    env, kwargs = gym.make(CATCHER, height=4, width=6), {"max_states": 300, "lookahead_states": 60, "learn_values": False}
    agent = ModelLearningAgent("MctsPolicy", env, seed=0, num_simulations=32, policy_kwargs=kwargs)
    return agent.learn(800, log_interval=None)


@pytest.fixture
def busy() -> Iterator[None]:
    """Makes threads switch far more often than usual."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def observations(n: int) -> np.ndarray:
    env = gym.make(CATCHER, height=4, width=6)
    env.action_space.seed(0)
    return np.stack([env.reset(seed=0)[0]] + [env.step(env.action_space.sample())[0] for _ in range(n - 1)])


def together(*tasks: Callable[[], Any]) -> list[Any]:
    """Results of functions that run concurrently, each in a separate thread."""
    with ThreadPoolExecutor(len(tasks)) as pool:
        futures = [pool.submit(task) for task in tasks]
        return [future.result(WAIT) for future in futures]


def decided(agent: ModelLearningAgent, obs: np.ndarray) -> list[bytes]:
    """Values of all actions for each observation, as bytes."""
    return [agent.policy.plan(agent.policy.factored.encode(obs[i : i + 1])).values.tobytes() for i in range(len(obs))]


def bottom(obs: Any, action: Any, next_obs: Any) -> Any:
    return next_obs[:, 0, -1, 0]


@pytest.mark.usefixtures("busy")
def test_threads_get_the_decisions_of_one_thread_alone(catcher: ModelLearningAgent) -> None:
    obs = observations(8)
    alone, actions = decided(catcher, obs), [int(catcher.predict(one)[0]) for one in obs]
    found = together(*[lambda: (decided(catcher, obs), [int(catcher.predict(one)[0]) for one in obs])] * 4)
    assert all(each == (alone, actions) for each in found)


def arriving(at: int) -> Callable[[Any, Any, Any], Any]:
    return lambda obs, action, next_obs: (next_obs == at).astype(float)


@pytest.mark.usefixtures("busy")
def test_predict_during_set_reward_plans_for_one_goal_or_the_other() -> None:
    goals = [arriving(0), arriving(3)]
    agent = ModelLearningAgent("MctsPolicy", Corridor(limit=30), seed=0, model="tabular", reward=goals[0])
    agent.learn(400, log_interval=None)
    obs, right = np.arange(4), set()
    for goal in goals:
        agent.set_reward(goal)
        right.add((agent.policy.plan(obs[:, None]).values.tobytes(), agent.explain(2).values.tobytes()))

    def change() -> None:
        for turn in range(300):
            agent.set_reward(goals[turn % 2])

    def plan() -> set[bytes]:
        return {agent.policy.plan(obs[:, None]).values.tobytes() for _ in range(300)}

    def explain() -> set[bytes]:
        return {agent.explain(2).values.tobytes() for _ in range(10)}

    _, planned, explained = together(change, plan, explain)
    assert planned <= {plan for plan, _ in right}
    assert explained <= {explanation for _, explanation in right}


@pytest.mark.usefixtures("busy")
def test_predict_explain_and_save_during_learn(tmp_path: Any) -> None:
    agent = ModelLearningAgent("MctsPolicy", Corridor(limit=30), seed=0, model="tabular", reward=arriving(3))
    agent.learn(100, log_interval=None)

    def ask() -> None:
        for _ in range(20):
            assert agent.predict(np.arange(4))[0].shape == (4,)
            agent.explain(1)
            agent.save(tmp_path / "agent.zip", include=["transitions"])
            LearnedEnv(agent).reset(seed=0)

    together(lambda: agent.learn(1500, log_interval=None, reset_num_timesteps=False), ask)
    assert len(agent.transitions) == 1600
    alone = ModelLearningAgent("MctsPolicy", Corridor(limit=30), seed=0, model="tabular", reward=arriving(3))
    alone.learn(100, log_interval=None).learn(1500, log_interval=None, reset_num_timesteps=False)
    np.testing.assert_array_equal(agent.explain(1).values, alone.explain(1).values)


@pytest.mark.usefixtures("busy")
def test_environments_of_one_model_in_many_threads(catcher: ModelLearningAgent) -> None:
    def play() -> list[float]:
        env = LearnedEnv(catcher)
        env.reset(seed=3)
        return [float(env.step(step % 3)[1]) for step in range(40)]

    alone = play()
    *played, _ = together(play, play, play, lambda: decided(catcher, observations(3)))
    assert played == [alone] * 3


@pytest.mark.parametrize("call", [1, 2, 3, 5])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_interrupted_planning_leaves_no_partial_results_and_no_lock(
    error: type[BaseException], call: int, catcher: ModelLearningAgent
) -> None:
    agent, obs, calls = copy.deepcopy(catcher), observations(3), -1  # the first call is the test when the goal is set

    def once(obs: Any, action: Any, next_obs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise error
        return bottom(obs, action, next_obs)

    agent.set_reward(bottom)
    alone = decided(agent, obs)
    agent.set_reward(once)
    with pytest.raises((KeyboardInterrupt, RuntimeError)):
        decided(agent, obs)
    assert together(lambda: decided(agent, obs)) == [alone]


@pytest.mark.parametrize("call", [1, 2, 5, 20])
def test_interrupted_learning_of_values_is_started_again(call: int) -> None:
    kwargs = {"max_states": 5, "lookahead_states": 5}
    agent = ModelLearningAgent("MctsPolicy", Corridor(30, limit=60), seed=0, model="tabular", policy_kwargs=kwargs)
    obs, calls = np.arange(20, 25), -1

    def once(obs: Any, action: Any, next_obs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return arriving(29)(obs, action, next_obs)

    agent.set_reward(arriving(29))
    agent.learn(1500, log_interval=None)
    alone = decided(agent, obs)
    agent.set_reward(once)
    with pytest.raises(KeyboardInterrupt):
        decided(agent, obs)
    assert decided(agent, obs) == alone


def test_an_interrupted_fit_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = ModelLearningAgent("MctsPolicy", Corridor(limit=30), seed=0, reward=arriving(3), model="tabular")
    agent.learn(30, log_interval=None)
    before, alone = agent.get_parameters()["policy"], agent.explain(2).values
    fit = agent.model.fit

    def stopped(*args: Any, **kwargs: Any) -> None:
        fit(*args, **kwargs)
        raise KeyboardInterrupt

    def unchanged() -> bool:
        now = agent.get_parameters()["policy"]
        return all(before[name].equal(now[name]) for name in {**before, **now})

    monkeypatch.setattr(agent.model, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        agent.learn(400, log_interval=None)
    assert unchanged()
    np.testing.assert_array_equal(agent.explain(2).values, alone)
    monkeypatch.undo()
    agent.learn(0)
    assert len(agent.transitions) == 430
    assert not unchanged()


@pytest.mark.parametrize("use", ["predict", "explain", "set_reward"])
def test_a_reward_function_that_uses_the_planning_agent_raises_an_error(use: str, catcher: ModelLearningAgent) -> None:
    agent, obs, calls = copy.deepcopy(catcher), observations(1)[0], 0

    def nosy(before: Any, action: Any, after: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls > 1:
            getattr(agent, use)(bottom if use == "set_reward" else obs)
        return bottom(before, action, after)

    agent.set_reward(nosy)
    for ask in (agent.predict, agent.explain):
        with pytest.raises(RuntimeError, match="must not use the agent that is planning with it"):
            ask(obs)
    agent.set_reward(bottom)
    fresh = copy.deepcopy(catcher)
    fresh.set_reward(bottom)
    assert decided(agent, obs[None]) == decided(fresh, obs[None])


def test_copies_have_locks_of_their_own(catcher: ModelLearningAgent) -> None:
    obs = observations(2)
    with catcher.policy.lock:
        agent = copy.deepcopy(catcher)
        policy = pickle.loads(pickle.dumps(CloudpickleWrapper(catcher.policy))).var
        copied = together(lambda: decided(agent, obs), lambda: policy.predict(obs)[0])
    assert copied[0] == decided(catcher, obs)
    np.testing.assert_array_equal(copied[1], catcher.predict(obs)[0])
    assert copy.deepcopy(catcher.transitions).rows().actions.tolist() == catcher.transitions.rows().actions.tolist()
