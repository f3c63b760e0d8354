"""What an agent has learned, had back as a Gymnasium environment: any algorithm can be trained in it."""

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
"""Rewards of so many transitions are remembered."""


class LearnedEnv(gym.Env[Any, Any]):
    """The world as an agent's model knows it now, with a reward of your choice.

    Next states and terminations are drawn from the model. Episodes start where the agent's did, as often. The spaces are those of
    the agent's environment. No step of the real environment is taken, so rewards can be tried out, and algorithms
    compared, in it; what they find is as good as the model.

    Args:
        agent: one that has learned. It may go on to learn: make another LearnedEnv then.
        reward_fn: the reward, see RewardFn; None for what the agent plans for now (the environment's own, what it learned from
            the rewards met, or what ``set_reward`` gave).
        max_episode_steps: episodes are truncated after so many steps; None for never. Give the real environment's limit, as
            the model does not know it.

    Raises:
        ValueError: the agent has learned nothing yet, or there is no reward; or a limit below 1.
        TypeError: the agent is none; or the reward is no function of (obs, action, next_obs).

    Example:
        agent = mbagent.ModelLearningAgent("MctsPolicy", env, seed=0).learn(20_000)
        imagined = mbagent.LearnedEnv(agent, lambda obs, action, next_obs: next_obs[:, 9], max_episode_steps=100)
        PPO("MlpPolicy", imagined).learn(100_000)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(
        self, agent: ModelLearningAgent, reward_fn: RewardFn | None = None, *, max_episode_steps: int | None = None
    ) -> None:
        """See the class."""
        if not isinstance(getattr(agent, "policy", None), PlannerPolicy):
            raise TypeError(f"LearnedEnv needs an agent, a ModelLearningAgent that has learned, got {agent!r}.")
        with agent.policy.lock:
            self._take(agent, reward_fn, max_episode_steps)

    def _take(self, agent: ModelLearningAgent, reward_fn: RewardFn | None, max_episode_steps: int | None) -> None:
        policy = agent.policy
        if not policy.fitted:
            raise ValueError("This agent has learned nothing yet, so there is no world to have back; call learn() first.")
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
            ValueError: options are given; there are none.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"LearnedEnv takes no reset options, got {sorted(options)[0]!r}.")
        row = int(self.np_random.choice(len(self._starts), p=self._shares))
        self._state, self._steps = self._starts[row : row + 1], 0
        return self._shown(self._state), {}

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
        reward = self._earned(self._state, actions, following)
        self._state, self._steps = following, self._steps + 1
        terminated = bool(over[0])
        truncated = not terminated and self.max_episode_steps is not None and self._steps >= self.max_episode_steps
        return self._shown(following), reward, terminated, truncated, {}

    def _earned(self, states: States, actions: Actions, following: States) -> float:
        """The reward of a transition; it is asked for once, as learned rewards and users' functions are quick in batches only."""
        key = states.tobytes() + actions.tobytes() + following.tobytes()
        if (known := self._rewards.get(key)) is not None:
            return known
        if len(self._rewards) >= MOST_REWARDS:
            self._rewards.clear()
        assert self._reward is not None
        reward = self._rewards[key] = float(self._reward(states, actions, following)[0])
        return reward

    def _shown(self, state: States) -> Any:
        return _first(self._space.decode(state))


def _starts(agent: ModelLearningAgent) -> tuple[States, NDArray[np.float64]]:
    """Start states [S, F], and the share of episodes that began in each; equal shares where the episodes are not at hand."""
    rows = agent.transitions.rows()
    _, first = np.unique(rows.episodes, return_index=True)
    begun = rows.before[first].astype(np.int64)
    known = begun if len(begun) else agent.policy.start_states
    starts, counts = np.unique(known, axis=0, return_counts=True)
    return starts, counts / counts.sum()


def _first(batch: Any) -> Any:
    """The observation of a batch of one, laid out as ``batch_space`` does."""
    if isinstance(batch, dict):
        return {key: _first(part) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_first(part) for part in batch)
    return batch[0]
