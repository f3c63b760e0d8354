"""Rewards that an agent plans for: the user's function, the environment's own, or one learned from observed rewards.

Rewards influence neither exploration nor transition models; only the planner uses them.
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
    """A reward function as written by users."""

    def __call__(self, obs: Any, action: Any, next_obs: Any, /) -> NDArray[Any]:
        """Rewards float [B] of a batch of transitions.

        Args:
            obs: observations in the form of ``gymnasium.vector.utils.batch_space``, integers as int64.
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
"""Largest absolute reward; planning adds, multiplies and squares rewards."""


class CallableReward:
    """Converts a user's or an environment's reward function to a function of factored states.

    Args:
        fn: the function.
        space: the observation space.
        actions: the actions.

    Raises (when called):
        TypeError: ``fn`` does not return numbers; on construction, ``fn`` does not take three arguments.
        ValueError: ``fn`` returned a wrong shape, NaN, infinity or a number beyond ``LARGEST_REWARD``.
        RuntimeError: ``fn`` raised an error, which is the ``__cause__`` of this one.
    """

    def __init__(self, fn: RewardFn, space: FactoredSpace, actions: ActionEnumeration) -> None:
        """See the class."""
        if not callable(fn):
            raise TypeError(f"A reward must be a function of (obs, action, next_obs), got {fn!r}.")
        _check_signature(fn)
        self.fn, self._space = fn, space
        self._every_action: NDArray[Any] = actions.decode_wide(np.arange(actions.n))

    def __call__(self, states: States, actions: Actions, next_states: States) -> Floats:
        """Rewards float64 [M]; see ``types.Reward``."""
        return self._rewards(states, actions, next_states, copy=True)

    def of_owned(self, states: States, actions: Actions, next_states: States) -> Floats:
        """As a call, for arrays of states that may be modified, which need not be copied for the reward function."""
        return self._rewards(states, actions, next_states, copy=False)

    def _rewards(self, states: States, actions: Actions, next_states: States, copy: bool) -> Floats:
        if len(actions) == 0:
            return np.zeros(0)
        batch = (
            self._space.decode_wide(states, copy),
            self._every_action.take(actions, axis=0),
            self._space.decode_wide(next_states, copy),
        )
        try:
            result = self.fn(*batch)
        except Exception as error:
            name = getattr(self.fn, "__qualname__", repr(self.fn))
            raise RuntimeError(
                f"The reward function {name} raised {type(error).__name__} ({error}) when it was given {len(actions)} "
                "transitions, observed or simulated; fix it or give another goal with set_reward(fn)."
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
        largest = np.abs(rewards).max()
        if not largest < np.inf:
            raise ValueError("The reward function returned NaN or infinity; every reward must be a finite number.")
        if largest > LARGEST_REWARD:
            raise ValueError(
                f"The reward function returned {rewards[np.abs(rewards).argmax()]:g}; since returns are sums of many rewards, "
                f"none may be larger than {LARGEST_REWARD:g}: scale them down."
            )
        return rewards


Source = Literal["custom", "environment", "learned", "missing"]

_TEST_ROWS = 64


def reward_wrapper(env: VecEnv) -> str | None:
    """Name of the first environment's outermost wrapper that changes rewards; None if there is none, or in a subprocess."""
    inner = getattr(env.unwrapped, "envs", [None])[0]
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, gym.RewardWrapper | gym.wrappers.NormalizeReward):
            return type(inner).__name__
        inner = inner.env
    return None


class RewardSelector:
    """Selects the goal: the custom reward, the environment's own reward, or the learned reward.

    Without a custom reward, the goal is the environment's own ``reward_fn`` if it exists and reproduces the rewards observed in
    that environment (wrappers can change spaces and rewards); rewards from before a change are excepted. Otherwise the goal is
    the learned reward, and a warning gives the reason.

    Args:
        policy: the policy, with its spaces and the learned reward.
        experience: the observed transitions.

    Attributes:
        source: source of the current goal; "missing" if an agent was loaded without its custom reward.
        learned: whether the reward model is up to date with the observed transitions.
        reward_report: accuracy of the learned reward; None before it is fitted.
    """

    def __init__(self, policy: PlannerPolicy, experience: Experience) -> None:
        """See the class."""
        self._policy, self._experience = policy, experience
        self._custom: CallableReward | None = None
        self._environment: CallableReward | None = None
        self._since = 0
        self._unusable = "There is no environment"
        self._changes_rewards: str | None = None
        self._last_warning: str | None = None
        self.source: Source = "environment"
        self.learned = False
        self.reward_report: RewardReport | None = None

    def take_environment(self, env: VecEnv) -> None:
        """Uses the ``reward_fn`` of a new environment, if it has one."""
        self._since, self._environment = len(self._experience.dataset), None
        fn, self._unusable = own_reward(env)
        if fn is not None:
            try:
                self._environment = self._as_goal(fn)
            except TypeError as error:  # an attribute of that name that is not a reward function
                self._unusable = f"The environment's reward_fn cannot be used as a goal ({str(error).rstrip('.')})"
        self._changes_rewards, self._last_warning = reward_wrapper(env), None

    @property
    def _transitions(self) -> TransitionDataset:
        return self._experience.coded(self._policy.factored)

    def recode(self) -> None:
        """Adapts the reward functions to new factors; marks the learned reward as outdated."""
        self._custom, self._environment = (
            None if given is None else self._as_goal(given.fn) for given in (self._custom, self._environment)
        )
        self.learned = False

    def forget_learned(self) -> None:
        """Marks the learned reward as outdated, since there are new transitions."""
        self.learned = False

    def choose(self, reward: RewardFn | None) -> Reward | None:
        """Sets the custom reward and returns the new goal; ``None`` removes the custom reward.

        Raises:
            TypeError, ValueError, RuntimeError: ``reward`` is not a reward function, or fails in a test; the goal is unchanged.
        """
        custom = None
        if reward is not None:
            custom = self._as_goal(reward)
            self._test(custom)
        self._custom = custom
        self.source = "custom" if custom is not None else "environment"
        return self.current()

    def current(self) -> Reward | None:
        """The current goal; None if the custom reward is missing or the learned reward is not yet available."""
        if self.source == "missing":
            return None
        if self._custom is not None:
            return self._custom
        problem = self._environment_problem()
        if problem is None:
            self.source = "environment"
            if self._changes_rewards and self._policy.fitted and len(self._experience.dataset) == self._since:
                self._warn(
                    f"{self._changes_rewards} changes the environment's rewards, which the agent has not observed yet: until "
                    "the next learn() it plans with the reward_fn inside; to be sure, give the goal with set_reward(fn)."
                )
            return self._environment
        self.source = "learned"
        if not self._policy.fitted:
            return None
        self._warn(f"{problem}, so the agent plans with a reward learned from the rewards it observed.")
        return self.learned_goal()

    def _warn(self, message: str) -> None:
        """Warns, unless the last warning was the same."""
        if message != self._last_warning:
            warnings.warn(message, stacklevel=6)
            self._last_warning = message

    def restore(self, source: Source) -> Reward | None:
        """The goal of a loaded agent, given the ``source`` stored in its file; None if the goal is not available."""
        if source == "custom":
            self.source = "missing"
            return None
        self.source = source
        return self.learned_goal() if source == "learned" else self.current()

    def learned_goal(self) -> Reward:
        """Returns the reward model, after fitting it if necessary."""
        self.fit_learned()
        return self._policy.reward_model

    def fit_learned(self) -> None:
        """Fits the reward model to the observed rewards, unless it is up to date."""
        rows = self._transitions.rows()
        if not self.learned and len(rows):
            recent = np.arange(self._since if self._since < len(rows) else 0, len(rows))
            self.reward_report = self._policy.reward_model.fit(rows.select(recent))
            if self.reward_report.advice is not None:
                warnings.warn(self.reward_report.advice, UserWarning, stacklevel=2)
            self.learned = True

    def _environment_problem(self) -> str | None:
        """The reason why the environment's own reward function cannot be used; None if it can."""
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
                self._warn(
                    f"The environment's rewards changed after about {until:,} steps, and its reward_fn gives those observed "
                    "since then, so the agent plans with it; when you change rewards, give the new goal with set_reward(fn), or "
                    "call set_env(env), after which earlier rewards are ignored."
                )
                return None
            return f"The environment's reward_fn differs from {int(wrong.sum())} of the {len(rows)} rewards observed"
        return None

    def _test(self, reward: CallableReward) -> None:
        """Tests ``reward`` on observed transitions; without any, on start states; without these, on all-zero factors."""
        rows = self._transitions.rows()
        if len(rows):
            picked = rows.select(np.linspace(0, len(rows) - 1, min(_TEST_ROWS, len(rows))).astype(np.int64))
            reward(picked.states, picked.actions, picked.next_states)
            return
        states = np.zeros((3, len(self._policy.factored)), dtype=np.int64)
        if len(self._policy.start_states):
            states = self._policy.start_states[np.arange(3) % len(self._policy.start_states)]
        reward(states, np.zeros(3, dtype=np.int64), states)

    def _as_goal(self, fn: RewardFn) -> CallableReward:
        return CallableReward(fn, self._policy.factored, self._policy.actions)
