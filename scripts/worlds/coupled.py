"""MDPs with many noisy, weakly coupled variables, too large to solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mbagent.models.base import ExactModel
from mbagent.models.neural.sampling import independent_successors
from mbagent.models.protocol import Successors, as_keys
from mbagent.types import Actions, Bools, Floats, Randomness, Reward, States
from mbagent_envs.random_keys import uniforms


class IndependentModel(ExactModel):
    """An MDP whose next values are independent given state and action; no episode terminates.

    Args:
        cardinalities: number of values of each variable.
        n_actions: number of actions.
        chances: ``chances(states [B, F], actions [B]) -> float64 [B, F, K]``, the distribution of each variable.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int, chances: Callable[[States, Actions], Floats]) -> None:
        super().__init__(cardinalities, n_actions)
        self._chances = chances

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        noise = uniforms(as_keys(rng, len(states)), states.shape[1])
        below = np.cumsum(self._chances(states, actions), axis=2)[:, :, :-1]
        return (below <= noise[:, :, None]).sum(axis=2), np.zeros(len(states), dtype=np.bool_)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        chances = self._chances(states, actions)
        return np.concatenate([chances[:, f, :k] for f, k in enumerate(self.cardinalities)], axis=1)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel."""
        chances = self._chances(states, actions)
        goes_on = np.zeros((len(states), 1, chances.shape[2]))
        goes_on[:, 0, 0] = 1.0
        outputs = np.array([*self.cardinalities, 2])
        return independent_successors(np.concatenate([chances, goes_on], axis=1), outputs, n_samples, seed)


@dataclass(frozen=True)
class CoupledWorld:
    """An MDP with its goal.

    Attributes:
        name: its name.
        model: its rules.
        goal: its reward function.
        start: start states, int64 [S, F].
    """

    name: str
    model: IndependentModel
    goal: Reward
    start: States


def _bits(on: Floats) -> Floats:
    return np.stack([1.0 - on, on], axis=2)


def corridor(n_lights: int = 12, cells: int = 12) -> CoupledWorld:
    """A corridor whose last cell is to be reached and kept, with many irrelevant, flickering lights."""

    def chances(states: States, actions: Actions) -> Floats:
        rows, cell = np.arange(len(states)), states[:, 0]
        result = np.zeros((len(states), 1 + n_lights, cells))
        result[rows, 0, cell] += 0.2
        result[rows, 0, np.clip(cell + actions - 1, 0, cells - 1)] += 0.8
        result[:, 1:, :2] = _bits(np.where(states[:, 1:] == 1, 0.7, 0.3))
        return result

    start = np.zeros((64, 1 + n_lights), dtype=np.int64)
    start[:, 1:] = np.random.default_rng(0).integers(0, 2, size=(64, n_lights))
    start[:, 0] = cells - 3
    model = IndependentModel((cells, *(2,) * n_lights), 3, chances)
    return CoupledWorld("corridor with lights", model, lambda s, a, n: (n[:, 0] == cells - 1).astype(np.float64), start)


def ring(n: int = 16) -> CoupledWorld:
    """Computers in a ring, which fail more often next to a failed neighbour; one can be restarted in each step."""

    def chances(states: States, actions: Actions) -> Floats:
        on = np.where(states == 1, 0.45 + 0.25 * (1 + np.roll(states, 1, axis=1)), 0.05)
        started = np.flatnonzero(actions > 0)
        on[started, actions[started] - 1] = 0.95
        return _bits(on)

    model = IndependentModel((2,) * n, n + 1, chances)
    return CoupledWorld(
        "ring of machines", model, lambda s, a, y: y.sum(axis=1) - 0.75 * (a > 0), np.ones((1, n), dtype=np.int64)
    )


def cells(size: int = 4) -> CoupledWorld:
    """Conway's game of life with noise; one cell can be set in each step."""
    n = size * size

    def chances(states: States, actions: Actions) -> Floats:
        padded = np.pad(states.reshape(-1, size, size), ((0, 0), (1, 1), (1, 1)))
        shifts = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
        around = np.sum([padded[:, y : y + size, x : x + size] for y, x in shifts], axis=0).reshape(-1, n)
        on = np.where((around == 3) | ((states == 1) & (around == 2)), 0.9, 0.1)
        is_set = np.flatnonzero(actions > 0)
        on[is_set, actions[is_set] - 1] = 0.9
        return _bits(on)

    start = np.random.default_rng(0).integers(0, 2, size=(64, n))
    return CoupledWorld(
        "game of life", IndependentModel((2,) * n, n + 1, chances), lambda s, a, y: y.sum(axis=1) - 1.0 * (a > 0), start
    )


COUPLED = (corridor, ring, cells)
