"""The library's own searches on table worlds, behind one small interface."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mbagent.analysis.planning_benchmark.peers import Speed
from mbagent.analysis.planning_benchmark.worlds import Bools, Floats, Ints, World
from mbagent.models.base import BaseTransitionModel, FitReport, Randomness, Successors, as_keys
from mbagent.planning.mcts import MctsPlanner
from mbagent.planning.planner import PlannerSettings
from mbagent.transitions import TransitionDataset
from mbagent_envs.random_keys import uniforms


class TableSearch(Protocol):
    """A search on a table."""

    def __call__(
        self,
        table: Floats,
        rewards: Floats,
        ends: Bools,
        leaf_values: Floats,
        roots: Ints,
        n_simulations: int,
        seed: int,
        *,
        gamma: float,
    ) -> Ints:
        """Actions int64 [R].

        Args:
            table: P(next state | state, action), float64 [S, A, S].
            rewards: on arrival, float64 [S].
            ends: whether arrival terminates, bool [S].
            leaf_values: what a state is worth that the search has not looked beyond, float64 [S].
            roots: int64 [R]; the outcome of one must not depend on the others.
            n_simulations: for each root.
            seed: which random numbers.
            gamma: discount of a step.
        """
        ...


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


def search_with_rollouts(
    table: Floats,
    rewards: Floats,
    ends: Bools,
    leaf_values: Floats,
    roots: Ints,
    n_simulations: int,
    seed: int,
    *,
    gamma: float,
) -> Ints:
    """The agent's planner as textbook UCT; see TableSearch.

    It values leaves by random play and cannot be given leaf values, so ``leaf_values`` is not used.
    """
    planner = MctsPlanner(
        PlannerSettings(num_simulations=n_simulations, gamma=gamma, leaf_values="rollouts", backup="mean", seed=seed)
    )
    planner.set_model(TableWorldModel(table, ends), np.zeros((0, 1), dtype=np.int64))
    planner.set_goal(lambda states, actions, next_states: rewards[next_states[:, 0]])
    return planner.plan(roots[:, None]).actions


OWN_SEARCHES: dict[str, TableSearch] = {"mbagent, random play at leaves": search_with_rollouts}
"""What is compared with the peers, by name."""


def choose(search: TableSearch, world: World, roots: Ints, n_simulations: int, seed: int) -> Ints:
    """The actions int64 [R] that a search takes in a world."""
    given = (world.table, world.rewards, world.ends, world.leaf_values)
    return search(*given, roots, n_simulations, seed, gamma=world.gamma)


def time_search(
    search: TableSearch, world: World, roots: Ints, speeds: Sequence[tuple[int, int]], repetitions: int = 5
) -> list[Speed]:
    """Times a search as the peers' scripts do: processor time on one thread, the median after a call that may compile.

    A simulation is counted as one sample of the model.
    """
    found, given = [], (world.table, world.rewards, world.ends, world.leaf_values)
    for n_roots, simulations in speeds:
        some, seconds = np.resize(roots, n_roots), []
        search(*given, some, simulations, 0, gamma=world.gamma)
        for repetition in range(repetitions):
            began = time.process_time()
            search(*given, some, simulations, 1 + repetition, gamma=world.gamma)
            seconds.append(time.process_time() - began)
        median = max(float(np.median(seconds)), 1e-9)
        rate = n_roots * simulations / median
        found.append(Speed(n_roots, simulations, median, rate, rate))
    return found
