"""Traces of plans: the state graph around one root, and its most probable trajectories."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Protocol, runtime_checkable

import numpy as np

from mbagent.models.mdp import StateGraph
from mbagent.planning.planner import Plan, best_actions
from mbagent.planning.value_iteration import break_ties
from mbagent.types import Floats, Ints, States

_ROUNDING = 1e-9


@dataclass(frozen=True)
class PlanTrace:
    """The plan from one root, with the state graph that it is based on.

    Attributes:
        plan: the plan, with B = 1.
        graph: the state graph; valid until the planner plans again.
        root: the root's node.
        rewards: float64 [M], rewards of the graph's successor edges.
        policy: int64 [N], each node's action under the best policy found; -1 for nodes without a planned action.
        values: float64 [N], values of the graph's states; None with flat Monte Carlo.
        mdp_states: number of states of the solved MDP if the plan comes from one, without a search; else 0.
    """

    plan: Plan
    graph: StateGraph
    root: int
    rewards: Floats
    policy: Ints
    values: Floats | None = None
    mdp_states: int = 0


@runtime_checkable
class TracingPlanner(Protocol):
    """A planner that can return the trace of a plan."""

    def trace(self, root: States) -> PlanTrace:
        """Trace of the plan from one root int64 [1, F]; its ``plan`` equals ``plan(root)``."""
        ...


def best_policy(graph: StateGraph, q: Floats, gamma: float, tried: Floats | None = None) -> Ints:
    """Action of the best policy in each node, [N], chosen in the same way as at the root; -1 for unexpanded nodes.

    Args:
        graph: the state graph.
        q: float64 [N, A], values.
        gamma: discount.
        tried: [N, A], visit counts, if actions are chosen by them; unvisited nodes get -1.
    """
    policy = np.full(len(graph), -1, dtype=np.int64)
    known = np.flatnonzero(graph.expanded if tried is None else tried.sum(axis=1) > 0.0)
    if len(known):
        policy[known] = best_actions(break_ties(graph, q, known, gamma) if tried is None else tried[known])
    return policy


def likeliest_trajectories(trace: PlanTrace, n_futures: int, n_steps: int) -> list[list[list[int]]]:
    """For every root action, the ``n_futures`` most probable sequences of successor edges, the most probable first.

    After the first action, sequences follow ``trace.policy``. A sequence ends after ``n_steps`` edges, at the end of the
    episode, or at a node without an action in ``trace.policy``. The list is exact: a best-first search orders partial sequences
    by their probability times the probability of their most probable continuation. The latter is computed by dynamic
    programming.
    """
    continuations = _continuations(trace, n_steps)
    n_actions = trace.graph.model.n_actions
    return [list(islice(_in_order(trace, action, continuations), n_futures)) for action in range(n_actions)]


def _continuations(trace: PlanTrace, n_steps: int) -> list[Floats]:
    """Entry k: probability [N] of the most probable sequence of at most k further edges from each node."""
    graph = trace.graph
    followed = np.flatnonzero(graph.actions == trace.policy[graph.sources])
    sources, targets, p = graph.sources[followed], graph.next_nodes[followed], graph.probabilities[followed]
    continuations = [np.ones(len(graph))]
    for _ in range(n_steps - 1):
        best = np.where(trace.policy >= 0, 0.0, 1.0)
        np.maximum.at(best, sources, p * np.where(graph.terminated[followed], 1.0, continuations[-1][targets]))
        continuations.append(best)
    return continuations


def _in_order(trace: PlanTrace, action: int, continuations: list[Floats]) -> Iterator[list[int]]:
    graph, policy, n_steps = trace.graph, trace.policy, len(continuations)
    waiting: list[tuple[float, list[int], float]] = []

    def begin(path: list[int], probability: float, bound: float, node: int, chosen: int) -> None:
        """Adds all extensions of a path by action ``chosen``; ``bound``: upper bound of its completions' probabilities."""
        first = graph.first[node, chosen]
        for edge in range(first, first + graph.counts[node, chosen]):
            joint = probability * graph.probabilities[edge]
            if joint > 0.0:
                ahead = 1.0 if graph.terminated[edge] else continuations[n_steps - 1 - len(path)][graph.next_nodes[edge]]
                best = joint * ahead
                # Rounding must not make equal probabilities differ: else none of many equal paths would be followed to its end.
                heapq.heappush(waiting, (-(bound if best >= bound * (1.0 - _ROUNDING) else best), [*path, int(edge)], joint))

    begin([], 1.0, 1.0, trace.root, action)
    while waiting:
        negative, path, probability = heapq.heappop(waiting)
        node = graph.next_nodes[path[-1]]
        if len(path) == n_steps or graph.terminated[path[-1]] or policy[node] < 0:
            yield path
        else:
            begin(path, probability, -negative, node, policy[node])
