"""The library's own searches in tabular MDPs, behind a common interface."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

import numpy as np

from mbagent.models.tabular import TabularMDP
from mbagent.planning.planner import PlannerSettings, best_actions
from mbagent.planning.planners import MctsPlanner
from mbagent.types import Ints
from studies.planning.machine_search import known_machine, search_machine
from studies.planning.peers import Speed
from worlds.random_mdps import RandomMDP


class TableSearch(Protocol):
    """A search that is prepared for one MDP."""

    def __call__(self, roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        """(actions int64 [R], total number of sampled next states) for roots int64 [R], independent of each other."""
        ...


Prepare: TypeAlias = Callable[[RandomMDP], TableSearch]
"""Preparation for one MDP, given its rules, the goal and leaf values."""


def as_model(world: RandomMDP) -> TabularMDP:
    """The MDP as a transition model with one factor."""
    n_states, n_actions, n_successors = world.successors.shape
    following, nowhere = np.ascontiguousarray(world.successors.reshape(-1)), np.zeros(0, dtype=np.int64)
    offsets = np.arange(n_states * n_actions + 1) * n_successors
    return TabularMDP(offsets, following, world.ends[following], world.probabilities.reshape(-1), n_actions, nowhere)


def with_rollouts(world: RandomMDP) -> TableSearch:
    """The agent's planner as textbook UCT, with random rollouts instead of the given leaf values."""
    model, none = as_model(world), np.zeros((0, 1), dtype=np.int64)

    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        settings = PlannerSettings(
            num_simulations=n_simulations, gamma=world.gamma, leaf_values="rollouts", backup="mean", seed=seed
        )
        planner = MctsPlanner(settings)
        planner.set_model(model, none)
        planner.set_goal(lambda states, actions, next_states: world.rewards[next_states[:, 0]])
        return planner.plan(roots[:, None]).actions, len(roots) * n_simulations

    return search


def on_machine(world: RandomMDP) -> TableSearch:
    """Tree search on the MDP as a known reachable MDP."""
    model = as_model(world)
    following, over = model.next_states, model.terminated
    mdp = known_machine(
        model.offsets,
        following,
        model.probabilities,
        world.rewards[following],
        over,
        world.leaf_values,
        model.n_actions,
        world.gamma,
    )

    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        found = search_machine(mdp, roots, n_simulations, seed)
        return best_actions(found.values), found.steps

    return search


OWN_SEARCHES: dict[str, Prepare] = {"mbagent": on_machine, "mbagent, random play at leaves": with_rollouts}
"""The library's searches in the comparison, by name."""


def time_search(search: TableSearch, roots: Ints, speeds: Sequence[tuple[int, int]], repetitions: int = 5) -> list[Speed]:
    """Times a search as the peers' scripts do: processor time on one thread, the median after a first call that may compile.

    A repetition lasts at least a hundredth of a second, with several calls if necessary.
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
