"""The library's own searches on table worlds, behind one small interface."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.analysis.planning_benchmark.peers import Speed
from mbagent.analysis.planning_benchmark.worlds import Bools, Floats, Ints, World
from mbagent.models.base import BaseTransitionModel, FitReport, Randomness, Successors, as_keys
from mbagent.planning.machine_search import known_machine, search_machine
from mbagent.planning.mcts import MctsPlanner
from mbagent.planning.planner import PlannerSettings, best_actions
from mbagent.transitions import TransitionDataset
from mbagent_envs.random_keys import uniforms


class TableSearch(Protocol):
    """A search in a world that was prepared."""

    def __call__(self, roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        """(actions int64 [R], next states drawn in all) from roots int64 [R]; one's outcome must not depend on the others."""
        ...


Prepare: TypeAlias = Callable[[World], TableSearch]
"""What is done once for a world: the rules and the goal are given, and what a state is worth that was not looked beyond."""


class TableWorldModel(BaseTransitionModel):
    """A table as a TransitionModel of one factor; it has nothing to learn."""

    def __init__(self, table: Floats, ends: Bools) -> None:
        """Takes P(next state | state, action), float64 [S, A, S], and whether arrival terminates, bool [S]."""
        super().__init__((table.shape[0],), table.shape[1])
        self.table, self.ends, self._cumulated = table, ends, table.cumsum(axis=2)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Nothing to do."""
        return FitReport(len(data), 0, 0, 0.0)

    def sample(self, states: Ints, actions: Ints, rng: Randomness) -> tuple[Ints, Bools]:
        """See TransitionModel."""
        luck = uniforms(as_keys(rng, len(states)), 1)
        chosen = (luck >= self._cumulated[states[:, 0], actions]).sum(axis=1)
        following = np.minimum(chosen, len(self.table) - 1)
        return following[:, None], self.ends[following]

    def successors(self, states: Ints, actions: Ints, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; all of them."""
        p = self.table[states[:, 0], actions]
        rows, following = np.nonzero(p)
        offsets = np.concatenate([[0], np.cumsum((p > 0).sum(axis=1))]).astype(np.int64)
        return Successors(offsets, following[:, None], self.ends[following], p[rows, following])

    def marginals(self, states: Ints, actions: Ints) -> Floats:
        """See TransitionModel."""
        row: Floats = self.table[states[:, 0], actions]
        return row

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Nothing to do."""


def with_rollouts(world: World) -> TableSearch:
    """The agent's planner as textbook UCT. It values leaves by random play and cannot be given leaf values."""
    model, none = TableWorldModel(world.table, world.ends), np.zeros((0, 1), dtype=np.int64)

    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        settings = PlannerSettings(
            num_simulations=n_simulations, gamma=world.gamma, leaf_values="rollouts", backup="mean", seed=seed
        )
        planner = MctsPlanner(settings)
        planner.set_model(model, none)
        planner.set_goal(lambda states, actions, next_states: world.rewards[next_states[:, 0]])
        return planner.plan(roots[:, None]).actions, len(roots) * n_simulations

    return search


def on_machine(world: World) -> TableSearch:
    """Tree search on the world as a known machine."""
    n_states, n_actions, n_successors = world.successors.shape
    following = np.ascontiguousarray(world.successors.reshape(-1))
    machine = known_machine(
        np.arange(n_states * n_actions + 1) * n_successors,
        following,
        world.probabilities.reshape(-1),
        world.rewards[following],
        world.ends[following],
        world.leaf_values,
        n_actions,
        world.gamma,
    )

    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        found = search_machine(machine, roots, n_simulations, seed)
        return best_actions(found.values), found.steps

    return search


OWN_SEARCHES: dict[str, Prepare] = {"mbagent": on_machine, "mbagent, random play at leaves": with_rollouts}
"""What is compared with the peers, by name."""


def time_search(search: TableSearch, roots: Ints, speeds: Sequence[tuple[int, int]], repetitions: int = 5) -> list[Speed]:
    """Times a search as the peers' scripts do: processor time on one thread, the median after a call that may compile.

    A repetition is at least a hundredth of a second long: several calls, if need be.
    """
    found = []
    for n_roots, simulations in speeds:
        some, seconds = np.resize(roots, n_roots), []
        _, samples = search(some, simulations, 0)
        began = time.process_time()
        search(some, simulations, 0)
        calls = max(1, math.ceil(0.01 / max(time.process_time() - began, 1e-6)))
        for repetition in range(repetitions):
            began = time.process_time()
            for call in range(calls):
                search(some, simulations, 1 + repetition * calls + call)
            seconds.append((time.process_time() - began) / calls)
        median = max(float(np.median(seconds)), 1e-9)
        found.append(Speed(n_roots, simulations, median, n_roots * simulations / median, samples / median))
    return found
