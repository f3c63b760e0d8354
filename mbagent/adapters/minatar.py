"""MinAtar games as planes of bits (``pip install "mbagent[minatar]"``).

Young and Tian 2019, "MinAtar: an Atari-inspired testbed for thorough and reproducible reinforcement learning experiments".
"""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from mbagent.wrappers import History


class MinAtarEnv(gym.Env[NDArray[np.int8], np.int64], gym.utils.EzPickle):
    """A MinAtar game with binary observations [channels, 10, 10] and only the actions that have an effect in this game.

    Args:
        game: "asterix", "breakout", "freeway", "seaquest" or "space_invaders".
        sticky: probability that the previous action is repeated instead of the chosen one.
        ramping: whether the game becomes more difficult over time.

    Raises:
        DependencyNotInstalled: minatar is missing.
        ValueError: there is no such game.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(self, game: str, sticky: float = 0.1, ramping: bool = True) -> None:
        """See the class."""
        if importlib.util.find_spec("minatar") is None:
            raise DependencyNotInstalled('MinAtar games need minatar: pip install "mbagent[minatar]".')
        from minatar import Environment  # noqa: PLC0415 - an optional dependency

        gym.utils.EzPickle.__init__(self, game, sticky, ramping)
        if importlib.util.find_spec(f"minatar.environments.{game}") is None:
            raise ValueError(f"MinAtar has no game {game!r}; its games are asterix, breakout, freeway, seaquest, space_invaders.")
        self._game = Environment(game, sticky_action_prob=sticky, difficulty_ramping=ramping)
        self._actions = self._game.minimal_action_set()
        height, width, channels = self._game.state_shape()
        self.observation_space = spaces.MultiBinary([channels, height, width])
        self.action_space = spaces.Discrete(len(self._actions))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[np.int8], dict[str, Any]]:
        """See gymnasium.Env."""
        super().reset(seed=seed)
        if seed is not None:
            self._game.seed(seed)
        self._game.reset()
        return self._frame(), {}

    def step(self, action: Any) -> tuple[NDArray[np.int8], float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        reward, over = self._game.act(self._actions[int(action)])
        return self._frame(), float(reward), bool(over), False, {}

    def _frame(self) -> NDArray[np.int8]:
        return np.ascontiguousarray(np.moveaxis(self._game.state(), 2, 0).astype(np.int8))


def make_minatar(game: str, *, k: int = 1, max_episode_steps: int = 1000, **kwargs: Any) -> gym.Env[Any, Any]:
    """A MinAtar game whose observation includes the previous ``k`` frames and actions; see History.

    This history is needed to predict sticky actions and objects that move only in some frames.

    Args:
        game: see MinAtarEnv.
        k: number of previous frames; 0 for the current frame only.
        max_episode_steps: steps after which an episode is truncated, since a good player might never lose.
        **kwargs: passed to MinAtarEnv.
    """
    env: gym.Env[Any, Any] = TimeLimit(MinAtarEnv(game, **kwargs), max_episode_steps)
    return History(env, k) if k else env
