"""Wrappers that make a world fit for a model of single steps."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.spaces import ActionEnumeration, FactoredSpace


class History(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Makes the last ``k`` observations and actions part of the observation.

    For worlds whose next state depends on more than what an observation shows: a model of single steps can then see
    what it needs. A stack of planes stays one, channels first: older observations and one plane for each action become
    further channels (an action's plane is on everywhere, or off). Any other space, and planes of which so many channels could
    be taken for rows (boards that are not square, with more channels than columns), become one row of variables: the
    observation's, then, for each step back, the older observation's and one bit for each action. Before the first step
    the older observations are the first one, and no action is on.

    Args:
        env: an environment with discrete spaces (see FactoredSpace).
        k: steps back, at least 1.

    Raises:
        TypeError: a space is not discrete.
        ValueError: k is below 1.
    """

    def __init__(self, env: gym.Env[Any, Any], k: int) -> None:
        """See the class."""
        gym.utils.RecordConstructorArgs.__init__(self, k=k)
        gym.Wrapper.__init__(self, env)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
            raise ValueError(f"History needs a whole number of steps back, 1 or more, got k={k!r}.")
        self.k = int(k)
        self._space, self._actions = FactoredSpace(env.observation_space), ActionEnumeration(env.action_space)
        self._past: deque[tuple[NDArray[np.int64], int]] = deque(maxlen=self.k)
        self._now = np.zeros(len(self._space), dtype=np.int64)
        self._planes = self._space.planes
        if self._planes is not None:
            cards = self._planes.to_planes(np.asarray(self._space.cardinalities)[None])[0]
            actions = np.full((self._actions.n, *cards.shape[1:]), 2, dtype=np.int64)
            self.observation_space = _space_of(np.concatenate([cards, *([cards, actions] * self.k)]))
            seen = FactoredSpace(self.observation_space).planes
            if seen is None or seen.channels_last:
                self._planes = None
        if self._planes is None:
            flat = np.asarray(self._space.cardinalities, dtype=np.int64)
            bits = np.full(self._actions.n, 2, dtype=np.int64)
            self.observation_space = _space_of(np.concatenate([flat, *([flat, bits] * self.k)]))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """See gymnasium.Env."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._now = self._factors(obs)
        self._past.extend([(self._now, -1)] * self.k)
        return self._shown(), info

    def step(self, action: Any) -> tuple[NDArray[np.int64], Any, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._past.appendleft((self._now, int(self._actions.encode(_batch(action))[0])))
        self._now = self._factors(obs)
        return self._shown(), reward, terminated, truncated, info

    def _factors(self, obs: Any) -> NDArray[np.int64]:
        factors: NDArray[np.int64] = self._space.encode(_batch(obs))[0]
        return factors

    def _shown(self) -> NDArray[np.int64]:
        """The observation with its past, newest first."""
        planes = self._planes
        parts = []
        for factors, action in [(self._now, None), *self._past]:
            parts.append(factors if planes is None else planes.to_planes(factors[None])[0])
            if action is not None:
                bits = (np.arange(self._actions.n) == action).astype(np.int64)
                parts.append(bits if planes is None else np.broadcast_to(bits[:, None, None], (len(bits), *parts[0].shape[1:])))
        shown: NDArray[np.int64] = np.concatenate(parts).astype(self.observation_space.dtype)
        return shown


def _space_of(cardinalities: NDArray[np.int64]) -> spaces.MultiBinary | spaces.MultiDiscrete[Any]:
    """The space of variables with so many values each."""
    return spaces.MultiBinary(cardinalities.shape) if (cardinalities == 2).all() else spaces.MultiDiscrete(cardinalities)


def _batch(value: Any) -> Any:
    """A batch of one, laid out as ``batch_space`` does."""
    if isinstance(value, dict):
        return {key: _batch(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(_batch(part) for part in value)
    return np.asarray(value)[None]
