"""Worlds whose rules are known in full: exact returns of any behaviour, without the luck of episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Floats
from worlds.rddl import RddlTables


@dataclass(frozen=True)
class Exact:
    """A world as tables.

    Attributes:
        observations: of its S states, [S, ...].
        going: probability of each next state where the episode goes on, float64 [S, A, S].
        rewards: expected, float64 [S, A].
        start: probability that an episode starts there, float64 [S].
        horizon: steps after which an episode is truncated.
    """

    observations: NDArray[Any]
    going: Floats
    rewards: Floats
    start: Floats
    horizon: int

    def best(self) -> float:
        """The best expected return, knowing how many steps are left."""
        values = np.zeros(len(self.start))
        for _ in range(self.horizon):
            values = (self.rewards + self.going @ values).max(axis=1)
        return float(self.start @ values)

    def random(self) -> float:
        """Expected return of uniformly random play."""
        return self._return_of(np.full(self.rewards.shape, 1.0 / self.rewards.shape[1]))

    def of(self, actions: NDArray[np.int64]) -> float:
        """Expected return of the behaviour that takes ``actions`` [S]."""
        return self._return_of(np.eye(self.rewards.shape[1])[actions])

    def _return_of(self, shares: Floats) -> float:
        """Expected return of a behaviour that takes actions with these probabilities [S, A]."""
        rewards = (shares * self.rewards).sum(axis=1)
        going = np.einsum("sa,san->sn", shares, self.going)
        values = np.zeros(len(self.start))
        for _ in range(self.horizon):
            values = rewards + going @ values
        return float(self.start @ values)


def exact_toy_text(env: gym.Env[Any, Any]) -> Exact:
    """A toy_text environment with a step limit, or another with tables like theirs, as tables.

    Where what is seen of a state is not its number, ``unwrapped.observations`` [S, ...] says what is.
    """
    inner: Any = env.unwrapped
    assert env.spec is not None
    assert env.spec.max_episode_steps is not None
    n_states, n_actions = len(inner.P), len(inner.P[0])
    going, rewards = np.zeros((n_states, n_actions, n_states)), np.zeros((n_states, n_actions))
    for state, action in np.ndindex(n_states, n_actions):
        for probability, following, reward, over in inner.P[state][action]:
            rewards[state, action] += probability * reward
            going[state, action, following] += probability * (not over)
    start = np.asarray(inner.initial_state_distrib, dtype=np.float64)
    observations = getattr(inner, "observations", np.arange(n_states))
    return Exact(observations, going, rewards, start, env.spec.max_episode_steps)


def exact_rddl(tables: RddlTables, horizon: int) -> Exact:
    """A tabulated RDDL domain."""
    start = np.zeros(len(tables.states))
    start[0] = 1.0
    return Exact(tables.states.astype(np.int8), tables.transitions(), tables.rewards, start, horizon)
