"""Visit counts, and exploration directed by them."""

import itertools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from mbagent import ModelLearningAgent
from mbagent.exploration.strategies import (
    EXPLORATIONS,
    MANY_STATES,
    START_NODE,
    DirectedExploration,
    Exploration,
    RandomExploration,
    VisitTable,
    Watching,
)
from mbagent.types import Ints

pytestmark = pytest.mark.filterwarnings("ignore:The environment has no reward_fn")

Step = Callable[[int, int], tuple[int, bool]]


def walk(explorer: Exploration, step: Step, n_steps: int, start: Callable[[], int], seed: int = 0) -> list[tuple[int, int]]:
    """(state, action) of every step of an exploration strategy in a small environment, over several episodes."""
    rng, at, taken = np.random.default_rng(seed), start(), []
    for _ in range(n_steps):
        here = np.array([[at]])
        action = explorer.act(here, rng)
        after, ended = step(at, int(action[0]))
        if isinstance(explorer, Watching):
            explorer.observe(here, action, np.array([[after]]), np.array([ended]))
        taken.append((at, int(action[0])))
        at = start() if ended else after
    return taken


def chain(n: int, right: Ints) -> Step:
    """One of two actions, different from cell to cell, moves on; the other one and the end of the chain terminate the episode."""
    return lambda at, action: (at + 1, at + 1 == n) if action == right[at] else (at, True)


@pytest.mark.parametrize("seed", range(3))
def test_a_chain_whose_end_random_actions_never_reach_is_explored_in_the_square_of_its_length(seed: int) -> None:
    n = 40
    world = chain(n, np.random.default_rng([seed, 1]).integers(2, size=n))
    directed = walk(DirectedExploration(2), world, n * n, lambda: 0, seed)
    assert len(set(directed)) == 2 * n
    assert max(walk(RandomExploration(2), world, n * n, lambda: 0, seed))[0] < n - 1  # random actions need about 2^40 steps


def test_episodes_are_ended_if_only_new_ones_reach_new_states() -> None:
    rng = np.random.default_rng(0)  # the room changes in new episodes only; one of ten begins in the second room

    def step(at: int, action: int) -> tuple[int, bool]:
        return at, action == 0

    visits = walk(DirectedExploration(3), step, 2000, lambda: int(rng.random() < 0.1))
    rare = np.mean([at == 1 for at, _ in visits])
    assert rare > 0.3  # random play ends episodes equally often in both rooms, so its share is a tenth


def test_counts_are_those_of_the_transitions_and_continue_in_a_second_learn() -> None:
    agent = ModelLearningAgent("MctsPolicy", gym.make("FrozenLake-v1"), seed=0, model="tabular")
    for _ in range(2):
        agent.learn(700, log_interval=None, reset_num_timesteps=False)
    rows = agent.transitions.rows()
    counts = np.zeros((16, 4), dtype=np.int64)
    np.add.at(counts, (rows.states[:, 0], rows.actions), 1)
    explorer = agent._explorer
    assert isinstance(explorer, DirectedExploration)
    assert explorer.table is not None
    np.testing.assert_array_equal(explorer.table.counts(np.arange(16)[:, None]), counts)
    assert explorer.table.pairs() == (counts > 0).sum()
    assert explorer.n_steps == 1400
    assert explorer.directed


class Rewarded(gym.Wrapper[Any, Any, Any, Any]):
    """Another reward for the same environment."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, _, terminated, truncated, info = self.env.step(action)
        return obs, float(7 * obs), terminated, truncated, info


def test_exploration_depends_on_the_seed_but_not_on_the_reward() -> None:
    def observed(wrap: Callable[[Any], Any]) -> tuple[Ints, Ints]:
        env = wrap(gym.make("FrozenLake-v1"))
        rows = ModelLearningAgent("MctsPolicy", env, seed=3, model="tabular").learn(600, log_interval=None).transitions.rows()
        return rows.states, rows.actions

    first = observed(lambda env: env)
    for other in (observed(lambda env: env), observed(Rewarded)):
        np.testing.assert_array_equal(first[0], other[0])
        np.testing.assert_array_equal(first[1], other[1])


def test_with_too_many_states_the_default_acts_as_random_exploration() -> None:
    explorer, rng = EXPLORATIONS["auto"](4), np.random.default_rng(0)
    assert isinstance(explorer, DirectedExploration)
    bits = np.random.default_rng(1).integers(2, size=(4000, 1, 20))
    for before, after in itertools.pairwise(bits):
        explorer.observe(before, explorer.act(before, rng), after, np.zeros(1, dtype=np.bool_))
    assert not explorer.directed
    drawn = explorer.act(bits[0], np.random.default_rng(5))
    np.testing.assert_array_equal(drawn, RandomExploration(4).act(bits[0], np.random.default_rng(5)))
    many = np.arange(2 * MANY_STATES)[:, None] + np.zeros((1, 20), dtype=np.int64)
    for part in np.array_split(many, 300):
        explorer.observe(part, np.zeros(len(part), dtype=np.int64), part + 1, np.zeros(len(part), dtype=np.bool_))
    assert explorer.table is None  # dropped permanently, with its memory


class Lights(gym.Env[Any, Any]):
    """A chain whose end random actions never reach, and lights that flicker independently of actions."""

    def __init__(self, n: int) -> None:
        self.n, self.right = n, np.random.default_rng(1).integers(2, size=n)
        self.observation_space = gym.spaces.MultiDiscrete([n] + [2] * 10)
        self.action_space = gym.spaces.Discrete(2)

    def shown(self) -> Ints:
        return np.concatenate([[self.at], self.np_random.integers(2, size=10)])

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = 0
        return self.shown(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at = self.at + 1 if action == self.right[self.at] else 0
        over = self.at == self.n
        self.at %= self.n
        return self.shown(), 0.0, over, False, {}


@pytest.mark.parametrize("copies", [1, 3])
def test_distractors_do_not_prevent_directed_exploration(copies: int, tmp_path: Any) -> None:
    n = 20
    envs = DummyVecEnv([lambda: Lights(n)] * copies)
    agent = ModelLearningAgent("MctsPolicy", envs, seed=0, model="tabular", reward=lambda *_: np.zeros(len(_[1])))
    pairs = set()
    for _ in range(2):  # the second call continues the first
        rows = agent.learn(1000, log_interval=None, reset_num_timesteps=False).transitions.rows()
    pairs = {(int(at), int(action)) for at, action in zip(rows.states[:, 0], rows.actions, strict=True)}
    assert len(pairs) == 2 * n
    explorer = agent._explorer
    assert isinstance(explorer, DirectedExploration)
    assert explorer.directed
    assert explorer.view is not None
    np.testing.assert_array_equal(explorer.view.factors, [0])
    assert explorer.table is not None
    assert len(explorer.table) == n
    again = DirectedExploration(2, few=True)  # the same state after recalling the transitions
    again.recall(rows)
    assert again.table is not None
    assert again.view is not None
    for place in range(n):
        some = np.array([[place]])
        np.testing.assert_array_equal(again.table.counts(some), explorer.table.counts(some))


def test_beyond_the_limit_of_values_none_are_kept_and_the_abstraction_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbagent.exploration.strategies.MANY_VALUES", 20_000)
    explorer, rng, right = EXPLORATIONS["auto"](2), np.random.default_rng(0), np.random.default_rng(1).integers(2, size=20)
    assert isinstance(explorer, DirectedExploration)
    state, tried = np.zeros((1, 11), dtype=np.int64), set()
    for _ in range(2000):
        action = explorer.act(state, rng)
        at = int(state[0, 0])
        tried.add((at, int(action[0])))
        after = np.concatenate([[(at + 1) % 20 if action[0] == right[at] else 0], rng.integers(2, size=10)])[None]
        explorer.observe(state, action, after, np.zeros(1, dtype=np.bool_))
        state = after
    assert explorer._kept is None
    assert explorer.directed
    assert len(tried) == 40


def test_environments_in_the_same_state_try_different_actions() -> None:
    table = VisitTable(4)
    nodes = table.add(np.zeros((4, 2), dtype=np.int64))
    assert sorted(table.choose(nodes, np.random.default_rng(0).random((4, 4)))) == [0, 1, 2, 3]


def test_outcomes_are_counted_separately_as_the_table_grows() -> None:
    table, rng = VisitTable(2), np.random.default_rng(0)
    states, actions, after = rng.integers(300, size=5000), rng.integers(2, size=5000), rng.integers(5, size=5000)
    for part in np.array_split(np.arange(5000), 50):
        nodes, targets = table.add(states[part, None]), table.add(after[part, None])
        table.record(nodes, actions[part], np.where(after[part] == 0, START_NODE, targets))
    arrays, expected = table._arrays, np.zeros((300, 2, 5), dtype=np.int64)
    np.add.at(expected, (states, actions, after), 1)
    numbers = {START_NODE: 0} | {int(table.add(np.array([[k]]))[0]): k for k in range(1, 5)}
    for state in range(300):
        node = table.add(np.array([[state]]))[0]
        for action in range(2):
            found, outcome = np.zeros(5, dtype=np.int64), arrays.first[node, action]
            while outcome >= 0:
                found[numbers[int(arrays.target[outcome])]] += arrays.times[outcome]
                outcome = arrays.following[outcome]
            np.testing.assert_array_equal(found, expected[state, action])


def test_a_loaded_agent_counts_the_saved_transitions(tmp_path: Any) -> None:
    agent = ModelLearningAgent("MctsPolicy", gym.make("FrozenLake-v1"), seed=0, model="tabular").learn(500, log_interval=None)
    agent.save(tmp_path / "agent.zip", include=["transitions"])
    again = ModelLearningAgent.load(tmp_path / "agent.zip", env=gym.make("FrozenLake-v1")).learn(100, log_interval=None)
    assert isinstance(again._explorer, DirectedExploration)
    assert again._explorer.table is not None
    counts = again._explorer.table.counts(np.arange(16)[:, None])
    assert counts.sum() == again._explorer.n_steps == len(again.transitions) == 600


def test_several_environments_are_explored_together() -> None:
    envs = DummyVecEnv([lambda: gym.make("CliffWalking-v1", max_episode_steps=200)] * 4)
    agent = ModelLearningAgent("MctsPolicy", envs, seed=0, model="tabular", exploration="directed").learn(1000, log_interval=None)
    explorer = agent._explorer
    assert isinstance(explorer, DirectedExploration)
    assert explorer.table is not None
    assert explorer.table.pairs() == 37 * 4  # random actions have tried half of them by then
