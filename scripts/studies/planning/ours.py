"""The library's own searches in tabular MDPs, behind a common interface."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from mbagent.models.tabular import TabularMDP
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner
from mbagent.planning.racing import LookaheadConfig
from mbagent.planning.value_iteration import LeafValues
from mbagent.types import Ints
from studies.planning.peers import Speed
from worlds.random_mdps import RandomMDP


class TableSearch(Protocol):
    """A search that is prepared for one MDP."""

    def __call__(self, roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        """(actions int64 [R], total number of sampled next states, 0 without simulations) for independent roots int64 [R]."""
        ...


Prepare: TypeAlias = Callable[[RandomMDP], TableSearch]
"""Preparation for one MDP, given its rules, the goal and leaf values."""


def as_model(world: RandomMDP) -> TabularMDP:
    """The MDP as a transition model with one factor."""
    n_states, n_actions, n_successors = world.successors.shape
    following, nowhere = np.ascontiguousarray(world.successors.reshape(-1)), np.zeros(0, dtype=np.int64)
    offsets = np.arange(n_states * n_actions + 1) * n_successors
    return TabularMDP(offsets, following, world.ends[following], world.probabilities.reshape(-1), n_actions, nowhere)


def _planned(world: RandomMDP, start: Ints, leaf: LeafValues | None, **changed: Any) -> TableSearch:
    """Decisions of the MctsPolicy's planner that knows the rules, with changed settings and values of unexpanded states.

    Without ``start`` states there is no MDP to solve in advance.
    """
    model, planners = as_model(world), dict[tuple[int, int], MctsPlanner]()

    def search(roots: Ints, n_simulations: int, seed: int) -> tuple[Ints, int]:
        planner = planners.get((n_simulations, seed))
        if planner is None:
            settings = PlannerSettings(num_simulations=n_simulations, gamma=world.gamma, seed=seed, **changed)
            planner = planners[n_simulations, seed] = MctsPlanner(settings)
            planner.set_model(model, start[:, None])
            planner.set_goal(lambda states, actions, next_states: world.rewards[next_states[:, 0]])
            if leaf is not None:
                planner.config = LookaheadConfig(leaf, settings.lookahead_states, settings.lookahead_samples)
        return planner.plan(roots[:, None]).actions, 0 if len(start) else len(roots) * n_simulations

    return search


def solved(world: RandomMDP) -> TableSearch:
    """The default: the reachable MDP is solved once for the goal, so a decision needs no simulation."""
    return _planned(world, np.flatnonzero(~world.ends), None)


def searched(world: RandomMDP) -> TableSearch:
    """The search for MDPs that are too large to solve, with the given leaf values instead of learned ones."""
    values, value = world.leaf_values, np.arange(-1, len(world.leaf_values) - 1)
    zero, bound = np.zeros(1, dtype=np.int64), float(np.abs(values).max())
    leaf = LeafValues(zero, zero, value, float(values[0]), values[1:] - values[0], np.zeros((0, 0)), -bound, bound)
    return _planned(world, zero[:0], leaf, max_states=1)


def with_rollouts(world: RandomMDP) -> TableSearch:
    """The planner as textbook UCT, with random rollouts instead of the given leaf values."""
    return _planned(world, np.zeros(0, dtype=np.int64), None, leaf_values="rollouts", backup="mean")


OWN_SEARCHES: dict[str, Prepare] = {
    "mbagent": solved,
    "mbagent, too large to solve": searched,
    "mbagent, random play at leaves": with_rollouts,
}
"""The library's searches in the comparison, by name."""


def time_search(search: TableSearch, roots: Ints, speeds: Sequence[tuple[int, int]], repetitions: int = 5) -> list[Speed]:
    """Times a search as the peers' scripts do: processor time on one thread, the median after a first call that may compile.

    A repetition lasts at least a hundredth of a second, with several calls if necessary; each repetition has other roots.
    """
    found = []
    for n_roots, simulations in speeds:
        some, seconds = np.resize(roots, n_roots), []
        _, samples = search(some, simulations, 0)
        began = time.process_time()
        search(some, simulations, 0)
        calls = max(1, math.ceil(0.01 / max(time.process_time() - began, 1e-6)))
        for repetition in range(repetitions):
            some = np.resize(np.roll(roots, -repetition), n_roots)
            began = time.process_time()
            for _ in range(calls):
                search(some, simulations, 0)
            seconds.append((time.process_time() - began) / calls)
        median = max(float(np.median(seconds)), 1e-9)
        rate = n_roots * simulations / median if samples else float("nan")
        found.append(Speed(n_roots, simulations, median, rate, samples / median))
    return found
