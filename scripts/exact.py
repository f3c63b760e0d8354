"""Exact values of MDPs given as arrays: expected returns of whole episodes, and discounted action values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.types import Bools, Floats, Ints


@dataclass(frozen=True)
class FiniteHorizonMDP:
    """An MDP given as tables, with a step limit.

    Attributes:
        observations: observations of its S states, [S, ...].
        transitions: probability of each next state with the episode continuing, float64 [S, A, S].
        rewards: expected rewards, float64 [S, A].
        start: probability that an episode starts in each state, float64 [S].
        horizon: steps after which an episode is truncated.
    """

    observations: NDArray[Any]
    transitions: Floats
    rewards: Floats
    start: Floats
    horizon: int

    def optimal_return(self) -> float:
        """The highest expected return of a policy that knows the number of remaining steps."""
        return self._backward_induction(lambda values: (self.rewards + self.transitions @ values).max(axis=1))

    def random_return(self) -> float:
        """Expected return of uniformly random play."""
        return self._return_of(np.full(self.rewards.shape, 1.0 / self.rewards.shape[1]))

    def policy_return(self, actions: Ints) -> float:
        """Expected return of the policy that takes ``actions`` [S]."""
        return self._return_of(np.eye(self.rewards.shape[1])[actions])

    def _return_of(self, shares: Floats) -> float:
        """Expected return of a policy with these action probabilities [S, A]."""
        rewards = (shares * self.rewards).sum(axis=1)
        transitions = np.einsum("sa,san->sn", shares, self.transitions)
        return self._backward_induction(lambda values: rewards + transitions @ values)

    def _backward_induction(self, backup: Callable[[Floats], Floats]) -> float:
        """Expected return from the start; ``backup`` computes values [S] with n + 1 steps left from those with n."""
        values = np.zeros(len(self.start))
        for _ in range(self.horizon):
            values = backup(values)
        return float(self.start @ values)


def toy_text_mdp(env: gym.Env[Any, Any]) -> FiniteHorizonMDP:
    """A toy_text environment, or another one with the same kind of tables, as arrays.

    Args:
        env: an environment with ``unwrapped.P[state][action] -> [(probability, next state, reward, terminated)]`` and
            ``unwrapped.initial_state_distrib``. If an observation is not the state's number, ``unwrapped.observations``
            [S, ...] holds one for each state.

    Raises:
        ValueError: the environment has no step limit.
    """
    if env.spec is None or env.spec.max_episode_steps is None:
        raise ValueError("The environment has no step limit; give gym.make max_episode_steps.")
    inner: Any = env.unwrapped
    n_states, n_actions = len(inner.P), len(inner.P[0])
    transitions, rewards = np.zeros((n_states, n_actions, n_states)), np.zeros((n_states, n_actions))
    for state, action in np.ndindex(n_states, n_actions):
        for probability, following, reward, terminated in inner.P[state][action]:
            rewards[state, action] += probability * reward
            transitions[state, action, following] += probability * (not terminated)
    start = np.asarray(inner.initial_state_distrib, dtype=np.float64)
    observations = getattr(inner, "observations", np.arange(n_states))
    return FiniteHorizonMDP(observations, transitions, rewards, start, env.spec.max_episode_steps)


def optimal_q(
    successors: Ints, probabilities: Floats, rewards: Floats, ends: Bools | None, gamma: float, tolerance: float = 0.0
) -> Floats:
    """Discounted action values, float64 [S, A], by value iteration; no rewards follow a terminated state.

    Args:
        successors: next states of each (state, action), int64 [S, A, K].
        probabilities: their probabilities, float64 [S, A, K].
        rewards: on arrival in each state, float64 [S].
        ends: whether arrival in a state terminates, bool [S]; None if no episode terminates.
        gamma: discount factor.
        tolerance: largest change in the last sweep; 0 for machine precision, 1e-13 of the largest value.
    """
    q = np.zeros(successors.shape[:2])
    while True:
        best = q.max(axis=1)
        worth = rewards + gamma * (best if ends is None else np.where(ends, 0.0, best))
        new: Floats = (probabilities * worth[successors]).sum(axis=2)
        if np.abs(new - q).max() <= (tolerance or 1e-13 * max(1.0, float(np.abs(new).max()))):
            return new
        q = new
