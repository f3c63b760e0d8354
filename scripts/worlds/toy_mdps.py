"""Toy MDPs for properties that Gymnasium's own do not test, as tables in the layout of toy_text; importing registers them.

``mbagent/Inventory-v0``: random sums, clipped to bounds. ``mbagent/DeepSea-v0`` (Osband et al. 2020, Behaviour
suite for reinforcement learning): a plane of bits, where the effects of actions depend on the position.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy import stats

Outcome = tuple[float, int, float, bool]
"""Probability, next state, reward, whether the episode terminates."""


class TableEnv(gym.Env[Any, Any]):
    """An MDP given by its table.

    Args:
        table: outcomes of each action in each state, ``table[state][action]``.
        start: the start state of all episodes.
        observations: observation of each state, [S, ...].
        space: observation space.

    Attributes:
        P: the table, with the name used in toy_text.
        initial_state_distrib: probability of each state as start state, float64 [S].
    """

    def __init__(self, table: list[list[list[Outcome]]], start: int, observations: NDArray[Any], space: gym.Space[Any]) -> None:
        """See the class."""
        self.P, self.observations, self.state = table, observations, start
        self.initial_state_distrib = np.eye(len(table))[start]
        self.observation_space, self.action_space = space, gym.spaces.Discrete(len(table[0]))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        super().reset(seed=seed)
        self.state = int(np.argmax(self.initial_state_distrib))
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        outcomes = self.P[self.state][int(action)]
        _, self.state, reward, over = outcomes[self.np_random.choice(len(outcomes), p=[outcome[0] for outcome in outcomes])]
        return self._seen(), reward, over, False, {}

    def _seen(self) -> Any:
        """The current observation, as a copy or a number."""
        return self.observations[[self.state]][0]


def inventory(capacity: int = 20, most: int = 10, demand: float = 4.0, start: int = 5) -> TableEnv:
    """A shop: orders arrive before the day's customers, and items beyond the capacity are lost.

    Args:
        capacity: largest stock.
        most: largest order.
        demand: mean of the daily demand, which has a Poisson distribution.
        start: initial stock.

    A sale earns 6, an ordered item costs 1, and an item stored overnight 0.1. (A classic example, as in Szepesvari 2010,
    Algorithms for Reinforcement Learning, example 1.)
    """
    table: list[list[list[Outcome]]] = []
    for stock in range(capacity + 1):
        table.append([])
        for order in range(most + 1):
            level = min(stock + order, capacity)
            sold = np.arange(level + 1)
            chances = stats.poisson.pmf(sold, demand)
            chances[level] = stats.poisson.sf(level - 1, demand)
            left = [
                (float(p), level - n, 6.0 * n - order - 0.1 * (level - n), False)
                for n, p in zip(sold.tolist(), chances, strict=True)
            ]
            table[-1].append(left)
    return TableEnv(table, start, np.arange(capacity + 1), gym.spaces.Discrete(capacity + 1))


def deep_sea(size: int = 10, slip: float = 0.0, seed: int = 0) -> TableEnv:
    """A diver sinks by one row per step, to the right or to the left; which action is which differs between cells.

    Args:
        size: rows and columns.
        slip: probability that a step goes in the other direction.
        seed: seed of the meaning of the actions in each cell.

    Each step to the right costs 0.01 / size, and the treasure in the last cell, reached only by steps to the right, has reward
    1. After the last row the observation is empty.
    """
    right, end = np.random.default_rng(seed).integers(2, size=(size, size)), size * size
    table: list[list[list[Outcome]]] = []
    for row, column in np.ndindex(size, size):
        moves: list[tuple[int, float, bool]] = []
        for step in (-1, 1):
            last, neighbour = row == size - 1, min(max(column + step, 0), size - 1)
            found = last and column == size - 1 and step == 1
            moves.append((end if last else (row + 1) * size + neighbour, found - (step == 1) * 0.01 / size, last))
        chosen = [int(right[row, column] == action) for action in (0, 1)]
        outcomes = [[(1.0 - slip, *moves[way])] + ([(slip, *moves[1 - way])] if slip else []) for way in chosen]
        table.append(outcomes)
    table.append([[(1.0, end, 0.0, True)]] * 2)
    planes = np.eye(end + 1, end, dtype=np.int8).reshape(-1, size, size)
    return TableEnv(table, 0, planes, gym.spaces.MultiBinary((size, size)))


for _env_id, _maker, _limit in (("mbagent/Inventory-v0", "inventory", 50), ("mbagent/DeepSea-v0", "deep_sea", 100)):
    if _env_id not in gym.registry:
        gym.register(id=_env_id, entry_point=f"{__name__}:{_maker}", max_episode_steps=_limit)
