"""FlierCatcher: catch fliers that arrive from the right."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mbagent_envs.game import Game, Scene, Sprite, as_floats, check_flag, check_integer, check_number
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.types import Bits, Floats, Keys


@compiled
def _initial(keys: Keys, out: Bits) -> None:
    height = out.shape[2]
    for b in range(out.shape[0]):
        out[b, 0, int(uniform_at(keys[b], 0) * height), 0] = 1


@compiled
def _transition(obs: Bits, moves: Bits, keys: Keys, spawn_rate: float, out: Bits) -> None:
    height, width = obs.shape[2], obs.shape[3]
    for b in range(out.shape[0]):
        row = 0
        while row < height - 1 and obs[b, 0, row, 0] == 0:
            row += 1
        out[b, 0, min(max(row + moves[b], 0), height - 1), 0] = 1
        for r in range(height):
            for c in range(width - 1):
                out[b, 1, r, c] = obs[b, 1, r, c + 1]
        if uniform_at(keys[b], 0) < spawn_rate:
            out[b, 1, int(uniform_at(keys[b], 1) * height), width - 1] = 1


class FlierCatcher(Game):
    """A catcher moves up and down the left edge and catches fliers that arrive from the right.

    ## Description
    Fliers enter at the right edge, at most one at a time, and fly straight to the left, one column per step.
    Those that reach the player's cell are caught; the others disappear. Not all can be reached, so a good
    player plans ahead and chooses the path on which most can be caught. After Braylan and Miikkulainen (2015),
    section 5; staying in place is our addition.

    ## Action Space
    `Discrete(3)`; without `stay` it is `Discrete(2)`, numbered in the same order.

    - 0: up
    - 1: stay
    - 2: down

    ## Observation Space
    `MultiBinary((2, height, width))`, the whole state, as planes: the player (always in the first column),
    the fliers; row 0 is the top.

    ## Starting State
    The player at a uniformly random row of the first column; no fliers.

    ## Transition
    The player moves (but not beyond the edges), all fliers move one column to the left (those in the first column
    disappear), then with probability `spawn_rate` a new one appears at a uniformly random row of the last column.

    ## Rewards
    1 when, after the step, a flier is at the player's cell, else 0.

    ## Episode End
    Nothing terminates an episode; it is truncated after 200 steps.

    ## Arguments
    ```python
    gym.make("mbagent/FlierCatcher-v0", height=6, width=10, spawn_rate=0.4, stay=True)
    ```
    - `height`, `width`: rows and columns of the board, at least 2 each.
    - `spawn_rate`: probability of a new flier in a step, in [0, 1].
    - `stay`: whether the player may stay in place.

    ## Other goals (`reward_functions`)
    - `"avoid"`: -1 for every flier that touches the player.
    - `"top row"`: 1 for standing in the top row.
    - `"catch low"`: 1 for a flier touched in the lower half, -1 for one touched in the upper half.
    - `"follow"`: 1 while a flier is in the column next to the player, in the same row.

    ## Version History
    - v0: first version.
    """

    max_episode_steps: ClassVar[int] = 200

    def __init__(self, *, height: int = 6, width: int = 10, spawn_rate: float = 0.4, stay: bool = True) -> None:
        """See the class."""
        self.height = check_integer("height", height, 2)
        self.width = check_integer("width", width, 2)
        self.spawn_rate = check_number("spawn_rate", spawn_rate, 0.0, 1.0)
        self.stay = check_flag("stay", stay)
        moves = {"up": -1, "stay": 0, "down": 1}
        names = tuple(name for name in moves if self.stay or name != "stay")
        self._moves = np.array([moves[name] for name in names], dtype=np.int8)
        goals = {
            "avoid": self._avoid,
            "top row": self._top_row,
            "catch low": self._catch_low,
            "follow": self._follow,
        }
        super().__init__(observation_shape=(2, self.height, self.width), action_names=names, goals=goals)

    def initial(self, keys: Keys) -> Bits:
        """Draw start states; see `Game.initial`."""
        out = np.zeros((len(keys), *self.observation_space.shape), dtype=np.int8)
        _initial(keys, out)
        return out

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """Take one step in every row; see `Game.transition`."""
        out = np.zeros(obs.shape, dtype=np.int8)
        _transition(obs, self._moves[actions], keys, self.spawn_rate, out)
        return out

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Return 1 for a flier at the player's cell; see `Game.reward`."""
        return as_floats((next_obs[:, 0] & next_obs[:, 1]).any(axis=(1, 2)))

    def _avoid(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return -self.reward(obs, actions, next_obs)

    def _top_row(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats(next_obs[:, 0, 0, 0])

    def _catch_low(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        caught = (next_obs[:, 0] & next_obs[:, 1]).any(axis=2)
        half = self.height // 2
        return as_floats(caught[:, half:].any(axis=1)) - as_floats(caught[:, :half].any(axis=1))

    def _follow(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats((next_obs[:, 0, :, 0] & next_obs[:, 1, :, 1]).any(axis=1))

    def transition_distributions(self, obs: Bits, actions: npt.NDArray[Any]) -> tuple[Bits, Floats]:
        """Enumerate the new flier's rows, and no new flier; see `Game.transition_distributions`."""
        following = self.transition(obs, actions, np.zeros(len(obs), dtype=np.uint64))
        following[:, 1, :, -1] = 0
        outcomes = np.repeat(following[:, None], self.height + 1, axis=1)
        outcomes[:, 1:, 1, :, -1] = np.eye(self.height, dtype=np.int8)
        probabilities = np.full((len(obs), self.height + 1), self.spawn_rate / self.height)
        probabilities[:, 0] = 1 - self.spawn_rate
        return outcomes, probabilities

    def invalid(self, obs: Bits) -> str | None:
        """Describe why a row is not a state of this game; see `Game.invalid`."""
        if (obs[:, 0, :, 0].sum(axis=1) != 1).any() or obs[:, 0, :, 1:].any():
            return "plane 0 must hold exactly one 1, in its first column (the player)"
        if (obs[:, 1].sum(axis=1) > 1).any():
            return "plane 1 must hold at most one 1 in each column (the fliers)"
        return None

    def scene(self, obs: Bits) -> Scene:
        """Return the board with one sprite per object."""
        fliers = [Sprite("flier", int(row), int(column)) for row, column in np.argwhere(obs[1])]
        player = "player scoring" if (obs[0] & obs[1]).any() else "player"
        return Scene("sky", self.height, self.width, (*fliers, Sprite(player, int(obs[0, :, 0].argmax()), 0)))
