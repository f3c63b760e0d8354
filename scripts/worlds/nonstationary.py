"""Games whose rules change during learning: other geysers, fliers from the other side, a mirrored control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from mbagent.types import Floats
from mbagent_envs import FlierCatcher, GeyserRunner, Maneuverer
from mbagent_envs.game import Game, Scene
from mbagent_envs.types import Bits, Keys


class Relabelled(Game):
    """A game with permuted bits and actions, so that the same states follow different rules.

    Args:
        game: the game.
        bits: index of the game's bit for each bit.
        actions: index of the game's action for each action.
    """

    def __init__(self, game: Game, bits: Sequence[int] | None = None, actions: Sequence[int] | None = None) -> None:
        """See the class."""
        shape = game.observation_space.shape
        super().__init__(observation_shape=shape, action_names=game.action_names, goals={})
        n = int(np.prod(shape))
        self._game = game
        self._bits = np.arange(n) if bits is None else np.asarray(bits)
        self._back = np.argsort(self._bits)
        self._actions = np.arange(len(game.action_names)) if actions is None else np.asarray(actions)

    def _renamed(self, obs: Bits, order: npt.NDArray[np.int64]) -> Bits:
        return np.ascontiguousarray(obs.reshape(len(obs), -1)[:, order].reshape(obs.shape))

    def initial(self, keys: Keys) -> Bits:
        """See Game."""
        return self._renamed(self._game.initial(keys), self._bits)

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """See Game."""
        following = self._game.transition(self._renamed(obs, self._back), self._actions[actions.astype(np.int64)], keys)
        return self._renamed(following, self._bits)

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Zero, since the game is not played."""
        return np.zeros(len(obs))

    def scene(self, obs: Bits) -> Scene:
        """Nothing to see."""
        return Scene("floor", 1, 1, ())

    def invalid(self, obs: Bits) -> str | None:
        """Takes any bits."""
        return None


def other_geysers() -> tuple[Game, Game]:
    """Geysers that erupt one after another, and in the opposite order."""
    game = GeyserRunner(mode="deterministic")
    n, half = 15, 10
    return game, Relabelled(game, bits=[*range(half), *range(n - 1, half - 1, -1)])


def other_fliers() -> tuple[Game, Game]:
    """Fliers from the right, and from the left."""
    game = FlierCatcher()
    numbers = np.arange(120).reshape(2, 6, 10)
    numbers[1] = numbers[1, :, ::-1]
    return game, Relabelled(game, bits=numbers.ravel().tolist())


def mirrored_control() -> tuple[Game, Game]:
    """Up and down, and left and right, are exchanged."""
    game = Maneuverer()
    return game, Relabelled(game, actions=[2, 3, 0, 1])


CHANGES = {
    "geysers in the opposite order": other_geysers,
    "fliers from the other side": other_fliers,
    "mirrored control": mirrored_control,
}
