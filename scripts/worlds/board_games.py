"""Games for which no model was designed, to test generality: two players at once, a box that is pushed, a switch for walls.

Their states are a square board of planes, like Maneuverer's; they have no reward, since they are not played.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mbagent.types import Bools, Floats, Ints
from mbagent_envs.game import Game, Scene
from mbagent_envs.random_keys import derive, uniforms
from mbagent_envs.types import Bits, Keys

ROWS, COLUMNS = np.array([-1, 0, 1, 0]), np.array([0, 1, 0, -1])
"""Moves up, right, down, left."""

REDRAWN = 7
"""Salt of the random numbers of a new layout."""


class BoardWorld(Game):
    """A board of three planes, size x size, and some further bits; some states lead to a new layout with any action."""

    max_episode_steps: ClassVar[int] = 100
    size: ClassVar[int] = 6
    wall_density: ClassVar[float] = 0.2
    n_switches: ClassVar[int] = 0

    def __init__(self) -> None:
        """Takes no arguments."""
        n_bits = 3 * self.size**2 + self.n_switches
        super().__init__(observation_shape=(n_bits,), action_names=("up", "right", "down", "left"), goals={})

    def over(self, obs: Bits) -> Bools:
        """Whether each state [B, n] is followed by a new layout, as is the case with a player on the target."""
        planes = self.planes(obs)
        return np.asarray((planes[:, 0] & planes[:, 2]).any(axis=1))

    @abstractmethod
    def move(self, obs: Bits, actions: Ints, keys: Keys) -> Bits:
        """Next observations [B, n] of states that are not over."""

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """See Game."""
        following = self.move(obs, actions.astype(np.int64), keys)
        ends = np.flatnonzero(self.over(obs))
        following[ends] = self.initial(derive(keys[ends], REDRAWN))
        return following

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Nothing."""
        return np.zeros(len(obs))

    def scene(self, obs: Bits) -> Scene:
        """Nothing to see."""
        return Scene("floor", self.size, self.size, ())

    def invalid(self, obs: Bits) -> str | None:
        """Takes any bits."""
        return None

    def planes(self, obs: Bits) -> Bits:
        """The planes [B, 3, size * size] of observations, as a view."""
        return obs[:, : 3 * self.size**2].reshape(len(obs), 3, self.size**2)

    def blank(self, n: int) -> Bits:
        """Empty observations [n, bits]."""
        return np.zeros((n, *self.observation_space.shape), dtype=np.int8)

    def step(self, cells: Ints, actions: Ints) -> tuple[Ints, Bools]:
        """The neighbouring cells [B] in the actions' directions, and whether they are on the board."""
        row, column = cells // self.size + ROWS[actions], cells % self.size + COLUMNS[actions]
        inside: Bools = (row >= 0) & (row < self.size) & (column >= 0) & (column < self.size)
        return np.where(inside, row * self.size + column, 0), inside

    def scatter(self, noise: Floats, things: tuple[Ints, ...]) -> Bits:
        """Layouts with objects in cells ``things`` of plane 0 (the last: plane 2) and random walls by ``noise`` [B, cells]."""
        obs, rows = self.blank(len(noise)), np.arange(len(noise))
        planes = self.planes(obs)
        planes[:, 1] = noise < self.wall_density
        for number, cells in enumerate(things):
            planes[rows, 2 if number == len(things) - 1 else 0, cells] = 1
            planes[rows, 1, cells] = 0
        return obs

    def cells_of(self, noise: Floats) -> Ints:
        """Cells chosen by uniform random numbers."""
        return (noise * self.size**2).astype(np.int64)


class TwoPlayers(BoardWorld):
    """Two players in one plane, both moved by the action; a new layout follows when one of them is on the target."""

    def initial(self, keys: Keys) -> Bits:
        """See Game."""
        noise = uniforms(keys, 3 + self.size**2)
        return self.scatter(noise[:, 3:], tuple(self.cells_of(noise[:, i]) for i in range(3)))

    def move(self, obs: Bits, actions: Ints, keys: Keys) -> Bits:
        """See BoardWorld."""
        following = obs.copy()
        before, after = self.planes(obs), self.planes(following)
        row, cell = np.nonzero(before[:, 0])
        target, inside = self.step(cell, actions[row])
        moves = inside & (before[row, 1, target] == 0)
        after[:, 0] = 0
        after[row, 0, np.where(moves, target, cell)] = 1
        return following


class PushedBox(BoardWorld):
    """A box that the player pushes if the cell behind it is free; a new layout follows when it is in a corner."""

    wall_density: ClassVar[float] = 0.15

    def initial(self, keys: Keys) -> Bits:
        """See Game."""
        noise, inner = uniforms(keys, 3 + self.size**2), self.size - 2
        row, column = 1 + (noise[:, 1] * inner).astype(np.int64), 1 + (noise[:, 2] * inner).astype(np.int64)
        player, box = self.cells_of(noise[:, 0]), row * self.size + column
        return self.scatter(noise[:, 3:], (player, np.where(box == player, (row % inner + 1) * self.size + column, box)))

    def over(self, obs: Bits) -> Bools:
        """See BoardWorld."""
        n = self.size
        return np.asarray(self.planes(obs)[:, 2][:, [0, n - 1, n * n - n, n * n - 1]].any(axis=1))

    def move(self, obs: Bits, actions: Ints, keys: Keys) -> Bits:
        """See BoardWorld."""
        following = obs.copy()
        before, after = self.planes(obs), self.planes(following)
        rows, player, box = np.arange(len(obs)), before[:, 0].argmax(axis=1), before[:, 2].argmax(axis=1)
        target, inside = self.step(player, actions)
        behind, beyond = self.step(target, actions)
        pushes = inside & (target == box)
        room = beyond & (before[rows, 1, behind] == 0)
        moves = inside & (before[rows, 1, target] == 0) & (~pushes | room)
        moved, pushed = np.flatnonzero(moves), np.flatnonzero(moves & pushes)
        after[moved, 0], after[pushed, 2] = 0, 0
        after[moved, 0, target[moved]] = 1
        after[pushed, 2, behind[pushed]] = 1
        return following


class Switch(BoardWorld):
    """Maneuverer with a switch that flips at random: walls block only while it is off."""

    n_switches: ClassVar[int] = 1

    def initial(self, keys: Keys) -> Bits:
        """See Game."""
        noise = uniforms(keys, 3 + self.size**2)
        obs = self.scatter(noise[:, 3:], (self.cells_of(noise[:, 0]), self.cells_of(noise[:, 1])))
        obs[:, -1] = noise[:, 2] < 0.5
        return obs

    def move(self, obs: Bits, actions: Ints, keys: Keys) -> Bits:
        """See BoardWorld."""
        following = obs.copy()
        before, after = self.planes(obs), self.planes(following)
        rows, player = np.arange(len(obs)), before[:, 0].argmax(axis=1)
        target, inside = self.step(player, actions)
        moved = np.flatnonzero(inside & ((before[rows, 1, target] == 0) | (obs[:, -1] == 1)))
        after[moved, 0] = 0
        after[moved, 0, target[moved]] = 1
        following[:, -1] ^= uniforms(keys, 1)[:, 0] < 0.1
        return following
