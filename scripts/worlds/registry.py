"""The environments of the studies, by name."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import DiscretizeObservation, TransformObservation

import mbagent_envs  # noqa: F401 - registers
from harness import find
from mbagent.adapters.minatar import make_minatar
from mbagent.adapters.minigrid import make_minigrid
from mbagent.adapters.rddl import RddlEnv
from worlds import toy_mdps  # noqa: F401 - registers

TAXI = "Taxi-v4" if "Taxi-v4" in gym.registry else "Taxi-v3"
"""Newest version that is installed."""


@dataclass(frozen=True)
class World:
    """One environment.

    Attributes:
        name: name in the results.
        kind: the package it is from or resembles; "game" for this repository's games, "binned" for discretised continuous
            environments, "planes" for tabular MDPs observed as planes.
        target: id for ``gym.make``, or name of an RDDL domain or of a game.
        kwargs: further arguments.
        steps: environment steps for learning.
        bins: number of bins of each dimension, if it is binned.
        bounds: bounds to which each dimension is clipped first; empty for no clipping.
        settings: settings of the agent that differ from its defaults.
    """

    name: str
    kind: Literal["game", "toy_text", "rddl", "minigrid", "binned", "minatar", "planes"]
    target: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 20_000
    bins: tuple[int, ...] = ()
    bounds: tuple[float, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def missing(self) -> str | None:
        """The extra that must be installed first, or None."""
        needed = {"rddl": ("pyRDDLGym", "rddlrepository"), "minigrid": ("minigrid",), "minatar": ("minatar",)}.get(self.kind, ())
        return self.kind if any(importlib.util.find_spec(name) is None for name in needed) else None

    def make(self, **more: Any) -> gym.Env[Any, Any]:
        """A new copy, with further arguments that override its own."""
        kwargs = {**self.kwargs, **more}
        if self.kind == "rddl":
            return RddlEnv(self.target, **kwargs)
        if self.kind == "minigrid":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                return make_minigrid(self.target, **kwargs)
        if self.kind == "minatar":
            return make_minatar(self.target, **kwargs)
        env = gym.make(self.target, **kwargs)
        env = clipped(env, self.bounds) if self.bounds else env
        return DiscretizeObservation(env, self.bins, multidiscrete=True) if self.bins else env

    def make_for_networks(self) -> gym.Env[Any, Any]:
        """A new copy in the best form for SB3's networks: images of numbers as a row of small floats."""
        return for_networks(self.make())


WORLDS = (
    World("FrozenLake 4x4", "toy_text", "FrozenLake-v1", {"map_name": "4x4"}),
    World("FrozenLake 8x8", "toy_text", "FrozenLake-v1", {"map_name": "8x8"}, steps=50_000),
    World("CliffWalking", "toy_text", "CliffWalking-v1", {"max_episode_steps": 200}),
    World("Taxi", "toy_text", TAXI),
    World("SysAdmin", "rddl", "SysAdmin_MDP_ippc2011"),
    World("GameOfLife", "rddl", "GameOfLife_MDP_ippc2011"),
    World("Navigation", "rddl", "Navigation_MDP_ippc2011"),
    World("CrossingTraffic", "rddl", "CrossingTraffic_MDP_ippc2011"),
    World("SkillTeaching", "rddl", "SkillTeaching_MDP_ippc2011"),
    World("MiniGrid Empty", "minigrid", "MiniGrid-Empty-5x5-v0"),
    World("MiniGrid Dynamic-Obstacles", "minigrid", "MiniGrid-Dynamic-Obstacles-5x5-v0"),
    World("Inventory", "toy_text", "mbagent/Inventory-v0", steps=3000),
    World("DeepSea", "planes", "mbagent/DeepSea-v0", steps=3000),
)
"""The development set; the agent's settings are the same for all."""

_GEYSER = "mbagent/GeyserRunner-v0"

GAMES = (
    World("GeyserRunner, stochastic", "game", _GEYSER),
    World("GeyserRunner, deterministic", "game", _GEYSER, {"mode": "deterministic"}),
    World("GeyserRunner, stochastic, hit cost 1", "game", _GEYSER, {"mode": "stochastic", "hit_cost": 1.0}),
    World("GeyserRunner, stochastic, hit cost 5", "game", _GEYSER, {"mode": "stochastic", "hit_cost": 5.0}),
    World("Maneuverer", "game", "mbagent/Maneuverer-v0"),
    World("FlierCatcher", "game", "mbagent/FlierCatcher-v0"),
)
"""This repository's games, with the arguments that the studies use."""


CONTINUOUS = (
    World("CartPole, binned", "binned", "CartPole-v1", bins=(3, 3, 8, 8), bounds=(2.4, 3.0, 0.21, 3.0)),
    World("MountainCar, binned", "binned", "MountainCar-v0", bins=(30, 30), settings={"exploration": "persistent"}),
)
"""The examples of docs/environments.md."""


ARCADE = (
    World("MinAtar Breakout", "minatar", "breakout", steps=100_000),
    World("MinAtar Asterix", "minatar", "asterix", steps=100_000),
)
"""Games of scripts/learning_curves.py, with sticky actions, increasing difficulty and a history of one step."""


REGISTRY = {world.name: world for world in (*WORLDS, *CONTINUOUS, *ARCADE, *GAMES)}
"""All environments of the studies, by name."""


def find_world(name: str) -> World:
    """The world called ``name``.

    Raises:
        ValueError: there is none; the message lists the known names.
    """
    return find("world", name, REGISTRY)


def clipped(env: gym.Env[Any, Any], bounds: tuple[float, ...]) -> gym.Env[Any, Any]:
    """The same environment with each variable clipped to its bound and the negative of it."""
    high = np.array(bounds, dtype=np.float32)
    return TransformObservation(env, lambda obs: np.clip(obs, -high, high), gym.spaces.Box(-high, high))


def for_networks(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Images as a row of floats, divided by 10: SB3 would divide by 255 and give the networks values close to 0."""
    space = env.observation_space
    if not isinstance(space, gym.spaces.Box):
        return env
    row = gym.spaces.Box(0.0, 25.5, (int(np.prod(space.shape)),), dtype=np.float32)
    return TransformObservation(env, _row, row)


def _row(observation: Any) -> Any:
    return np.ravel(observation).astype(np.float32) / 10
