from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import ModelLearningAgent
from mbagent.explain import REPEATS, Explanation
from mbagent.types import Floats, Ints
from mbagent_envs.drawing import draw_ansi
from mbagent_envs.flier_catcher import FlierCatcher
from tests.worlds import Corridor, TableWorld, optimal_q, random_table

POLICIES = ["MctsPolicy", "FlatMonteCarloPolicy", "ValueIterationPolicy"]
TABLE, REWARDS = random_table(5, 2, 4), np.array([0.0, 1.0, -1.0, 0.5, 2.0])


class KnownWorld(TableWorld):
    """A TableWorld with start states, so that it needs no learning."""

    def start_states(self, n: int) -> Ints:
        return np.arange(min(n, len(self.table)))[:, None]


def arrival(obs: Any, action: Any, next_obs: Any) -> Any:
    return REWARDS[next_obs]


def agent_for(policy: str, table: Floats = TABLE, **kwargs: Any) -> ModelLearningAgent:
    return ModelLearningAgent(policy, Corridor(len(table)), model=KnownWorld(table), reward=arrival, seed=0, gamma=0.9, **kwargs)


def flier_catcher(policy: str) -> ModelLearningAgent:
    return ModelLearningAgent(policy, gym.make("mbagent/FlierCatcher-v0"), seed=0).learn(1500, log_interval=None)


@pytest.mark.parametrize("policy", ["MctsPolicy", "ValueIterationPolicy"])
def test_a_solved_mdp_is_explained_by_its_exact_values(policy: str) -> None:
    why = agent_for(policy).explain(np.array(2))
    np.testing.assert_allclose(why.values, optimal_q(TABLE, REWARDS, 0.9)[2], atol=1e-4)
    assert why.mdp_states == 5
    assert why.visits.tolist() == why.errors.tolist() == [0.0, 0.0]  # neither simulations nor samples are used
    assert why.chosen[why.best] == 1.0
    assert "5 states" in why.table()


def test_an_exact_model_with_a_custom_goal_plans_without_learning() -> None:
    # Regression test: the goal was set before the planner had the model.
    exact = optimal_q(TABLE, REWARDS, 0.9)
    assert agent_for("MctsPolicy").predict(np.arange(5))[0].tolist() == exact.argmax(axis=1).tolist()


def test_futures_follow_the_best_policy_and_contain_its_rewards() -> None:
    best = optimal_q(TABLE, REWARDS, 0.9).argmax(axis=1)
    why = agent_for("MctsPolicy").explain(np.array(0), n_futures=4, n_steps=3)
    for action, futures in enumerate(why.futures):
        assert len(futures) == 4
        assert [f.probability for f in futures] == sorted((f.probability for f in futures), reverse=True)
        for future in futures:
            before, chosen, chance = 0, action, 1.0
            for step in future.steps:
                assert (step.action, step.reward) == (chosen, REWARDS[step.observation])
                assert step.probability == pytest.approx(TABLE[before, chosen, step.observation])
                before, chance = int(step.observation), chance * step.probability
                chosen = best[before]
            assert future.probability == pytest.approx(chance)


@pytest.mark.parametrize("policy", POLICIES)
def test_the_action_explained_is_the_action_taken_and_nothing_changes(policy: str) -> None:
    agent = agent_for(policy, policy_kwargs={"max_states": 1, "lookahead_states": 2})
    obs = np.arange(5)
    states = agent.policy.factored.encode(obs)
    before, whys = agent.policy.plan(states), [agent.explain(one) for one in obs]
    after = agent.policy.plan(states)
    np.testing.assert_array_equal(before.values, after.values)
    for i, why in enumerate(whys):
        assert why.best == int(agent.predict(obs[i])[0])
        np.testing.assert_array_equal(why.values, before.values[i])
        np.testing.assert_array_equal(why.visits, before.visits[i])
        same(why, agent.explain(obs[i]))


def same(one: Explanation, other: Explanation) -> None:
    for name in ("values", "errors", "chosen", "visits"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.futures == other.futures
    assert one.table() == other.table()


def test_the_standard_error_is_that_of_a_mean_of_simulations() -> None:
    # Each reward is 0 or 1 at random, so the discounted return of a simulation has a known variance.
    agent = agent_for("FlatMonteCarloPolicy", np.full((2, 2, 2), 0.5), num_simulations=200, horizon=8)
    why = agent.explain(np.array(0))
    expected = np.sqrt(0.25 * sum(0.81**k for k in range(8)) / 100)
    assert why.visits.tolist() == [100.0, 100.0]
    # The sample standard deviation of 8 normal numbers is within a factor of 2 with probability 0.99.
    assert (why.errors / expected > 0.5).all()
    assert (why.errors / expected < 2.0).all()
    assert why.chosen.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(why.chosen * REPEATS % 1.0, 0.0)
    assert [len(future.steps) for future in why.futures[0]] == [1, 1]


@pytest.mark.parametrize("policy", POLICIES)
def test_simulated_futures_can_be_drawn_by_the_game(policy: str) -> None:
    agent = flier_catcher(policy)
    game, obs = FlierCatcher(), gym.make("mbagent/FlierCatcher-v0").reset(seed=2)[0]
    why = agent.explain(obs)
    assert why.mdp_states == 0
    np.testing.assert_array_equal(why.observation, obs)
    pictures = [draw_ansi(game.scene(step.observation)) for future in why.futures[why.best] for step in future.steps]
    assert all("@" in picture for picture in pictures)
    for future in why.futures[why.best]:
        chain = [obs, *(step.observation for step in future.steps)]
        rows = game.check_observations(np.stack(chain))
        assert agent.observation_space.contains(future.steps[0].observation)
        rewards = game.reward(rows[:-1], np.array([step.action for step in future.steps]), rows[1:])
        assert rewards.tolist() == [step.reward for step in future.steps]


class Nested(Corridor):
    """The corridor with a nested observation and an action of two switches, one of which has no effect."""

    def __init__(self) -> None:
        super().__init__(4, limit=20)
        self.observation_space = spaces.Dict({"at": spaces.Discrete(4, start=5), "lamp": spaces.MultiBinary(2)})
        self.action_space = spaces.MultiBinary(2)

    def _seen(self) -> Any:
        return {"at": np.int64(5 + self.at), "lamp": np.array([self.at % 2, 1], dtype=np.int8)}

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        return self._seen(), *super().step(int(action[0]))[1:]


def test_parts_of_nested_observations_and_joint_actions_keep_their_form() -> None:
    def goal(obs: Any, action: Any, next_obs: Any) -> Any:
        return (next_obs["at"] == 8).astype(float)

    agent = ModelLearningAgent("MctsPolicy", Nested(), model="tabular", seed=0, reward=goal).learn(800, log_interval=None)
    obs = {"at": np.int64(5), "lamp": np.array([0, 1], dtype=np.int8)}
    why = agent.explain(obs)
    np.testing.assert_array_equal(why.actions, [[0, 0], [0, 1], [1, 0], [1, 1]])
    for step in why.futures[why.best][0].steps:
        assert agent.observation_space.contains(step.observation)
        assert agent.action_space.contains(step.action)
    assert "at: 6" in why.table()


def test_the_table_shows_the_best_actions_only() -> None:
    text = agent_for("MctsPolicy").explain(np.array(0)).table(n_actions=1)
    assert text.count("likeliest futures") == 1
    assert "<- taken" in text


def test_requests_that_cannot_be_explained_raise_an_error_of_one_sentence() -> None:
    agent = ModelLearningAgent("MctsPolicy", Corridor(), reward=arrival, seed=0)
    with pytest.raises(ValueError, match="learned nothing yet, so there is nothing to explain"):
        agent.explain(np.array(0))
    agent = agent_for("MctsPolicy")
    with pytest.raises(ValueError, match="takes one observation, got a batch"):
        agent.explain(np.array([0, 1]))
    with pytest.raises(ValueError, match="n_steps must be a whole number"):
        agent.explain(np.array(0), n_steps=0)
    with pytest.raises(ValueError, match="lies outside"):
        agent.explain(np.array(5))
    agent.policy.goal = None
    with pytest.raises(ValueError, match="set_reward"):
        agent.explain(np.array(0))
