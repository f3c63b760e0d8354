"""Goals: what a user's reward function must be, and how one becomes what a planner scores with.

A reward never steers exploration and never touches a transition model; it is handed to the planner alone.
"""

from __future__ import annotations

import inspect
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Actions, Floats, States
from mbagent.spaces import ActionEnumeration, FactoredSpace


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


class GivenReward:
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
        """Rewards float64 [M]; see planning.goal."""
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
