"""Maneuverer: reach the target among walls; each success leads to a new random layout."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mbagent_envs.game import Game, Scene, Sprite, as_floats, check_integer, check_number
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.types import Bits, Floats, Ints, Keys

ROW_MOVES = np.array([-1, 0, 1, 0], dtype=np.int64)
COLUMN_MOVES = np.array([0, 1, 0, -1], dtype=np.int64)


@compiled
def _draw_walls(key: np.uint64, density: float, row: int, column: int, walls: Bits) -> None:
    """Make each cell except the player's a wall with probability ``density``, given that some neighbour is free.

    Some cell is reachable if and only if a neighbour is free, so the distribution is that of drawing layouts until
    one has a reachable cell; direct conditioning takes the same time at every density. Number i of the key
    determines cell i.
    """
    size = walls.shape[0]
    for i in range(size * size):
        walls[i // size, i % size] = uniform_at(key, i) < density
    walls[row, column] = 0
    left = 0
    for move in range(4):
        left += 0 <= row + ROW_MOVES[move] < size and 0 <= column + COLUMN_MOVES[move] < size
    found = False
    for move in range(4):
        r, c = row + ROW_MOVES[move], column + COLUMN_MOVES[move]
        if not (0 <= r < size and 0 <= c < size):
            continue
        if not found:  # probability that this one is free, given that one of the `left` undecided ones is
            free = (1.0 - density) / (1.0 - density**left)
            walls[r, c] = uniform_at(key, r * size + c) < 1.0 - free
            found = walls[r, c] == 0
        left -= 1


@compiled
def _reachable(walls: Bits, row: int, column: int, queue: Ints) -> int:
    """Fill ``queue`` with the reachable cells (row * size + column), nearest first; return their number.

    The first is the cell itself. ``queue`` is int64 ``[size * size]``.
    """
    size = walls.shape[0]
    seen = walls.copy()
    seen[row, column] = 1
    queue[0] = row * size + column
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head] // size, queue[head] % size
        head += 1
        for move in range(4):
            rr, cc = r + ROW_MOVES[move], c + COLUMN_MOVES[move]
            if 0 <= rr < size and 0 <= cc < size and not seen[rr, cc]:
                seen[rr, cc] = 1
                queue[tail] = rr * size + cc
                tail += 1
    return tail


@compiled
def _draw_layout(key: np.uint64, density: float, row: int, column: int, planes: Bits) -> None:
    """Write a state with the player at (row, column) into ``planes``, int8 zeros ``[3, size, size]``."""
    size = planes.shape[1]
    planes[0, row, column] = 1
    _draw_walls(key, density, row, column, planes[1])
    queue = np.empty(size * size, dtype=np.int64)
    others = _reachable(planes[1], row, column, queue) - 1
    target = queue[1 + int(uniform_at(key, size * size) * others)]
    planes[2, target // size, target % size] = 1


@compiled
def _initial(keys: Keys, density: float, out: Bits) -> None:
    size = out.shape[2]
    for b in range(out.shape[0]):
        start = int(uniform_at(keys[b], size * size + 1) * size * size)
        _draw_layout(keys[b], density, start // size, start % size, out[b])


@compiled
def _transition(obs: Bits, actions: Ints, keys: Keys, density: float, out: Bits) -> None:
    size = obs.shape[2]
    for b in range(out.shape[0]):
        cell = 0
        while cell < size * size - 1 and obs[b, 0, cell // size, cell % size] == 0:
            cell += 1
        row, column = cell // size, cell % size
        if obs[b, 2, row, column]:
            _draw_layout(keys[b], density, row, column, out[b])
            continue
        out[b, 1] = obs[b, 1]
        out[b, 2] = obs[b, 2]
        r, c = row + ROW_MOVES[actions[b]], column + COLUMN_MOVES[actions[b]]
        if 0 <= r < size and 0 <= c < size and obs[b, 1, r, c] == 0:
            row, column = r, c
        out[b, 0, row, column] = 1


@compiled
def _all_reachable(obs: Bits) -> bool:
    size = obs.shape[2]
    queue = np.empty(size * size, dtype=np.int64)
    for b in range(obs.shape[0]):
        player = int(obs[b, 0].ravel().argmax())
        target = int(obs[b, 2].ravel().argmax())
        count = _reachable(obs[b, 1], player // size, player % size, queue)
        if not (queue[:count] == target).any():
            return False
    return True


class Maneuverer(Game):
    """A player moves around walls to a target; when it is reached, walls and target are drawn again at random.

    ## Description
    A square board of `size` x `size` cells with one player, walls and a target that the player can always reach.
    Each time it is reached, a new layout appears around the player, so that layouts are hardly ever repeated: to
    play well, one must have learned the effect of walls, not a particular maze. After Braylan and Miikkulainen
    (2015), section 5.

    ## Action Space
    `Discrete(4)`. If a wall or the edge blocks the move, the player stays in place.

    - 0: up
    - 1: right
    - 2: down
    - 3: left

    ## Observation Space
    `MultiBinary((3, size, size))`, the whole state, as planes: the player, the walls, the target; row 0 is
    the top.

    ## Starting State
    The player at a uniformly random cell. Every other cell is a wall with probability `wall_density`; the target
    is uniform over the other cells that the player can reach. If there is none, the layout is drawn again.

    ## Transition
    The player moves. If he stands on the target, the next step instead, for any action, leaves him in place and
    draws walls and target again as for a starting state.

    ## Rewards
    1 when the next observation has the player on the target, else 0.

    ## Episode End
    Nothing terminates an episode; it is truncated after 100 steps.

    ## Arguments
    ```python
    gym.make("mbagent/Maneuverer-v0", size=6, wall_density=0.2)
    ```
    - `size`: rows and columns of the board, at least 2.
    - `wall_density`: probability of a wall, in [0, 1).

    ## Other goals (`reward_functions`)
    - `"corner"`: 1 for standing in the top left cell.
    - `"next to target"`: 1 for standing directly above, right of, below or left of the target, not on it.
    - `"keep moving"`: 1 for every step that moves the player.
    - `"nook"`: 1 for standing where at least two of the four sides are blocked by a wall or the edge.

    ## Version History
    - v0: first version.
    """

    max_episode_steps: ClassVar[int] = 100

    def __init__(self, *, size: int = 6, wall_density: float = 0.2) -> None:
        """See the class."""
        self.size = check_integer("size", size, 2)
        self.wall_density = check_number("wall_density", wall_density, 0.0, 1.0, below=True)  # with 1, no cell could be reached
        goals = {
            "corner": self._corner,
            "next to target": self._next_to,
            "keep moving": self._moving,
            "nook": self._nook,
        }
        super().__init__(
            observation_shape=(3, self.size, self.size),
            action_names=("up", "right", "down", "left"),
            goals=goals,
        )

    def initial(self, keys: Keys) -> Bits:
        """Draw start states; see `Game.initial`."""
        out = np.zeros((len(keys), *self.observation_space.shape), dtype=np.int8)
        _initial(keys, self.wall_density, out)
        return out

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """Take one step in every row; see `Game.transition`."""
        out = np.zeros(obs.shape, dtype=np.int8)
        _transition(obs, actions.astype(np.int64, copy=False), keys, self.wall_density, out)
        return out

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Return 1 for standing on the target; see `Game.reward`."""
        return as_floats((next_obs[:, 0] & next_obs[:, 2]).any(axis=(1, 2)))

    def _corner(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats(next_obs[:, 0, 0, 0])

    def _next_to(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        adjacent = _sides(next_obs[:, 2], edge=0).any(axis=0)
        return as_floats((next_obs[:, 0] & adjacent).any(axis=(1, 2)))

    def _moving(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats((obs[:, 0] != next_obs[:, 0]).any(axis=(1, 2)))

    def _nook(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        narrow = _sides(next_obs[:, 1], edge=1).sum(axis=0) >= 2
        return as_floats((narrow & (next_obs[:, 0] == 1)).any(axis=(1, 2)))

    def transition_distribution(self, obs: Bits, action: int) -> tuple[Bits, Floats]:
        """Return the one successor of a move; see `Game.transition_distribution`.

        Raises:
            NotImplementedError: for a state with the player on the target, which any layout may follow.
        """
        if (obs[0] & obs[2]).any():
            raise NotImplementedError(
                "with the player on the target Maneuverer draws a new layout, one of too many to list; "
                "sample them with transition()."
            )
        return self.transition(obs[None], np.array([action]), np.zeros(1, dtype=np.uint64)), np.ones(1)

    def invalid(self, obs: Bits) -> str | None:
        """Describe why a row is not a state of this game; see `Game.invalid`."""
        for plane, name in ((0, "player"), (2, "target")):
            if (obs[:, plane].sum(axis=(1, 2)) != 1).any():
                return f"plane {plane} must hold exactly one 1 (the {name})"
            if (obs[:, plane] & obs[:, 1]).any():
                return f"the {name} must not stand in a wall"
        return None if _all_reachable(obs) else "the player must be able to reach the target"

    def scene(self, obs: Bits) -> Scene:
        """Return the board with one sprite per object."""
        player = "player scoring" if (obs[0] & obs[2]).any() else "player"
        things = [
            Sprite(kind, int(row), int(column))
            for plane, kind in ((1, "wall"), (2, "target"), (0, player))
            for row, column in np.argwhere(obs[plane])
        ]
        return Scene("board", self.size, self.size, tuple(things))


def _sides(plane: npt.NDArray[Any], edge: int) -> npt.NDArray[Any]:
    """Return the values above, right of, below and left of each cell: ``[B, h, w]`` -> ``[4, B, h, w]``."""
    padded = np.pad(plane, ((0, 0), (1, 1), (1, 1)), constant_values=edge)
    return np.stack([padded[:, :-2, 1:-1], padded[:, 1:-1, 2:], padded[:, 2:, 1:-1], padded[:, 1:-1, :-2]])
