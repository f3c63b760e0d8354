"""True dependencies between the variables of a game, for comparison with the remaining connections."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.neural.pruning import Influence, dependent_groups, modules
from mbagent.types import Bools
from mbagent_envs.flier_catcher import FlierCatcher
from mbagent_envs.game import Game


class Agreement(NamedTuple):
    """See ``experiment.Row``."""

    parents: float
    precision: float
    recall: float
    conditions_precision: float
    conditions_recall: float
    modules: float


def agreement(game: Game, found: Influence) -> Agreement:
    """Agreement of the remaining connections with the true dependencies."""
    parents, nan = float((found.states[:-1] > 0.0).sum(axis=1).mean()), float("nan")
    if not isinstance(game, FlierCatcher):
        return Agreement(parents, nan, nan, nan, nan, nan)
    states, others = flier_catcher_dependencies(game)
    linked = found.others[:-1, :-1] > 0.0
    rates = _rates(found.states[:-1] > 0.0, states), _rates(np.tril(linked | linked.T, -1), others)
    true = flier_catcher_modules(game)
    named = {frozenset(module.outputs.tolist()) for module in modules(found)}
    groups = {frozenset(group.outputs.tolist()) for group in dependent_groups(found)}
    hits = sum(module in named for module in true[:-1]) + (true[-1] in groups)
    return Agreement(parents, *rates[0], *rates[1], hits / len(true))


def flier_catcher_modules(game: FlierCatcher) -> list[frozenset[int]]:
    """True modules: the player's rows, the cells of each row of fliers, and last the cells of new fliers."""
    shape = game.observation_space.shape
    number: NDArray[Any] = np.arange(int(np.prod(shape))).reshape(shape)
    rows = [number[0, :, 0], *number[1], number[1, :, -1]]
    return [frozenset(row.tolist()) for row in rows]


def _rates(found: Bools, true: Bools) -> tuple[float, float]:
    both = (found & true).sum()
    return float(both / max(found.sum(), 1)), float(both / true.sum())


def flier_catcher_dependencies(game: FlierCatcher) -> tuple[Bools, Bools]:
    """(from state to next state, bool [F, F]; between next variables, the later first, bool [F, F]).

    A player's row depends on the adjacent rows and on itself; a flier's cell on the cell to its right; new fliers only on each
    other, since at most one appears per step.
    """
    shape = game.observation_space.shape
    number: NDArray[Any] = np.arange(int(np.prod(shape))).reshape(shape)
    states = np.zeros((number.size, number.size), dtype=np.bool_)
    others = np.zeros_like(states)
    for row in range(game.height):
        for neighbour in range(max(row - 1, 0), min(row + 2, game.height)):
            states[number[0, row, 0], number[0, neighbour, 0]] = game.stay or neighbour != row or row in (0, game.height - 1)
        states[number[1, row, :-1], number[1, row, 1:]] = True
        others[number[1, row, -1], number[1, :row, -1]] = True
    return states, others
