"""The learned model as a Gymnasium environment, in which any algorithm can be trained."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.arguments import check_count
from mbagent.policies import NO_GOAL, PlannerPolicy
from mbagent.rewards import CallableReward, RewardFn
from mbagent.spaces import as_batch
from mbagent.types import Actions, States

if TYPE_CHECKING:
    from mbagent.agent import ModelLearningAgent


MOST_REWARDS = 100_000
"""Largest number of transitions whose rewards are cached."""


class LearnedEnv(gym.Env[Any, Any]):
    """The current state of an agent's model as an environment, with a reward of your choice.

    Next states and terminations are sampled from the model. Start states are sampled with the frequencies of the agent's
    episodes. The spaces are those of the agent's environment. Rewards can be tested and algorithms compared without steps in the
    real environment; the results depend on the model's accuracy.

    Args:
        agent: an agent that has learned. If it learns further, create a new LearnedEnv.
        reward_fn: the reward, see RewardFn; None for the agent's current goal (the environment's own reward, one learned from
            the observed rewards, or the function given to ``set_reward``).
        max_episode_steps: number of steps after which episodes are truncated; None for no limit. Give the real environment's
            limit, as it is not part of the model.

    Raises:
        ValueError: the agent has learned nothing yet, there is no reward, or the limit is below 1.
        TypeError: ``agent`` is not an agent, or the reward is not a function of (obs, action, next_obs).

    Example:
        agent = mbagent.ModelLearningAgent("MctsPolicy", env, seed=0).learn(20_000)
        learned_env = mbagent.LearnedEnv(agent, lambda obs, action, next_obs: next_obs[:, 9], max_episode_steps=100)
        PPO("MlpPolicy", learned_env).learn(100_000)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(
        self, agent: ModelLearningAgent, reward_fn: RewardFn | None = None, *, max_episode_steps: int | None = None
    ) -> None:
        """See the class."""
        if not isinstance(getattr(agent, "policy", None), PlannerPolicy):
            raise TypeError(f"LearnedEnv needs an agent, a ModelLearningAgent that has learned, got {agent!r}.")
        with agent.policy.lock:
            self._set_up(agent, reward_fn, max_episode_steps)

    def _set_up(self, agent: ModelLearningAgent, reward_fn: RewardFn | None, max_episode_steps: int | None) -> None:
        policy = agent.policy
        if not policy.fitted:
            raise ValueError(
                "This agent has learned nothing yet, so there is no model to use as an environment; call learn() first."
            )
        max_episode_steps = check_count("max_episode_steps", max_episode_steps, "no limit")
        if reward_fn is None and policy.goal is None:
            raise ValueError(NO_GOAL)
        self.observation_space, self.action_space = agent.observation_space, agent.action_space
        self.model, self._space, self._actions = policy.transition_model, policy.factored, policy.actions
        self._reward = policy.goal if reward_fn is None else CallableReward(reward_fn, policy.factored, policy.actions)
        self._starts, self._shares = _starts(agent)
        self.max_episode_steps = max_episode_steps
        self._rewards: dict[bytes, float] = {}
        self._state: States | None = None
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env.

        Raises:
            ValueError: options are given; none are supported.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"LearnedEnv takes no reset options, got {sorted(options)[0]!r}.")
        row = int(self.np_random.choice(len(self._starts), p=self._shares))
        self._state, self._steps = self._starts[row : row + 1], 0
        return self._observation(self._state), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env.

        Raises:
            ResetNeeded: ``reset`` was not called.
            ValueError: the action is not one of the action space.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        actions = self._actions.encode(as_batch(self.action_space, action, "action")[0])
        if len(actions) != 1:
            raise ValueError(f"LearnedEnv.step takes one action, got a batch of {len(actions)}.")
        following, over = self.model.sample(self._state, actions, self.np_random.integers(2**64, size=1, dtype=np.uint64))
        reward = self._reward_of(self._state, actions, following)
        self._state, self._steps = following, self._steps + 1
        terminated = bool(over[0])
        truncated = not terminated and self.max_episode_steps is not None and self._steps >= self.max_episode_steps
        return self._observation(following), reward, terminated, truncated, {}

    def _reward_of(self, states: States, actions: Actions, following: States) -> float:
        """The reward of a transition; cached, since learned rewards and users' functions are fast only on batches."""
        key = states.tobytes() + actions.tobytes() + following.tobytes()
        if (known := self._rewards.get(key)) is not None:
            return known
        if len(self._rewards) >= MOST_REWARDS:
            self._rewards.clear()
        assert self._reward is not None
        reward = self._rewards[key] = float(self._reward(states, actions, following)[0])
        return reward

    def _observation(self, state: States) -> Any:
        return _first(self._space.decode(state))


def _starts(agent: ModelLearningAgent) -> tuple[States, NDArray[np.float64]]:
    """Start states [S, F], and the share of episodes that began in each; equal shares if no transitions are available."""
    rows = agent.transitions.rows()
    _, first = np.unique(rows.episodes, return_index=True)
    begun = rows.before[first].astype(np.int64)
    known = begun if len(begun) else agent.policy.start_states
    starts, counts = np.unique(known, axis=0, return_counts=True)
    return starts, counts / counts.sum()


def _first(batch: Any) -> Any:
    """The observation of a batch of one in the form of ``batch_space``."""
    if isinstance(batch, dict):
        return {key: _first(part) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_first(part) for part in batch)
    return batch[0]
