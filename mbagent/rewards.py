"""Rewards that an agent plans for: the user's function, the environment's own, or one learned from observed rewards.

A reward never steers exploration and never changes a transition model; only the planner receives it.
"""

from __future__ import annotations

import inspect
import warnings
from typing import Any, Literal, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from mbagent.data import Experience, TransitionDataset
from mbagent.environments import own_reward
from mbagent.models.reward import RewardReport
from mbagent.models.reward_changes import wrong_until
from mbagent.policies import PlannerPolicy
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.types import Actions, Floats, Reward, States


class RewardFn(Protocol):
    """A goal, as users write it."""

    def __call__(self, obs: Any, action: Any, next_obs: Any, /) -> NDArray[Any]:
        """Rewards float [B] of a batch of transitions.

        Args:
            obs: observations as ``gymnasium.vector.utils.batch_space`` lays them out, integers as int64.
            action: actions in the action space's own form, batched, integers as int64.
            next_obs: as ``obs``.
        """
        ...


def _check_signature(fn: Any) -> None:
    try:
        signature = inspect.signature(fn)
    except (TypeError, ValueError):  # compiled callables may have none
        return
    try:
        signature.bind(None, None, None)
    except TypeError as error:
        name = getattr(fn, "__qualname__", repr(fn))
        raise TypeError(f"A reward function is called as fn(obs, action, next_obs), but {name} takes {signature}.") from error


LARGEST_REWARD = 1e100
"""Largest absolute reward: what is planned with adds, multiplies and squares them."""


class CallableReward:
    """A user's or an environment's reward function, as a goal on factors.

    Args:
        fn: the function.
        space: the observation space.
        actions: the actions.

    Raises (when called):
        TypeError: ``fn`` does not take three arguments, or does not return numbers.
        ValueError: it returned a wrong shape, NaN or infinity.
        RuntimeError: it raised an error, which is the cause (``__cause__``) of this one.
    """

    def __init__(self, fn: RewardFn, space: FactoredSpace, actions: ActionEnumeration) -> None:
        """See the class."""
        if not callable(fn):
            raise TypeError(f"A reward must be a function of (obs, action, next_obs), got {fn!r}.")
        _check_signature(fn)
        self.fn, self._space, self._actions = fn, space, actions

    def __call__(self, states: States, actions: Actions, next_states: States) -> Floats:
        """Rewards float64 [M]; see ``types.Reward``."""
        if len(actions) == 0:
            return np.zeros(0)
        batch = (
            self._space.decode_wide(states),
            self._actions.decode_wide(actions),
            self._space.decode_wide(next_states),
        )
        try:
            result = self.fn(*batch)
        except Exception as error:
            name = getattr(self.fn, "__qualname__", repr(self.fn))
            raise RuntimeError(
                f"The reward function {name} raised {type(error).__name__} ({error}) when it was given {len(actions)} "
                "transitions, met or imagined; mend it or give another goal with set_reward(fn)."
            ) from error
        if result is None:
            raise TypeError("The reward function returned None; it must return an array of numbers: is a return missing?")
        try:
            found = np.asarray(result)
            if found.dtype.kind not in "biuf":
                raise TypeError(f"values of type {found.dtype}")
            rewards = found.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"The reward function must return an array of numbers, got {type(result).__name__} ({error})."
            ) from error
        if rewards.shape != (len(actions),):
            raise ValueError(
                f"The reward function must return one number for each of the {len(actions)} transitions it is given "
                f"(shape ({len(actions)},)), got shape {rewards.shape}; its arguments are batches: index them as obs[:, ...]."
            )
        if not np.isfinite(rewards).all():
            raise ValueError("The reward function returned NaN or infinity; every reward must be a finite number.")
        if np.abs(rewards).max() > LARGEST_REWARD:
            raise ValueError(
                f"The reward function returned {rewards[np.abs(rewards).argmax()]:g}; returns are sums of many rewards: none "
                f"may be larger than {LARGEST_REWARD:g}: scale them down."
            )
        return rewards


Source = Literal["custom", "environment", "learned", "missing"]

_PROBE_ROWS = 64


def reward_wrapper(env: VecEnv) -> str | None:
    """Name of a wrapper of the first environment that changes rewards, or None (also where another process hides it)."""
    inner = getattr(env.unwrapped, "envs", [None])[0]
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, gym.RewardWrapper | gym.wrappers.NormalizeReward):
            return type(inner).__name__
        inner = inner.env
    return None


class RewardSelector:
    """Keeps the candidates for the goal and decides between them.

    With no custom reward the environment's own ``reward_fn`` is used if it has one and it reproduces every reward met
    while exploring (wrappers can change spaces and rewards); else the learned reward, with a warning that says why.

    Args:
        policy: knows spaces and the learned reward.
        experience: what was met.

    Attributes:
        source: where the current goal comes from; "missing" after loading an agent whose custom reward was not given
            again.
        learned: whether the reward model is fitted to all transitions.
        reward_report: how well it tells rewards; None before it is fitted.
    """

    def __init__(self, policy: PlannerPolicy, experience: Experience) -> None:
        """See the class."""
        self._policy, self._experience = policy, experience
        self._custom: CallableReward | None = None
        self._environment: CallableReward | None = None
        self._since = 0
        self._unusable = "There is no environment"
        self._changes_rewards: str | None = None
        self._told: str | None = None
        self.source: Source = "environment"
        self.learned = False
        self.reward_report: RewardReport | None = None

    def take_environment(self, env: VecEnv) -> None:
        """Takes the ``reward_fn`` of a new environment, if it has one."""
        self._since, self._environment = len(self._experience.dataset), None
        fn, self._unusable = own_reward(env)
        if fn is not None:
            try:
                self._environment = self._given(fn)
            except TypeError as error:  # something else that happens to have that name
                self._unusable = f"The environment's reward_fn cannot be used as a goal ({str(error).rstrip('.')})"
        self._changes_rewards, self._told = reward_wrapper(env), None

    @property
    def _transitions(self) -> TransitionDataset:
        return self._experience.coded(self._policy.factored)

    def recode(self) -> None:
        """The policy's factors have changed."""
        self._custom, self._environment = (
            None if given is None else self._given(given.fn) for given in (self._custom, self._environment)
        )
        self.learned = False

    def forget_learned(self) -> None:
        """The learned reward is out of date: there are new transitions."""
        self.learned = False

    def choose(self, reward: RewardFn | None) -> Reward | None:
        """Changes the goal; ``None`` goes back to the environment's own.

        Raises:
            TypeError, ValueError, RuntimeError: the function is no reward function, or fails; nothing is changed then.
        """
        custom = None
        if reward is not None:
            custom = self._given(reward)
            self._probe(custom)
        self._custom = custom
        self.source = "custom" if custom is not None else "environment"
        return self.current()

    def current(self) -> Reward | None:
        """The goal to plan for; None while nothing is learned and no reward is given."""
        if self.source == "missing":
            return None
        if self._custom is not None:
            return self._custom
        problem = self._environment_problem()
        if problem is None:
            self.source = "environment"
            if self._changes_rewards and self._policy.fitted and len(self._experience.dataset) == self._since:
                self._tell(
                    f"{self._changes_rewards} changes the environment's rewards, which the agent has not met yet: until the next "
                    "learn() it plans with the reward_fn inside; to be sure, give the goal with set_reward(fn)."
                )
            return self._environment
        self.source = "learned"
        if not self._policy.fitted:
            return None
        self._tell(f"{problem}, so the agent plans with a reward learned from the rewards it met.")
        return self.learned_goal()

    def _tell(self, message: str) -> None:
        """Warns, unless the last warning said the same."""
        if message != self._told:
            warnings.warn(message, stacklevel=6)
            self._told = message

    def restore(self, source: Source) -> Reward | None:
        """The goal of an agent loaded from a file, where only its source is kept; None if it must be given again."""
        if source == "custom":
            self.source = "missing"
            return None
        self.source = source
        return self.learned_goal() if source == "learned" else self.current()

    def learned_goal(self) -> Reward:
        """The reward model, fitted first if need be."""
        self.fit_learned()
        return self._policy.reward_model

    def fit_learned(self) -> None:
        """Fits the reward model to the rewards met, unless that is done."""
        rows = self._transitions.rows()
        if not self.learned and len(rows):
            recent = np.arange(self._since if self._since < len(rows) else 0, len(rows))
            self.reward_report = self._policy.reward_model.fit(rows.select(recent))
            if self.reward_report.advice is not None:
                warnings.warn(self.reward_report.advice, UserWarning, stacklevel=2)
            self.learned = True

    def _environment_problem(self) -> str | None:
        """Why the environment's own reward function cannot be used, or None."""
        if self._environment is None:
            return self._unusable
        rows = self._transitions.rows()
        rows = rows.select(np.arange(self._since, len(rows)))
        try:
            rewards = self._environment(rows.states, rows.actions, rows.next_states)
        except Exception as error:
            cause = error.__cause__ or error
            return f"The environment's reward_fn fails on its own observations ({type(cause).__name__}: {str(cause).rstrip('.')})"
        wrong = ~np.isclose(rewards, rows.rewards, rtol=1e-4, atol=1e-6)
        if wrong.any():
            until = wrong_until(rows, wrong)
            if until is not None:
                self._tell(
                    f"The environment's rewards changed after about {until:,} steps, and its reward_fn gives those observed "
                    "since then, so the agent plans with it; when you change rewards, give the new goal with set_reward(fn), or "
                    "call set_env(env), which starts the rewards afresh."
                )
                return None
            return f"The environment's reward_fn differs from {int(wrong.sum())} of the {len(rows)} rewards met"
        return None

    def _probe(self, reward: CallableReward) -> None:
        """Tries a reward function on transitions met, or on the space's first observation."""
        rows = self._transitions.rows()
        if len(rows):
            picked = rows.select(np.linspace(0, len(rows) - 1, min(_PROBE_ROWS, len(rows))).astype(np.int64))
            reward(picked.states, picked.actions, picked.next_states)
            return
        states = np.zeros((3, len(self._policy.factored)), dtype=np.int64)
        if len(self._policy.start_states):
            states = self._policy.start_states[np.arange(3) % len(self._policy.start_states)]
        reward(states, np.zeros(3, dtype=np.int64), states)

    def _given(self, fn: RewardFn) -> CallableReward:
        return CallableReward(fn, self._policy.factored, self._policy.actions)
