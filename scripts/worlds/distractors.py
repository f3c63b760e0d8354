"""Synthetic environments with known rules: a controllable core, given as a table, and distractor bits that change at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.models.protocol import TransitionModel
from mbagent.types import Actions, Bools, Ints, States

FLICKER = 0.3
"""Probability that a distractor bit changes in a step."""

DRAWN = 40
"""Samples per (state, action) for measuring the model error."""


@dataclass(frozen=True)
class Core:
    """The controllable core.

    Attributes:
        values: the factors of its S states, int64 [S, K].
        going: the next state, int64 [S, A].
        over: whether the episode terminates, bool [S, A].
        slip: probability that a random action replaces the chosen one.
    """

    values: Ints
    going: Ints
    over: Bools
    slip: float = 0.0

    def reachable(self) -> Ints:
        """Non-terminal states that an episode can reach; all episodes start in state 0."""
        visited: set[int] = set()
        stack = [0]
        while stack:
            if (state := stack.pop()) not in visited:
                visited.add(state)
                stack += [int(s) for s in self.going[state][~self.over[state]]]
        return np.array(sorted(visited))


@dataclass(frozen=True)
class DistractorWorld:
    """A core with distractor bits.

    Attributes:
        name: name in the results.
        core: creates the core.
        bits: number of distractor bits.
        limit: steps after which an episode is truncated.
    """

    name: str
    core: Callable[[], Core]
    bits: int
    limit: int

    @cached_property
    def known(self) -> Core:
        """The core."""
        return self.core()

    def make(self) -> gym.Env[Any, Any]:
        """A new copy."""
        return gym.wrappers.TimeLimit(_DistractorEnv(self.known, self.bits), self.limit)

    def wrongness(self, model: TransitionModel, numbers: Ints, actions: Actions) -> float:
        """Mean total variation between a model and the rules, for core states [N] and actions [N] with random distractor bits."""
        rng, core, n = np.random.default_rng(0), self.known, len(actions) * DRAWN
        numbers, actions = np.repeat(numbers, DRAWN), np.repeat(actions, DRAWN)
        bits, flipped = rng.integers(2, size=(n, self.bits)), rng.random((n, self.bits)) < FLICKER
        taken = np.where(rng.random(n) < core.slip, rng.integers(core.going.shape[1], size=n), actions)
        target, over = core.going[numbers, taken], core.over[numbers, taken]
        same = (core.going[numbers] == target[:, None]) & (core.over[numbers] == over[:, None])
        shares: NDArray[np.float64] = same.mean(axis=1)
        chances = core.slip * shares + (1.0 - core.slip) * same[np.arange(n), actions]
        truth = np.log(chances) + np.log(np.where(flipped, FLICKER, 1.0 - FLICKER)).sum(axis=1)
        before, after = np.hstack([core.values[numbers], bits]), np.hstack([core.values[target], bits ^ flipped])
        said = model.log_prob(before, actions, after, over)
        return float(np.maximum(0.0, 1.0 - np.exp(said - truth)).mean())

    def tried(self, states: States, actions: Actions) -> float:
        """Share of the core's reachable (state, action) that occur in transitions [N]."""
        core = self.known
        visited = np.unique(np.column_stack([states[:, : core.values.shape[1]], actions]), axis=0)
        return len(visited) / core.going[core.reachable()].size


class _DistractorEnv(gym.Env[Any, Any]):
    def __init__(self, core: Core, bits: int) -> None:
        self.core, self.bits, self.state = core, np.zeros(bits, dtype=np.int64), 0
        self.observation_space = gym.spaces.MultiDiscrete([*(core.values.max(axis=0) + 1), *[2] * bits])
        self.action_space = gym.spaces.Discrete(core.going.shape[1])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state, self.bits = 0, self.np_random.integers(2, size=len(self.bits))
        return self._shown(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        core, rng = self.core, self.np_random
        taken = rng.integers(core.going.shape[1]) if rng.random() < core.slip else action
        over, self.state = bool(core.over[self.state, taken]), int(core.going[self.state, taken])
        self.bits ^= rng.random(len(self.bits)) < FLICKER
        return self._shown(), 0.0, over, False, {}

    def _shown(self) -> Ints:
        return np.concatenate([self.core.values[self.state], self.bits])


def chain(n: int) -> Core:
    """One of two actions moves forward (which one differs between cells); the other leads back to the start."""
    right, cells = np.random.default_rng(n).integers(2, size=n), np.arange(n)
    going = np.zeros((n, 2), dtype=np.int64)
    going[cells, right] = (cells + 1) % n
    return Core(cells[:, None], going, np.zeros((n, 2), dtype=np.bool_))


def grid(n: int, walls: float = 0.0) -> Core:
    """A grid of n times n cells with four moves; a share of the cells, except in the first row and column, are walls."""
    free = np.random.default_rng(n).random((n, n)) >= walls
    free[0], free[:, 0] = True, True
    values = np.argwhere(np.ones((n, n), dtype=np.bool_))
    after = np.clip(values[:, None] + [(0, 1), (0, -1), (1, 0), (-1, 0)], 0, n - 1)
    going = np.where(free[after[..., 0], after[..., 1]], after @ [n, 1], np.arange(n * n)[:, None])
    return Core(values, going, np.zeros(going.shape, dtype=np.bool_))


def key_and_door(n: int) -> Core:
    """A grid divided by a wall with a door, which a player who stands in front of it with the key can open and shut.

    Actions are four moves, take, and use. Factors are row, column, whether the key was taken, whether the door is open.
    """
    sizes, wall = (n, n, 2, 2), n // 2
    values = np.array(list(np.ndindex(*sizes)))
    going = np.repeat(np.arange(len(values))[:, None], 6, axis=1)
    for number, (row, column, key, door) in enumerate(values.tolist()):
        for action, (down, right) in enumerate([(0, 1), (0, -1), (1, 0), (-1, 0)]):
            r, c = min(max(row + down, 0), n - 1), min(max(column + right, 0), n - 1)
            if c != wall or (r == n - 1 and door):
                going[number, action] = np.ravel_multi_index((r, c, key, door), sizes)
        if (row, column) == (n - 1, 0):
            going[number, 4] = np.ravel_multi_index((row, column, 1, door), sizes)
        if (row, column) == (n - 1, wall - 1) and key:
            going[number, 5] = np.ravel_multi_index((row, column, key, 1 - door), sizes)
    return Core(values, going, np.zeros(going.shape, dtype=np.bool_))


def nothing(n_actions: int) -> Core:
    """A single state."""
    return Core(np.zeros((1, 1), dtype=np.int64), np.zeros((1, n_actions), np.int64), np.zeros((1, n_actions), np.bool_))


DISTRACTORS = (
    DistractorWorld("chain of 16, 10 lights", lambda: chain(16), 10, 200),
    DistractorWorld("maze 12x12, 10 lights", lambda: grid(12, 0.3), 10, 200),
    DistractorWorld("grid 20x20", lambda: grid(20), 0, 200),
    DistractorWorld("grid 30x30", lambda: grid(30), 0, 200),
    DistractorWorld("key and door 8x8, 8 lights", lambda: key_and_door(8), 8, 200),
    DistractorWorld("14 lights", lambda: nothing(4), 14, 200),
)
"""Environments for measuring exploration; the distractor bits are flickering lights."""
