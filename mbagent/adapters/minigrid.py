"""MiniGrid worlds, fully observed (``pip install "mbagent[minigrid]"``)."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray


class WholeGrid(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """A MiniGrid world whose observation is the whole grid and, optionally, the carried object.

    The channels of [width, height, 3] are object type, colour, and state (of a door) or direction (of the agent), as in
    ``minigrid.wrappers.FullyObsWrapper``, but without the mission text. A carried object is not on the grid; with ``carried``,
    it is shown in the lower right corner, which is otherwise always a wall.

    Args:
        env: a MiniGrid environment.
        carried: whether to show the object that the agent carries; for worlds with objects to pick up.
    """

    def __init__(self, env: gym.Env[Any, Any], carried: bool = False) -> None:
        """See the class."""
        _check_installed()
        from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX  # noqa: PLC0415 - an optional dependency

        gym.utils.RecordConstructorArgs.__init__(self, carried=carried)
        gym.ObservationWrapper.__init__(self, env)
        world: Any = env.unwrapped
        self.world = world
        self.carried = carried
        self._agent = OBJECT_TO_IDX["agent"], COLOR_TO_IDX["red"]
        self.observation_space = spaces.Box(0, 255, (world.width, world.height, 3), np.uint8)

    def observation(self, observation: Any) -> NDArray[np.uint8]:
        """The grid, uint8 [width, height, 3]."""
        del observation  # the partial view of the agent
        image: NDArray[np.uint8] = self.world.grid.encode()
        image[tuple(self.world.agent_pos)] = *self._agent, self.world.agent_dir
        if self.carried and self.world.carrying is not None:
            image[-1, -1] = self.world.carrying.encode()
        return image


def make_minigrid(env_id: str, *, carried: bool = False, **kwargs: Any) -> gym.Env[Any, Any]:
    """A MiniGrid world, fully observed.

    Args:
        env_id: name of the environment ("MiniGrid-Empty-5x5-v0").
        carried: see WholeGrid.
        **kwargs: passed to ``gym.make``.

    Raises:
        DependencyNotInstalled: minigrid is missing.
    """
    _check_installed()
    import minigrid  # noqa: F401, PLC0415 - an optional dependency, which registers its worlds

    return WholeGrid(gym.make(env_id, **kwargs), carried)


def minigrid_factory(env_id: str, *, carried: bool = False, **kwargs: Any) -> Callable[[], gym.Env[Any, Any]]:
    """A picklable zero-argument function that creates environments, for SubprocVecEnv. See ``make_minigrid``."""
    return partial(make_minigrid, env_id, carried=carried, **kwargs)


def _check_installed() -> None:
    if importlib.util.find_spec("minigrid") is None:
        raise DependencyNotInstalled('MiniGrid worlds need minigrid: pip install "mbagent[minigrid]".')
