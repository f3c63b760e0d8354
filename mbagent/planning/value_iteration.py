"""Dynamic programming on a graph of imagined states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mbagent_envs._compiled import compiled
from numpy.typing import NDArray

from mbagent.models.base import Floats, States, TransitionModel
from mbagent.models.reachable import grow_reachable
from mbagent.models.state_graph import StateGraph
from mbagent.planning.goal import Goal

TOLERANCE = 1e-7
"""Sweeps stop when no value moves by more than this share of the largest reward."""

MAX_SWEEPS = 5000


@dataclass
class Values:
    """Solution of a graph under a goal.

    Attributes:
        v: float64 [N], value of each state with the best action; of unexpanded ones the frontier's value.
        q: float64 [N, A], value of each action; zero rows for unexpanded states.
        rewards: float64 [M], reward of every successor edge.
        mean_rewards: float64 [N, A], expected reward of each action.
        frontier: float64 [G], value of unexpanded states in each group.
    """

    v: Floats
    q: Floats
    rewards: Floats
    mean_rewards: Floats
    frontier: Floats


def score_edges(graph: StateGraph, goal: Goal, start: int = 0) -> Floats:
    """Rewards [M - start] of the graph's successor edges from number ``start`` on, in one call of the goal."""
    if graph.n_edges == start:
        return np.zeros(0)
    sources, next_nodes = graph.sources[start:], graph.next_nodes[start:]
    return goal(graph.states[sources], graph.actions[start:], graph.states[next_nodes])


def solve(graph: StateGraph, goal: Goal, gamma: float, n_groups: int = 1) -> Values:
    """Value iteration in place (Gauss-Seidel, last node first: one sweep settles a graph without cycles).

    States that were never expanded are worth the mean of their group's expanded states, found together with the
    values: zero would make every cost end, and every income stop, at the edge of what was imagined.

    Args:
        graph: what was imagined.
        goal: what is wanted.
        gamma: discount, below one.
        n_groups: groups of the graph are numbered 0 ... n_groups - 1.
    """
    rewards = score_edges(graph, goal)
    n, n_actions = len(graph), graph.model.n_actions
    flat = graph.sources * n_actions + graph.actions
    mean_rewards = np.bincount(flat, weights=rewards * graph.probabilities, minlength=n * n_actions)
    mean_rewards = mean_rewards.reshape(n, n_actions)
    weights = graph.probabilities * ~graph.terminated
    v, q, frontier = _sweep(
        graph.groups,
        graph.expanded,
        graph.first,
        graph.count,
        graph.next_nodes,
        weights,
        mean_rewards,
        n_groups,
        gamma,
        TOLERANCE,
        MAX_SWEEPS,
    )
    return Values(v, q, rewards, mean_rewards, frontier)


@compiled
def _sweep(
    groups: NDArray[np.int64],
    expanded: NDArray[np.bool_],
    first: NDArray[np.int64],
    count: NDArray[np.int64],
    next_nodes: NDArray[np.int64],
    weights: NDArray[np.float64],
    mean_rewards: NDArray[np.float64],
    n_groups: int,
    gamma: float,
    tolerance: float,
    max_sweeps: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    n, n_actions = first.shape
    v, q = np.zeros(n), np.zeros((n, n_actions))
    frontier, sums, sizes = np.zeros(n_groups), np.zeros(n_groups), np.zeros(n_groups)
    # Every group stops by its own measure: its values must not depend on what else is solved in the same call.
    moved, scale, active = np.zeros(n_groups), np.full(n_groups, 1e-12), np.ones(n_groups, dtype=np.bool_)
    for s in range(n):
        sizes[groups[s]] += expanded[s]
        scale[groups[s]] = max(scale[groups[s]], np.abs(mean_rewards[s]).max())
    for _ in range(max_sweeps):
        moved[:] = 0.0
        sums[:] = 0.0
        for s in range(n - 1, -1, -1):
            g = groups[s]
            if not (active[g] and expanded[s]):
                continue
            best = -np.inf
            for a in range(n_actions):
                total = mean_rewards[s, a]
                for e in range(first[s, a], first[s, a] + count[s, a]):
                    total += gamma * weights[e] * v[next_nodes[e]]
                q[s, a] = total
                best = max(best, total)
            moved[g] = max(moved[g], abs(best - v[s]))
            v[s] = best
            sums[g] += best
        for g in range(n_groups):
            if active[g]:
                mean = sums[g] / max(sizes[g], 1.0)
                moved[g] = max(moved[g], abs(mean - frontier[g]))
                frontier[g] = mean
        for s in range(n):
            if active[groups[s]] and not expanded[s]:
                v[s] = frontier[groups[s]]
        for g in range(n_groups):
            active[g] = active[g] and moved[g] > tolerance * scale[g]
        if not active.any():
            break
    return v, q, frontier


class Machine:
    """The finite-state machine reachable from the known start states, solved anew for each goal.

    Args:
        model: what generates it.
        start: int64 [B, F], start states.
        max_states: when more states than this are reachable, the machine is given up (``graph`` is None).
        n_samples: draws for a (state, action) with too many successors to enumerate.
        seed: which random numbers those draws use.

    Attributes:
        graph: the complete machine, or None.
        values: its solution under the goal last given, or None.
    """

    def __init__(self, model: TransitionModel, start: States, max_states: int, n_samples: int, seed: int) -> None:
        """See the class."""
        graph, complete = grow_reachable(model, start, max_states, n_samples, seed)
        self.graph = graph if complete and len(start) else None
        self.values: Values | None = None

    def set_goal(self, goal: Goal, gamma: float) -> None:
        """Solves the machine for a goal."""
        self.values = solve(self.graph, goal, gamma) if self.graph is not None else None

    def find(self, states: States) -> NDArray[np.int64]:
        """Nodes [B] of expanded states [B, F]; -1 where a state is not in the machine."""
        if self.graph is None:
            return np.full(len(states), -1, dtype=np.int64)
        nodes = self.graph.find(states)
        return np.where((nodes >= 0) & self.graph.expanded[nodes], nodes, -1)
