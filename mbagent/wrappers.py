"""Wrappers that adapt environments to one-step models."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.spaces import MAX_DECLARED, ActionEnumeration, FactoredSpace


class History(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds the previous ``k`` observations and actions to the observation.

    Use it for environments whose next state depends on more than the current observation; a one-step model then has the
    information that it needs. A stack of planes remains a stack, channels first. Each step back adds the channels of the older
    observation and one plane for each action: 1 everywhere for the action taken, else 0 everywhere. The observation becomes a
    vector if it is not a stack of planes, or if the channels would then be mistaken for rows (boards that are not square, with
    more channels than columns or as many as rows). The vector contains the variables of the current observation; then, for each
    step back, those of the older observation and one bit for each action. Before the first step, the older observations are
    copies of the first one, and all action bits are 0.

    Args:
        env: an environment with discrete spaces (see FactoredSpace).
        k: number of steps back, at least 1.

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
        return self._with_history(), info

    def step(self, action: Any) -> tuple[NDArray[np.int64], Any, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._past.appendleft((self._now, int(self._actions.encode(_batch(action))[0])))
        self._now = self._factors(obs)
        return self._with_history(), reward, terminated, truncated, info

    def _factors(self, obs: Any) -> NDArray[np.int64]:
        factors: NDArray[np.int64] = self._space.encode(_batch(obs))[0]
        return factors

    def _with_history(self) -> NDArray[np.int64]:
        """The current observation and its history, newest first."""
        planes = self._planes
        parts = []
        for factors, action in [(self._now, None), *self._past]:
            parts.append(factors if planes is None else planes.to_planes(factors[None])[0])
            if action is not None:
                bits = (np.arange(self._actions.n) == action).astype(np.int64)
                parts.append(bits if planes is None else np.broadcast_to(bits[:, None, None], (len(bits), *parts[0].shape[1:])))
        shown: NDArray[np.int64] = np.concatenate(parts).astype(self.observation_space.dtype)
        return shown


class Flat(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Flattens a nested observation to one Dict of all elementary parts.

    SB3's vector environments support Dicts and Tuples, but not nested ones. A part's key is its path, joined by dots
    ("robot.arm", "sensors.0"). An observation that is neither a Dict nor a Tuple becomes a Dict with one part, "obs".

    Args:
        env: an environment; its observation space may nest Dicts and Tuples to any depth.

    Raises:
        ValueError: two parts would have the same key.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """See the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        parts = dict(_parts(env.observation_space))
        self._keys = {path: ".".join(map(str, path)) or "obs" for path in parts}
        if len(set(self._keys.values())) < len(parts):
            twice = next(key for key in self._keys.values() if list(self._keys.values()).count(key) > 1)
            raise ValueError(f"Two parts of the observation would be called {twice!r}; rename one in an ObservationWrapper.")
        self.observation_space = spaces.Dict({self._keys[path]: part for path, part in parts.items()})

    def observation(self, observation: Any) -> dict[str, Any]:
        """The flat observation."""
        found = {}
        for path, key in self._keys.items():
            part = observation
            for step in path:
                part = part[step]
            found[key] = part
        return found


class Bits(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Replaces an observation that is one large number with the number's binary digits, highest first.

    Use it for a large ``Discrete`` space if the binary digits of its values have separate meanings, such as flags packed into
    one number; a model can then learn each bit separately. If the individual digits have no meaning, keep the number.

    Args:
        env: an environment whose observation space is Discrete.

    Raises:
        TypeError: the observation space is not Discrete.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """See the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        if not isinstance(env.observation_space, spaces.Discrete):
            raise TypeError(f"Bits needs a Discrete observation space, got {env.observation_space}.")
        self._low, n = int(env.observation_space.start), int(env.observation_space.n)
        self._shifts = np.arange(max(1, (n - 1).bit_length()))[::-1]
        self.observation_space = spaces.MultiBinary(len(self._shifts))

    def observation(self, observation: Any) -> NDArray[np.int8]:
        """The number's digits, int8 [bits]."""
        return ((int(observation) - self._low) >> self._shifts & 1).astype(np.int8)

    def number(self, bits: NDArray[Any]) -> NDArray[np.int64]:
        """The numbers [...] with the binary digits ``bits`` [..., n]; the inverse of ``observation``."""
        weighed: NDArray[np.int64] = (np.asarray(bits, dtype=np.int64) << self._shifts).sum(axis=-1) + self._low
        return weighed


def _parts(space: spaces.Space[Any], path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], spaces.Space[Any]]]:
    """Yields (path, elementary space) for every elementary space inside ``space``."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for key, part in space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces):
            yield from _parts(part, (*path, key))
    else:
        yield path, space


def _space_of(cardinalities: NDArray[np.int64]) -> spaces.MultiBinary | spaces.MultiDiscrete[Any] | spaces.Box:
    """A space of variables with the given ``cardinalities``; a Box if any variable has more than ``MAX_DECLARED`` values."""
    if (cardinalities == 2).all():
        return spaces.MultiBinary(cardinalities.shape)
    if cardinalities.max() <= MAX_DECLARED:
        return spaces.MultiDiscrete(cardinalities)
    return spaces.Box(np.zeros_like(cardinalities), cardinalities - 1, dtype=np.int64)


def _batch(value: Any) -> Any:
    """``value`` as a batch of one, in the form of ``batch_space``."""
    if isinstance(value, dict):
        return {key: _batch(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(_batch(part) for part in value)
    return np.asarray(value)[None]
