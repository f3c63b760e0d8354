"""GeyserRunner: run to the right, where the rewards are, and the geysers."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mbagent_envs.game import Game, Scene, Sprite, as_floats, check_flag, check_integer, check_number
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.types import Bits, Floats, Keys

MODES = ("stochastic", "deterministic")


@compiled
def _initial(keys: Keys, width: int, out: Bits) -> None:
    geysers = width // 2
    for row in range(out.shape[0]):
        out[row, 0] = 1
        out[row, width + int(uniform_at(keys[row], 0) * geysers)] = 1


@compiled
def _transition(obs: Bits, moves: Bits, keys: Keys, width: int, step: int, out: Bits) -> None:
    geysers = width // 2
    for row in range(out.shape[0]):
        position = 0
        while position < width - 1 and obs[row, position] == 0:
            position += 1
        out[row, min(max(position + moves[row], 0), width - 1)] = 1
        if step == 0:  # stochastic
            erupting = int(uniform_at(keys[row], 0) * geysers)
        else:
            erupting = 0
            while erupting < geysers - 1 and obs[row, width + erupting] == 0:
                erupting += 1
            erupting = (erupting + step) % geysers
        out[row, width + erupting] = 1


class GeyserRunner(Game):
    """A runner earns more the further right he stands, but the right half of the field is full of geysers.

    ## Description
    A field of `width` columns. Under each column of the right half there is a geyser, and exactly one of them
    erupts at any time. In the deterministic mode the eruptions follow a fixed cycle, and a good player runs to the
    right edge, stepping aside only to avoid a hit. In the stochastic mode the next eruption is unpredictable: if
    the cost of a hit is low, a good player runs straight to the right edge; if it is high, he stops at the last
    safe column (for `width=10` the break-even is `hit_cost = 25/9`). After Braylan and Miikkulainen (2015),
    section 4; staying in place is our addition.

    ## Action Space
    `Discrete(3)`; without `stay` it is `Discrete(2)`, numbered in the same order.

    - 0: left
    - 1: stay
    - 2: right

    ## Observation Space
    `MultiBinary(width + width // 2)`, the whole state: first the position, one-hot over the columns, then the
    eruption, one-hot over the columns of the right half, from left to right.

    ## Starting State
    The player at column 0; the eruption is uniformly random.

    ## Transition
    The player moves (but not beyond the edges), then the next geyser erupts. Stochastic: uniform over the `g =
    width // 2` geysers. Deterministic: geyser `k` is followed by `(k + m) mod g`, where `m` is the smallest
    number above 1 that is coprime to `g` (2 for `width=10`).

    ## Rewards
    `position / (width - 1)`, minus `hit_cost` when the new eruption is at the new position.

    ## Episode End
    Nothing terminates an episode; it is truncated after 100 steps.

    ## Arguments
    ```python
    gym.make("mbagent/GeyserRunner-v0", mode="stochastic", width=10, hit_cost=2.0, stay=True)
    ```
    - `mode`: `"stochastic"` or `"deterministic"` eruptions.
    - `width`: columns of the field, an even number of at least 4.
    - `hit_cost`: cost of a hit, any finite number.
    - `stay`: whether the player may stay in place.

    ## Other goals (`reward_functions`)
    - `"left"`: 1 at column 0.
    - `"middle"`: 1 at one of the two middle columns, the last safe one and the first dangerous one.
    - `"spray"`: 1 within one column of the erupting geyser, hit or not.
    - `"right edge"`: 1 at the last column, hit or not.

    ## Version History
    - v0: first version.
    """

    max_episode_steps: ClassVar[int] = 100

    def __init__(self, *, mode: str = "stochastic", width: int = 10, hit_cost: float = 2.0, stay: bool = True) -> None:
        """See the class."""
        if mode not in MODES:
            raise ValueError(f"mode must be 'stochastic' or 'deterministic', but it is {mode!r}.")
        self.mode = mode
        self.width = check_integer("width", width, 4)
        if self.width % 2:
            raise ValueError(f"width must be even (its right half holds the geysers), but it is {width}; take {width + 1}.")
        self.hit_cost = check_number("hit_cost", hit_cost, -math.inf, math.inf)
        self.stay = check_flag("stay", stay)
        geysers = self.width // 2
        self.cycle_step = next(m for m in range(2, geysers + 3) if math.gcd(m, geysers) == 1)
        moves = {"left": -1, "stay": 0, "right": 1}
        names = tuple(name for name in moves if self.stay or name != "stay")
        self._moves = np.array([moves[name] for name in names], dtype=np.int8)
        self._values = np.arange(self.width) / (self.width - 1)
        goals = {
            "left": self._left,
            "middle": self._middle,
            "spray": self._spray,
            "right edge": self._right_edge,
        }
        super().__init__(observation_shape=(self.width + geysers,), action_names=names, goals=goals)

    def initial(self, keys: Keys) -> Bits:
        """Draw start states; see `Game.initial`."""
        out = np.zeros((len(keys), *self.observation_space.shape), dtype=np.int8)
        _initial(keys, self.width, out)
        return out

    def transition(self, obs: Bits, actions: npt.NDArray[Any], keys: Keys) -> Bits:
        """Take one step in every row; see `Game.transition`."""
        out = np.zeros(obs.shape, dtype=np.int8)
        step = self.cycle_step if self.mode == "deterministic" else 0
        _transition(obs, self._moves[actions], keys, self.width, step, out)
        return out

    def reward(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        """Return position / (width - 1), minus ``hit_cost`` for a hit; see `Game.reward`."""
        hit = self._hit(obs, actions, next_obs)
        return as_floats(next_obs[:, : self.width] @ self._values - self.hit_cost * hit)

    def _hit(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        in_column = next_obs[:, self.width // 2 : self.width] & next_obs[:, self.width :]
        return as_floats(in_column.any(axis=1))

    def _left(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats(next_obs[:, 0])

    def _middle(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        half = self.width // 2
        return as_floats(next_obs[:, half - 1 : half + 1].any(axis=1))

    def _spray(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        half = self.width // 2
        wet = np.zeros((len(next_obs), self.width + 2), dtype=next_obs.dtype)  # one more column on each side
        for shift in range(3):
            wet[:, half + shift : self.width + shift] |= next_obs[:, self.width :]
        return as_floats((wet[:, 1:-1] & next_obs[:, : self.width]).any(axis=1))

    def _right_edge(self, obs: npt.NDArray[Any], actions: npt.NDArray[Any], next_obs: npt.NDArray[Any]) -> Floats:
        return as_floats(next_obs[:, self.width - 1])

    def transition_distributions(self, obs: Bits, actions: npt.NDArray[Any]) -> tuple[Bits, Floats]:
        """Enumerate the next eruptions; see `Game.transition_distributions`."""
        following = self.transition(obs, actions, np.zeros(len(obs), dtype=np.uint64))[:, None]
        if self.mode == "deterministic":
            return following, np.ones((len(obs), 1))
        geysers = self.width // 2
        outcomes = np.repeat(following, geysers, axis=1)
        outcomes[:, :, self.width :] = np.eye(geysers, dtype=np.int8)
        return outcomes, np.full((len(obs), geysers), 1 / geysers)

    def invalid(self, obs: Bits) -> str | None:
        """Describe why a row is not a state of this game; see `Game.invalid`."""
        if (obs[:, : self.width].sum(axis=1) != 1).any():
            return f"exactly one of the first {self.width} bits must be 1 (the position)"
        if (obs[:, self.width :].sum(axis=1) != 1).any():
            return f"exactly one of the last {self.width // 2} bits must be 1 (the eruption)"
        return None

    def scene(self, obs: Bits) -> Scene:
        """Return a field of three rows: the air, the runner's row, and the ground with the vents."""
        half = self.width // 2
        position, erupting = int(obs[: self.width].argmax()), half + int(obs[self.width :].argmax())
        ground = [Sprite("vent" if column >= half else "ground", 2, column) for column in range(self.width)]
        water = [
            Sprite("geyser top", 0, erupting),
            Sprite("geyser", 1, erupting),
            Sprite("open vent", 2, erupting),
        ]
        flag = Sprite("flag", 1, self.width - 1)
        player = Sprite("player hit" if position == erupting else "player", 1, position)
        return Scene("sky", 3, self.width, (*ground, flag, *water, player))
