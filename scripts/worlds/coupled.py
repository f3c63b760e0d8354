"""Worlds of many noisy variables, too large to solve: what values learned in imagination are worth there."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness import Row
from mbagent.models.base import Actions, Bools, Floats, Randomness, States, Successors, as_keys
from mbagent.models.known import KnownModel
from mbagent.models.systematic import independent_successors
from mbagent.planning.goal import Goal
from mbagent.planning.mcts import MctsPlanner
from mbagent.planning.planner import PlannerSettings
from mbagent_envs.random_keys import derive, uniforms

EPISODES, STEPS = 16, 40
"""Episodes played side by side, and their length."""

_SALT = 0xC40D


class IndependentModel(KnownModel):
    """A world whose variables change independently, given state and action; no episode ends.

    Args:
        cardinalities: of the variables.
        n_actions: number of actions.
        chances: ``chances(states [B, F], actions [B]) -> float64 [B, F, K]``, the distribution of each variable.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int, chances: Callable[[States, Actions], Floats]) -> None:
        super().__init__(cardinalities, n_actions)
        self._chances = chances

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        luck = uniforms(as_keys(rng, len(states)), states.shape[1])
        below = np.cumsum(self._chances(states, actions), axis=2)[:, :, :-1]
        return (below <= luck[:, :, None]).sum(axis=2), np.zeros(len(states), dtype=np.bool_)

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
class World:
    """What is played.

    Attributes:
        name: what it is called.
        model: its rules.
        goal: what is wanted.
        start: int64 [S, F], start states.
    """

    name: str
    model: IndependentModel
    goal: Goal
    start: States


def _bits(on: Floats) -> Floats:
    return np.stack([1.0 - on, on], axis=2)


def corridor(n_lights: int = 12, cells: int = 12) -> World:
    """A corridor whose last cell is to be reached and kept; many lights beside it flicker and mean nothing."""

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
    return World("corridor with lights", model, lambda s, a, n: (n[:, 0] == cells - 1).astype(np.float64), start)


def ring(n: int = 16) -> World:
    """Machines in a ring that fail, the sooner the more their neighbour has failed; one can be started anew in each step."""

    def chances(states: States, actions: Actions) -> Floats:
        on = np.where(states == 1, 0.45 + 0.25 * (1 + np.roll(states, 1, axis=1)), 0.05)
        started = np.flatnonzero(actions > 0)
        on[started, actions[started] - 1] = 0.95
        return _bits(on)

    model = IndependentModel((2,) * n, n + 1, chances)
    return World("ring of machines", model, lambda s, a, y: y.sum(axis=1) - 0.75 * (a > 0), np.ones((1, n), dtype=np.int64))


def cells(size: int = 4) -> World:
    """Conway's game of life with noise; a cell can be set in each step."""
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
    return World("game of life", IndependentModel((2,) * n, n + 1, chances), lambda s, a, y: y.sum(axis=1) - 1.0 * (a > 0), start)


WORLDS = (corridor, ring, cells)


def play(world: World, act: Callable[[States], Actions], seed: int) -> Floats:
    """Return [EPISODES] of each episode."""
    rng = np.random.default_rng([seed, _SALT])
    states, total = world.start[rng.integers(len(world.start), size=EPISODES)], np.zeros(EPISODES)
    for step in range(STEPS):
        actions = act(states)
        after, _ = world.model.sample(states, actions, derive(seed, _SALT, step, np.arange(EPISODES)))
        total += world.goal(states, actions, after)
        states = after
    return total


def compare_values(world: World, seed: int) -> list[Row]:
    """Rows of random play, and of the default planner without and with learned values."""
    rng, rows = np.random.default_rng(seed), []
    returns = play(world, lambda states: rng.integers(world.model.n_actions, size=len(states)), seed)
    rows.append(_row(world, "random", returns, 0.0, 0.0))
    for name, learn_values in (("lookahead", False), ("learned values", True)):
        planner = MctsPlanner(PlannerSettings(learn_values=learn_values, seed=seed))
        planner.set_model(world.model, world.start)
        planner.set_goal(world.goal)
        planner.plan(world.start[:1])  # compiles
        planner.set_goal(world.goal)
        began = time.process_time()
        planner.plan(world.start[:1])
        once, began = time.process_time() - began, time.process_time()
        returns = play(world, lambda states, planner=planner: planner.plan(states).actions, seed)  # type: ignore[misc]
        rows.append(_row(world, name, returns, once, 1e3 * (time.process_time() - began) / (EPISODES * STEPS)))
    return rows


def _row(world: World, planner: str, returns: Floats, once: float, each: float) -> Row:
    error = float(returns.std(ddof=1) / np.sqrt(len(returns)))
    return {
        "world": world.name, "planner": planner, "return": float(returns.mean()), "error": error, "once for a goal, s": once,
        "ms a decision": each,
    }  # fmt: skip
