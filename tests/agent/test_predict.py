"""Contract of ``predict`` and ``set_reward``: dependencies, invalidation of caches, and failing reward functions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import ModelLearningAgent
from mbagent.planning.planners import MctsPlanner
from tests.worlds import Corridor

CATCHER = "mbagent/FlierCatcher-v0"
POLICIES = ["MctsPolicy", "FlatMonteCarloPolicy", "ValueIterationPolicy"]


@pytest.fixture(scope="module")
def learned() -> dict[str, Any]:
    """Weights of an agent for an MDP that is too large to be solved completely."""
    return ModelLearningAgent("MctsPolicy", gym.make(CATCHER), seed=0).learn(1500, log_interval=None).get_parameters()


def catcher(policy: str, learned: dict[str, Any], **kwargs: Any) -> ModelLearningAgent:
    agent = ModelLearningAgent(policy, gym.make(CATCHER), seed=0, num_simulations=32, **kwargs)
    agent.set_parameters(learned)
    return agent


def observations(n: int = 6) -> np.ndarray:
    env = gym.make(CATCHER)
    env.action_space.seed(0)
    rows = [env.reset(seed=0)[0]]
    return np.stack(rows + [env.step(env.action_space.sample())[0] for _ in range(n - 1)])


def values(agent: ModelLearningAgent, obs: np.ndarray) -> np.ndarray:
    return agent.policy.plan(agent.policy.factored.encode(obs)).values


def top(obs: Any, action: Any, next_obs: Any) -> Any:
    """Reward for the first row."""
    return next_obs[:, 0, 0, 0]


def predict_each(agent: ModelLearningAgent, obs: np.ndarray) -> list[int]:
    return [int(agent.predict(one)[0]) for one in obs]


@pytest.mark.parametrize("policy", POLICIES)
def test_both_flags_and_any_history_give_the_same_action(policy: str, learned: dict[str, Any]) -> None:
    agent, obs = catcher(policy, learned), observations()
    first = [int(agent.predict(one, deterministic=True)[0]) for one in obs]
    backwards = [int(agent.predict(one, deterministic=False)[0]) for one in obs[::-1]]
    assert first == backwards[::-1]
    assert first == predict_each(catcher(policy, learned), obs)


class Failing:
    """Fails after a number of calls: during planning, but not when it is set."""

    def __init__(self, calls: int) -> None:
        self.calls = calls

    def __call__(self, obs: Any, action: Any, next_obs: Any) -> Any:
        self.calls -= 1
        if self.calls < 0:
            raise IndexError("no such column")
        return np.ones(len(action))


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("calls", [1, 2, 3])
def test_a_reward_that_fails_during_planning_is_named_and_has_no_lasting_effect(
    policy: str, calls: int, learned: dict[str, Any]
) -> None:
    if policy == "ValueIterationPolicy" and calls == 3:
        calls = 2  # it evaluates all transitions in one call, after the test call when the goal is set
    agent, obs = catcher(policy, learned), observations()
    failing = Failing(calls)
    agent.set_reward(failing)
    with pytest.raises(RuntimeError, match=r"reward function .*Failing.* raised IndexError \(no such column\)") as caught:
        predict_each(agent, obs)
    cause = caught.value.__cause__
    assert isinstance(cause, IndexError)
    traceback = cause.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    assert traceback is not None
    assert traceback.tb_frame.f_code.co_name == "__call__"  # the traceback contains the user's own line
    agent.set_reward(top)
    fresh = catcher(policy, learned, reward=top)
    np.testing.assert_array_equal(values(agent, obs), values(fresh, obs))
    agent.set_reward(None)
    np.testing.assert_array_equal(values(agent, obs), values(catcher(policy, learned), obs))


def test_a_reward_that_fails_immediately_is_refused_and_the_old_goal_is_kept(learned: dict[str, Any]) -> None:
    agent, obs = catcher("MctsPolicy", learned), observations(2)
    before = values(agent, obs)
    with pytest.raises(RuntimeError, match=r"reward function .*<lambda> raised IndexError"):
        agent.set_reward(lambda obs, action, next_obs: next_obs[:, 99])
    assert agent.goals.source == "environment"
    np.testing.assert_array_equal(values(agent, obs), before)


def test_new_weights_and_more_learning_are_planned_with() -> None:
    def goal(obs: Any, action: Any, next_obs: Any) -> Any:
        return (next_obs == 4).astype(float)

    def agent(**kwargs: Any) -> ModelLearningAgent:
        return ModelLearningAgent("MctsPolicy", Corridor(limit=30, **kwargs), seed=0, reward=goal, model="tabular")

    one, other = agent().learn(800, log_interval=None), agent().learn(2, log_interval=None)
    before = other.policy.plan(np.array([[0]])).values
    expected = one.policy.plan(np.array([[0]])).values
    other.policy.start_states = one.policy.start_states
    other.set_parameters(one.get_parameters())
    np.testing.assert_array_equal(other.policy.plan(np.array([[0]])).values, expected)
    assert not np.array_equal(before, expected)
    again = agent().learn(5, log_interval=None)
    again.policy.plan(np.array([[0]]))
    again.learn(800, log_interval=None, reset_num_timesteps=False)
    np.testing.assert_allclose(again.policy.plan(np.array([[0]])).values, expected, atol=1e-3)


class Switches(Corridor):
    """A nested observation and an action of two variables."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Dict({"at": spaces.Discrete(5), "flags": spaces.MultiBinary((2, 2))})
        self.action_space = spaces.MultiDiscrete([2, 3])

    def _seen(self) -> Any:
        return {"at": np.int64(self.at), "flags": np.full((2, 2), self.at % 2, dtype=np.int8)}

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        result = super().step(int(action[0]))
        return self._seen(), *result[1:]


def test_a_reward_function_gets_batches_in_the_spaces_own_layout_and_wide_integers() -> None:
    shapes: set[Any] = set()

    def goal(obs: Any, action: Any, next_obs: Any) -> Any:
        n = len(action)
        for seen in (obs, next_obs):
            assert set(seen) == {"at", "flags"}
            shapes.add((seen["at"].shape == (n,), seen["flags"].shape == (n, 2, 2), action.shape == (n, 2)))
            assert seen["at"].dtype == seen["flags"].dtype == action.dtype == np.int64
        # int8 would overflow here
        return next_obs["flags"].sum(axis=(1, 2)) * 100.0 + next_obs["at"]

    agent = ModelLearningAgent("MctsPolicy", Switches(), seed=0, model="tabular", reward=goal).learn(600, log_interval=None)
    action, _ = agent.predict({"at": np.array(2), "flags": np.zeros((2, 2), dtype=np.int8)})
    assert agent.action_space.contains(action)
    assert shapes == {(True, True, True)}


def test_actions_before_the_first_fit_are_valid_random_and_seeded() -> None:
    def actions(seed: int) -> list[list[int]]:
        agent = ModelLearningAgent("MctsPolicy", Switches(), seed=seed)
        obs: Any = {"at": np.arange(5), "flags": np.zeros((5, 2, 2), dtype=np.int8)}
        with pytest.warns(UserWarning, match="learned nothing yet") as caught:
            found = [agent.predict(obs)[0] for _ in range(6)]
        assert len(caught) == 1
        assert all(agent.action_space.contains(action) for batch in found for action in batch)
        return np.concatenate(found).tolist()  # type: ignore[no-any-return]

    assert actions(1) == actions(1) != actions(2)
    assert len({tuple(action) for action in actions(1)}) == 6


def test_rewards_that_differ_from_the_environments_reward_fn_are_learned() -> None:
    env = gym.wrappers.TransformReward(gym.make("mbagent/GeyserRunner-v0"), lambda reward: -float(reward))
    with pytest.warns(UserWarning, match=r"reward_fn differs from \d+ of the 1000 rewards observed"):
        agent = ModelLearningAgent("MctsPolicy", env, seed=0).learn(1000, log_interval=None)
    assert agent.goals.source == "learned"


def test_a_time_budget_is_saved_and_loaded(tmp_path: Path) -> None:
    agent = ModelLearningAgent("MctsPolicy", Corridor(), seed=0, time_budget=0.25)
    agent.save(tmp_path / "timed.zip")
    loaded = ModelLearningAgent.load(tmp_path / "timed.zip")
    assert loaded.time_budget == loaded.policy.settings.time_budget == 0.25
    assert ModelLearningAgent.load(tmp_path / "timed.zip", time_budget=None).policy.settings.time_budget is None


def test_a_kept_tree_is_dropped_at_episode_starts_and_with_goals(learned: dict[str, Any]) -> None:
    agent, obs = catcher("MctsPolicy", learned, policy_kwargs={"reuse_tree": True, "lookahead_states": 30}), observations(1)[0]
    planner = agent.policy.planner
    assert isinstance(planner, MctsPlanner)

    def decisions(change: Callable[[], Any], start: bool = False) -> int:
        """Age of the kept tree in decisions, after a change and one more decision."""
        change()
        agent.predict(obs, episode_start=np.array([start]))
        assert planner._last is not None
        return planner._last.decision

    assert [decisions(lambda: None) for _ in range(3)] == [0, 1, 2]
    assert decisions(lambda: None, start=True) == 0
    assert decisions(lambda: None) == 1
    assert decisions(lambda: agent.set_reward(top)) == 0
    assert decisions(lambda: agent.explain(obs)) == 1  # nor does an explanation affect it
    assert decisions(lambda: agent.set_parameters(learned)) == 0
    assert decisions(lambda: agent.predict(np.stack([obs, obs]))) == 0


@pytest.mark.parametrize(
    ("policy", "kwargs", "message"),
    [
        ("MctsPolicy", {"num_simulations": 0}, "num_simulations must be a whole number of at least 1"),
        ("MctsPolicy", {"horizon": 0}, "horizon must be a whole number of at least 1"),
        ("MctsPolicy", {"gamma": 1.5}, "gamma must lie between 0 and 1, both excluded, got 1.5: values of endless"),
        ("MctsPolicy", {"gamma": 0.0}, "gamma must lie between 0 and 1"),
        ("MctsPolicy", {"gamma": -0.5}, "gamma must be a finite number that is not negative"),
        ("MctsPolicy", {"time_budget": 0.0}, "time_budget must be a finite number of seconds above 0"),
        ("ValueIterationPolicy", {"time_budget": 1.0}, "time_budget is for policies that simulate"),
        ("MctsPolicy", {"policy_kwargs": {"reuse_tree": 1}}, "reuse_tree must be True or False"),
        ("FlatMonteCarloPolicy", {"policy_kwargs": {"reuse_tree": True}}, "reuse_tree is for the MctsPolicy"),
    ],
)
def test_planning_settings_out_of_range_are_refused(policy: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ModelLearningAgent(policy, Corridor(), **kwargs)


@pytest.mark.parametrize("wrong", ["a", None, {"a": 1}, [[1, 2], [3]]])
def test_non_numeric_observations_raise_an_error_of_one_sentence(wrong: Any) -> None:
    agent = ModelLearningAgent("MctsPolicy", gym.make("FrozenLake-v1"), seed=0)
    with pytest.raises(ValueError, match="must be numbers of Discrete"):
        agent.predict(wrong)
