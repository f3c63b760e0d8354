"""Small worlds with known answers, and helpers to run agents in them."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.data import TransitionDataset
from mbagent.models.base import BaseTransitionModel
from mbagent.models.fit_report import FitReport
from mbagent.models.protocol import Successors, as_keys
from mbagent.planning.planner import Planner
from mbagent.types import Floats, Ints, Randomness
from mbagent_envs.random_keys import uniforms


class TableWorld(BaseTransitionModel):
    """A known Markov decision process: ``table[s, a, s']``, one factor; ``ends`` marks terminated on arrival."""

    def __init__(self, table: Floats, ends: tuple[int, ...] = ()) -> None:
        super().__init__((table.shape[0],), table.shape[1])
        self.table, self.ends = table, np.isin(np.arange(len(table)), ends)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        return FitReport(len(data), 0, 0, 0.0)

    def sample(self, states: Ints, actions: Ints, rng: Randomness) -> tuple[Ints, NDArray[np.bool_]]:
        cumulated = self.table[states[:, 0], actions].cumsum(axis=1)
        luck = uniforms(as_keys(rng, len(states)), 1)
        following = np.minimum((luck >= cumulated).sum(axis=1), len(self.table) - 1)
        return following[:, None], self.ends[following]

    def successors(self, states: Ints, actions: Ints, n_samples: int, seed: int) -> Successors:
        p = self.table[states[:, 0], actions]
        rows, following = np.nonzero(p)
        offsets = np.concatenate([[0], np.cumsum((p > 0).sum(axis=1))]).astype(np.int64)
        return Successors(offsets, following[:, None], self.ends[following], p[rows, following])

    def marginals(self, states: Ints, actions: Ints) -> Floats:
        return self.table[states[:, 0], actions]

    def state_dict(self) -> dict[str, NDArray[Any]]:
        return {}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        assert not state


def random_table(n_states: int, n_actions: int, seed: int, branches: int = 3) -> Floats:
    """A random table with a few successors for each (state, action)."""
    rng = np.random.default_rng(seed)
    table = np.zeros((n_states, n_actions, n_states))
    for s, a in np.ndindex(n_states, n_actions):
        table[s, a, rng.choice(n_states, branches, replace=False)] = rng.dirichlet(np.ones(branches))
    return table


def optimal_q(table: Floats, rewards: Floats, gamma: float, ends: tuple[int, ...] = ()) -> Floats:
    """Exact values [S, A] for rewards on arrival [S], by long value iteration written another way than the library's."""
    going = ~np.isin(np.arange(len(table)), ends)
    q = np.zeros(table.shape[:2])
    for _ in range(6000):
        q = table @ (rewards + gamma * going * q.max(axis=1))
    return q


def arrival_goal(rewards: Floats) -> Callable[[Ints, Ints, Ints], Floats]:
    """Reward for the state arrived at."""
    return lambda states, actions, next_states: rewards[next_states[:, 0]]


def planner_for(
    planner: Planner, table: Floats, rewards: Floats, ends: tuple[int, ...] = (), start: tuple[int, ...] = (0,)
) -> Planner:
    """The planner with a table as its world, and rewards for arriving; without start states each root has its own machine."""
    planner.set_model(TableWorld(table, ends), np.array(start, dtype=np.int64)[:, None])
    planner.set_goal(arrival_goal(rewards))
    return planner


def prize_corridor(n: int = 12, prize: int = 9) -> tuple[Floats, Floats]:
    """A corridor, left and right, as (table, rewards for arriving): the prize lies ``prize`` steps from its left end."""
    table, rewards = np.zeros((n, 2, n)), np.zeros(n)
    for s in range(n):
        table[s, 0, max(s - 1, 0)] = table[s, 1, min(s + 1, n - 1)] = 1.0
    rewards[prize] = 1.0
    return table, rewards


class Corridor(gym.Env[Any, Any]):
    """Cells 0 ... n - 1; actions left and right; the right end terminates and pays 1. Without ``reward_fn``."""

    def __init__(self, n: int = 5, limit: int | None = None) -> None:
        self.n, self.limit = n, limit
        self.observation_space = spaces.Discrete(n)
        self.action_space = spaces.Discrete(2)
        self.at, self.steps = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.at, self.steps = 0, 0
        return self.at, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.at = int(np.clip(self.at + (1 if action == 1 else -1), 0, self.n - 1))
        self.steps += 1
        done = self.at == self.n - 1
        return self.at, float(done), done, self.limit is not None and self.steps >= self.limit, {}
