"""Interface of the games: a few pure functions on batches of observations, without internal state.

An observation is the whole state. All randomness comes from keys (`mbagent_envs.random_keys`), one per row, so the
same functions are used by a single environment, by a vector environment, and by a planner that simulates with
the true rules.
"""

from __future__ import annotations

import difflib
import inspect
import types
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Discrete, MultiBinary

from mbagent_envs.types import Bits, Bools, Floats, Ints, Keys

RewardFn = Callable[[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]], Floats]
"""A goal: ``reward_fn(obs [B, ...], action [B], next_obs [B, ...]) -> float64 [B]``, for any integer type."""


def as_floats(values: Any) -> Floats:
    """Return numbers or truth values as float64."""
    return np.asarray(values, dtype=np.float64)


class InvalidActionError(gym.error.InvalidAction, ValueError):
    """An action outside the action space."""


@dataclass(frozen=True)
class Sprite:
    """One object to draw: its kind (a key of `mbagent_envs.drawing.SYMBOLS`) and its cell, row 0 on top."""

    kind: str
    row: int
    column: int


@dataclass(frozen=True)
class Scene:
    """The content of a picture: a board of cells and the objects on it, painted in the given order.

    ``background`` is a key of `mbagent_envs.drawing.BACKGROUNDS`.
    """

    background: str
    rows: int
    columns: int
    sprites: tuple[Sprite, ...]


class Game(ABC):
    """The rules of a game as pure functions on batches; ``B`` below is the batch size.

    Subclasses take their arguments as keywords, set the attributes below, and call ``super().__init__`` with
    the goals. Instances are not changed after construction, so they can be shared.
    """

    action_names: tuple[str, ...]
    """Effect of each action, by number."""
    observation_space: MultiBinary
    action_space: Discrete[np.int64]
    max_episode_steps: ClassVar[int]
    """Steps after which an episode is truncated unless another limit is given to `gymnasium.make`."""

    def __init__(
        self,
        *,
        observation_shape: tuple[int, ...],
        action_names: tuple[str, ...],
        goals: Mapping[str, RewardFn],
    ) -> None:
        """Build the spaces and the mapping of goals (``"default"``, the game's own reward, is the first)."""
        self.action_names = action_names
        self.observation_space = MultiBinary(observation_shape)
        self.action_space = Discrete(len(action_names))
        self._goals: dict[str, RewardFn] = {"default": self.reward, **goals}

    @property
    def reward_functions(self) -> Mapping[str, RewardFn]:
        """Goals by name, functions of (obs, action, next_obs); ``"default"`` is the game's own reward."""
        return types.MappingProxyType(self._goals)

    @property
    def arguments(self) -> dict[str, Any]:
        """The keyword arguments with which an equal game can be built."""
        return {name: getattr(self, name) for name in argument_names(type(self))}

    def __repr__(self) -> str:
        """Show the game as the call that builds it."""
        arguments = ", ".join(f"{name}={value!r}" for name, value in self.arguments.items())
        return f"{type(self).__name__}({arguments})"

    @abstractmethod
    def initial(self, keys: Keys) -> Bits:
        """Draw start states: keys uint64 ``[B]`` -> observations int8 ``[B, *shape]``."""

    @abstractmethod
    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """Take one step in every row.

        Args:
            obs: int8 ``[B, *shape]``; not checked (see `check_observations`).
            actions: integers ``[B]``; not checked (see `check_actions`).
            keys: uint64 ``[B]``; row ``b`` of the result depends on row ``b`` of the arguments only.

        Returns:
            A new array of the next observations, int8 ``[B, *shape]``.
        """

    @abstractmethod
    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Return the game's own reward, float64 ``[B]``, of transitions laid out as in `transition`."""

    def terminated(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Bools:
        """Return whether each transition ends the episode, bool ``[B]``; by default none does."""
        return np.zeros(len(next_obs), dtype=np.bool_)

    def transition_distribution(self, obs: Bits, action: int) -> tuple[Bits, Floats]:
        """Enumerate the possible next observations after one observation and action.

        Args:
            obs: int8 ``[*shape]``.
            action: number of the action.

        Returns:
            The distinct next observations, int8 ``[M, *shape]``, and their probabilities, float64 ``[M]``,
            all positive.

        Raises:
            NotImplementedError: if there are too many successors to list.
        """
        outcomes, probabilities = self.transition_distributions(obs[None], np.array([action]))
        possible = probabilities[0] > 0
        return outcomes[0, possible], probabilities[0, possible]

    def transition_distributions(self, obs: Bits, actions: npt.NDArray[Any]) -> tuple[Bits, Floats]:
        """Enumerate possible next observations for a batch; games that can list their successors override this.

        Args:
            obs: int8 ``[B, *shape]``.
            actions: integers ``[B]``.

        Returns:
            ``M`` distinct next observations of each row, int8 ``[B, M, *shape]``, and their probabilities, float64
            ``[B, M]``, some of which may be zero.

        Raises:
            NotImplementedError: if there are too many successors to list.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot list its successors; sample them with transition().")

    @abstractmethod
    def scene(self, obs: Bits) -> Scene:
        """Return the scene of one observation, int8 ``[*shape]``, for drawing."""

    @abstractmethod
    def invalid(self, obs: Bits) -> str | None:
        """Describe briefly why a row of ``obs``, bits ``[B, *shape]``, is not a state of this game; None if all are."""

    def check_observations(self, obs: npt.ArrayLike) -> Bits:
        """Return a batch of observations as contiguous int8 ``[B, *shape]``.

        Raises:
            ValueError: if the shape is wrong or a row is not a state of this game.
        """
        array = np.asarray(obs)
        shape = self.observation_space.shape
        if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
            raise ValueError(f"observations must have shape (B, {', '.join(map(str, shape))}), but it is {array.shape}.")
        if not bool(np.isin(array, (0, 1)).all()):
            raise ValueError("observations must hold only 0 and 1; pass them as the environment returned them.")
        bits = np.ascontiguousarray(array, dtype=np.int8)
        reason = self.invalid(bits)
        if reason is not None:
            raise ValueError(
                f"not a state of {type(self).__name__}: {reason}; pass observations as the environment returned them."
            )
        return bits

    def check_actions(self, actions: npt.ArrayLike, count: int) -> Ints:
        """Return a batch of actions as int64 ``[count]``.

        Raises:
            InvalidActionError: if their shape, type or values are wrong.
        """
        array = np.asarray(actions)
        n = int(self.action_space.n)
        if array.dtype.kind not in "iu" or array.shape != (count,) or (count and (array.min() < 0 or array.max() >= n)):
            raise InvalidActionError(
                f"actions must be {count} integer{'s' * (count != 1)} from 0 to {n - 1} "
                f"({', '.join(self.action_names)}), but got {actions!r}."
            )
        return array.astype(np.int64, copy=False)


def argument_names(game_type: type[Game]) -> list[str]:
    """Return the names of the keyword arguments of a game's class."""
    return [name for name in inspect.signature(game_type).parameters if name != "self"]


def build_game(game_type: type[Game], arguments: Mapping[str, Any]) -> Game:
    """Build a game from keyword arguments.

    Raises:
        TypeError: if an argument is unknown; the message names the most similar known one.
        ValueError: if a value is invalid (raised by the game itself, as is TypeError for a wrong type).
    """
    known = argument_names(game_type)
    for name in arguments:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise TypeError(f"{game_type.__name__} has no argument {name!r} (it takes {', '.join(known)}){hint}")
    return game_type(**arguments)


def check_integer(name: str, value: object, minimum: int) -> int:
    """Return ``value`` as an int of at least ``minimum``; TypeError and ValueError name the argument."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an integer, but it is {value!r} of type {type(value).__name__}.")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, but it is {value}.")
    return int(value)


def check_number(name: str, value: object, minimum: float, maximum: float, *, below: bool = False) -> float:
    """Return ``value`` as a finite float in [minimum, maximum], or, with ``below``, in [minimum, maximum)."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, but it is {value!r} of type {type(value).__name__}.")
    if not (minimum <= value <= maximum and np.isfinite(value)) or (below and value == maximum):
        wanted = (
            f"in [{minimum:g}, {maximum:g}{')' if below else ']'}" if np.isfinite([minimum, maximum]).all() else "a finite number"
        )
        raise ValueError(f"{name} must be {wanted}, but it is {value}.")
    return float(value)


def check_flag(name: str, value: object) -> bool:
    """Return ``value`` as a bool, or raise TypeError naming the argument."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, but it is {value!r} of type {type(value).__name__}.")
    return bool(value)
