"""Shared parts of the tests of the games: games with many arguments, a tiny game that terminates, a player."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mbagent.types import Bools, Floats
from mbagent_envs import FlierCatcher, Game, GeyserRunner, Maneuverer, RewardFn
from mbagent_envs.game import Scene, Sprite, as_floats
from mbagent_envs.random_keys import derive, uniforms
from mbagent_envs.references import ReferencePolicy
from mbagent_envs.types import Bits, Keys

VARIANTS: dict[str, list[dict[str, Any]]] = {
    "mbagent/GeyserRunner-v0": [
        {},
        {"mode": "deterministic"},
        {"hit_cost": 1, "stay": False},
        {"mode": "deterministic", "width": 4, "hit_cost": 0.5},
        {"width": 16, "hit_cost": 5.0},
    ],
    "mbagent/Maneuverer-v0": [
        {},
        {"size": 2},
        {"size": 3, "wall_density": 0.9},
        {"size": 9, "wall_density": 0},
    ],
    "mbagent/FlierCatcher-v0": [
        {},
        {"stay": False},
        {"height": 2, "width": 2, "spawn_rate": 1.0},
        {"height": 9, "width": 5, "spawn_rate": 0.0},
        {"height": 3, "width": 20, "spawn_rate": 1},
    ],
}
ID_ARGUMENTS = [(env_id, arguments) for env_id, several in VARIANTS.items() for arguments in several]
TYPES: dict[str, Callable[..., Game]] = {
    "mbagent/GeyserRunner-v0": GeyserRunner,
    "mbagent/Maneuverer-v0": Maneuverer,
    "mbagent/FlierCatcher-v0": FlierCatcher,
}
GAMES: list[Game] = [TYPES[env_id](**arguments) for env_id, arguments in ID_ARGUMENTS]
DEFAULTS: list[Game] = [TYPES[env_id]() for env_id in VARIANTS]


class Lottery(Game):
    """A game that terminates: three lamps, one lit; "go" lights a random one, and the last one ends the episode."""

    max_episode_steps: ClassVar[int] = 50

    def __init__(self, *, prize: float = 1.0) -> None:
        self.prize = prize
        super().__init__(observation_shape=(3,), action_names=("wait", "go"), goals={})

    def initial(self, keys: Keys) -> Bits:
        out = np.zeros((len(keys), 3), dtype=np.int8)
        out[:, 0] = 1
        return out

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        lit = (uniforms(keys, 1)[:, 0] * 3).astype(np.int64)
        return np.where(actions[:, None] == 1, np.eye(3, dtype=np.int8)[lit], obs)

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats(self.prize * next_obs[:, 2])

    def terminated(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Bools:
        return np.asarray(next_obs[:, 2] == 1)

    def invalid(self, obs: Bits) -> str | None:
        return "one lamp must be lit" if (obs.sum(axis=1) != 1).any() else None

    def scene(self, obs: Bits) -> Scene:
        return Scene("board", 1, 3, (Sprite("player", 0, int(obs.argmax())),))


def start_states(game: Game, count: int, seed: int = 0) -> Bits:
    """Return random start states ``[count, *shape]``."""
    return game.initial(derive(seed, np.arange(count)))


def wandered_states(game: Game, count: int, steps: int = 12, seed: int = 0) -> Bits:
    """Return states ``[count, *shape]`` after some random steps."""
    obs = start_states(game, count, seed)
    rng = np.random.default_rng(seed)
    for step in range(steps):
        actions = rng.integers(len(game.action_names), size=count)
        obs = game.transition(obs, actions, derive(seed + 1, step, np.arange(count)))
    return obs


def returns(game: Game, policy: ReferencePolicy | None, reward: RewardFn, episodes: int, seed: int) -> Floats:
    """Play whole episodes with ``policy`` (None: at random) and return the sum of rewards of each."""
    rng = np.random.default_rng(seed)
    keys = derive(seed, np.arange(episodes))
    obs, total = game.initial(derive(keys, 0)), np.zeros(episodes)
    for step in range(game.max_episode_steps):
        actions = rng.integers(len(game.action_names), size=episodes) if policy is None else policy(obs)
        next_obs = game.transition(obs, actions, derive(keys, step + 1))
        total += reward(obs, actions, next_obs)
        obs = next_obs
    return total
