"""Three stochastic games for Gymnasium; importing this package registers them.

>>> import gymnasium as gym
>>> import mbagent_envs
>>> env = gym.make("mbagent/Maneuverer-v0", size=6, wall_density=0.2)
>>> envs = gym.make_vec("mbagent/FlierCatcher-v0", num_envs=64)

The ids are ``mbagent/GeyserRunner-v0``, ``mbagent/Maneuverer-v0`` and ``mbagent/FlierCatcher-v0``; the classes
of the same names document their rules and arguments.
"""

from __future__ import annotations

import gymnasium as gym

from mbagent_envs.env import GAMES, GameEnv
from mbagent_envs.flier_catcher import FlierCatcher
from mbagent_envs.game import Game, InvalidActionError, RewardFn
from mbagent_envs.geyser_runner import GeyserRunner
from mbagent_envs.maneuverer import Maneuverer
from mbagent_envs.vector_env import GameVectorEnv

__all__ = [
    "ENV_IDS",
    "FlierCatcher",
    "Game",
    "GameEnv",
    "GameVectorEnv",
    "GeyserRunner",
    "InvalidActionError",
    "Maneuverer",
    "RewardFn",
    "register_envs",
]

ENV_IDS = tuple(f"mbagent/{name}-v0" for name in GAMES)
"""The registered ids."""


def register_envs() -> None:
    """Register the games with Gymnasium, unless they are already registered."""
    for env_id, (name, game_type) in zip(ENV_IDS, GAMES.items(), strict=True):
        if env_id not in gym.registry:
            gym.register(
                id=env_id,
                entry_point="mbagent_envs.env:GameEnv",
                vector_entry_point="mbagent_envs.vector_env:GameVectorEnv",
                max_episode_steps=game_type.max_episode_steps,
                kwargs={"game": name},
            )


register_envs()
