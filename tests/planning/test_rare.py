"""Rare but decisive outcomes take part in plans and explanations; there is a warning if they cannot all be represented."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from mbagent import ModelLearningAgent
from mbagent.models.dbn import DecisionGraphModel
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner
from tests.models.helpers import dataset

GAMMA = 0.95


class Dam(gym.Env[Any, Any]):
    """A reservoir: at full level the reward is 3 per step and it may burst, at low level 2. Lamps, if any, flicker at random."""

    def __init__(self, p: float, loss: float, lamps: int = 0) -> None:
        self.p, self.loss, self.lamps = p, loss, lamps
        self.observation_space, self.action_space = spaces.MultiBinary(2 + lamps), spaces.Discrete(2)

    def _seen(self, full: int, burst: int) -> Any:
        return np.concatenate([[full, burst], self.np_random.integers(2, size=self.lamps)]).astype(np.int8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._seen(0, 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        burst = bool(action) and self.np_random.random() < self.p
        reward = -self.loss if burst else 3.0 if action else 2.0
        return self._seen(int(action), int(burst)), reward, burst, self.t >= 50, {}


def values_of(p: float, loss: float) -> tuple[float, float]:
    """Exact values of operation at low and full level, which are the same in all states."""
    low, full = 2.0 / (1.0 - GAMMA), (3.0 * (1.0 - p) - loss * p) / (1.0 - GAMMA * (1.0 - p))
    best = max(low, full)
    return 2.0 + GAMMA * best, (1.0 - p) * (3.0 + GAMMA * best) - p * loss


def learned(env: Any, policy: str, steps: int, **kwargs: Any) -> ModelLearningAgent:
    agent = ModelLearningAgent(policy, env, seed=0, gamma=GAMMA, **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the warning that the reward is learned
        return agent.learn(steps, log_interval=None)


@pytest.mark.parametrize("policy", ["MctsPolicy", "ValueIterationPolicy"])
@pytest.mark.parametrize(("p", "loss"), [(0.004, 900.0), (0.002, 3000.0), (0.003, 50.0)])
def test_a_loss_of_far_less_than_one_percent_decides_if_it_should(policy: str, p: float, loss: float) -> None:
    agent = learned(Dam(p, loss), policy, 12_000)
    rows = agent.transitions.rows()
    seen = float(rows.terminated[rows.actions == 1].mean())
    low, full = values_of(seen, loss)
    assert abs(full - low) > 0.1
    why = agent.explain(np.zeros(2, dtype=np.int8))
    assert why.best == int(full > low)
    assert why.values == pytest.approx([low, full], rel=0.05)
    (burst,) = why.rare[1]
    assert burst.probability == pytest.approx(seen, rel=0.1)
    assert burst.terminated
    assert burst.reward == pytest.approx(-loss, rel=1e-3)
    assert why.effects[1][0] == pytest.approx(burst.probability * (-loss - 3.0 - GAMMA * max(low, full)), rel=0.1)
    assert why.rare[0] == ()
    assert "rare" in why.table()


class LeakyTank(Dam):
    """The same on two planes: a mark cycles in the first; a burst is a cell of the second and terminates the episode."""

    def __init__(self, p: float, loss: float) -> None:
        super().__init__(p, loss)
        self.observation_space = spaces.MultiBinary((2, 5, 5))

    def _seen(self, full: int, burst: int) -> Any:
        planes = np.zeros((2, 5, 5), dtype=np.int8)
        planes[0, self.t % 5, 0], planes[1, 2, 3] = 1, burst
        return planes

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.t = 0
        return super().reset(seed=seed)


@pytest.mark.parametrize("loss", [900.0, 30.0])
def test_on_planes_a_rare_termination_has_the_cell_that_shows_it(loss: float) -> None:
    env = LeakyTank(0.004, loss)
    agent = learned(env, "MctsPolicy", 12_000)
    rows = agent.transitions.rows()
    low, full = values_of(float(rows.terminated[rows.actions == 1].mean()), loss)
    why = agent.explain(env.reset()[0])
    assert why.values == pytest.approx([low, full], rel=0.05)
    (burst,) = why.rare[1]
    assert burst.terminated
    assert np.asarray(burst.observation)[1, 2, 3] == 1


def test_a_rare_loss_among_flickering_lamps_is_seen_by_search() -> None:
    def reward(obs: Any, action: Any, after: Any) -> Any:
        return 2.0 + action - 2000.0 * after[:, 1]

    agent = learned(Dam(0.004, 2000.0, lamps=14), "MctsPolicy", 12_000, reward=reward)
    observations = np.random.default_rng(0).integers(2, size=(20, 16)).astype(np.int8)
    observations[:, :2] = 0
    assert agent.predict(observations)[0].tolist() == [0] * 20


def test_the_value_of_a_jackpot_of_less_than_one_percent_is_its_mean() -> None:
    class Bandit(gym.Env[Any, Any]):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(3)

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
            super().reset(seed=seed)
            self.t = 0
            return 0, {}

        def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
            self.t += 1
            reward = (1.0, 400.0 * (self.np_random.random() < 0.006), 0.0)[action]
            return 0, float(reward), False, self.t >= 20, {}

    agent = learned(Bandit(), "ValueIterationPolicy", 9000)
    rows = agent.transitions.rows()
    zeros = np.zeros((3, 1), dtype=np.int64)
    means = [rows.rewards[rows.actions == a].mean() for a in range(3)]
    assert agent.policy.reward_model(zeros, np.arange(3), zeros) == pytest.approx(means, abs=0.05)
    assert int(agent.predict(np.array(0))[0]) == 1


def blinking(n_bits: int) -> DecisionGraphModel:
    """Each bit is on after a step with probability 1%, independently of the state; the last one is switched on by action 1."""
    rng, n = np.random.default_rng(2), 4000
    action = rng.integers(2, size=n)
    after = (rng.random((n, n_bits)) < 0.01).astype(np.int64)
    after[:, -1] = action
    before = np.concatenate([np.zeros((1, n_bits), dtype=np.int64), after[:-1]])
    model = DecisionGraphModel((2,) * n_bits, 2)
    model.fit(dataset((2,) * n_bits, 2, before, action, after, np.zeros(n, dtype=bool)))
    return model


@pytest.mark.parametrize("n_bits", [3, 25])
def test_plans_warn_if_merged_rare_outcomes_may_be_decisive(n_bits: int) -> None:
    settings = PlannerSettings(n_samples=4, max_states=1, num_simulations=16, learn_values=False)
    planner, start = MctsPlanner(settings), np.zeros((1, n_bits), dtype=np.int64)
    planner.set_model(blinking(n_bits), start)
    planner.set_goal(lambda states, actions, after: 0.01 * after[:, -1] + after[:, :-1].sum(axis=1))
    if n_bits > 10:
        with pytest.warns(UserWarning, match="could change the choice of an action: raise n_samples"):
            planner.plan(start)
    for _ in range(2):  # at most one warning for each goal
        assert planner.plan(start).actions.tolist() == [1]
