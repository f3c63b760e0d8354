"""The search tree and its compiled kernels: select, expand, back up.

The "tree" is a graph: a state reached in two ways is one node (a transposition). Every (node, action) keeps several
sampled successors, as a stochastic world needs. Shapes: R roots, W simulations of a wave, H horizon, N nodes, A
actions, M
successor edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Floats
from mbagent.models.state_graph import GraphArrays
from mbagent.planning.value_iteration import bellman
from mbagent_envs._compiled import compiled
from mbagent_envs.random_keys import uniform_at

Ints = NDArray[np.int64]


class Paths(NamedTuple):
    """What the simulations of one wave passed through.

    Attributes:
        edges: int64 [R, W, H], successor edges taken, in order.
        lengths: int64 [R, W], how many of them.
        leaves: int64 [R, W], the unexpanded node a simulation ended at; -1 where it ended by termination or horizon.
        ends: int64 [R, W], the node a simulation ended at; -1 after termination.
    """

    edges: Ints
    lengths: Ints
    leaves: Ints
    ends: Ints


def empty_paths(n_roots: int, wave: int, horizon: int) -> Paths:
    """Room for the paths of one wave."""
    shape = (n_roots, wave)
    ints = np.zeros((*shape, horizon), dtype=np.int64)
    return Paths(ints, np.zeros(shape, np.int64), np.full(shape, -1, np.int64), np.full(shape, -1, np.int64))


@compiled
def choose(node: int, q: Floats, visits: Floats, prior_visits: float, weight: float) -> int:
    """The action of ``node`` with the greatest upper confidence bound; one never tried goes first."""
    total = prior_visits * q.shape[1] + visits[node].sum()
    best, chosen = -np.inf, 0
    for a in range(q.shape[1]):
        seen = prior_visits + visits[node, a]
        score = np.inf
        if seen > 0.0:
            score = q[node, a] + weight * np.sqrt(np.log(total + 1.0) / seen)
        if score > best:
            best, chosen = score, a
    return chosen


@compiled
def select(
    roots: Ints,
    graph: GraphArrays,
    q: Floats,
    visits: Floats,
    spans: Floats,
    prior_visits: float,
    c_uct: float,
    key: np.uint64,
    first_simulation: int,
    edges: Ints,
    lengths: Ints,
    leaves: Ints,
    ends: Ints,
) -> None:
    """Runs the wave's simulations of every root from the root to a leaf; fills the last four arguments (see Paths).

    Actions by UCB1 (Auer et al. 2002; Kocsis & Szepesvari 2006) with exploration scaled by ``spans`` [R], the range
    of values seen. Visits are counted on the way down, so that the simulations of a wave spread out; their results come
    in ``back_up`` ("watch the unobserved", Liu et al. 2020). The luck of simulation k is the same for every root.
    """
    n_roots, wave, horizon = edges.shape
    for r in range(n_roots):
        for w in range(wave):
            node, length, leaf = roots[r], 0, -1
            while length < horizon:
                if not graph.expanded[node]:
                    leaf = node
                    break
                chosen = choose(node, q, visits, prior_visits, c_uct * spans[r])
                visits[node, chosen] += 1.0
                luck = uniform_at(key, (first_simulation + w) * horizon + length)
                edge = graph.first[node, chosen]
                last = edge + graph.counts[node, chosen] - 1
                while edge < last and luck >= graph.probabilities[edge]:
                    luck -= graph.probabilities[edge]
                    edge += 1
                edges[r, w, length] = edge
                length += 1
                node = -1 if graph.terminated[edge] else graph.next_nodes[edge]
                if node < 0:
                    break
            if leaf < 0 and node >= 0 and not graph.expanded[node]:
                leaf = node
            lengths[r, w], leaves[r, w], ends[r, w] = length, leaf, node


@compiled
def initialise(nodes: Ints, graph: GraphArrays, rewards: Floats, gamma: float, v: Floats, q: Floats) -> None:
    """Bellman backup of the given nodes [B] from the values ``v`` [N] of their successors, in place."""
    for node in nodes:
        v[node] = bellman(node, graph, rewards, gamma, v, q)


@compiled
def back_up_max(graph: GraphArrays, rewards: Floats, gamma: float, edges: Ints, lengths: Ints, v: Floats, q: Floats) -> None:
    """Bellman backups along every path, end first: trial-based heuristic tree search (Keller & Helmert 2013)."""
    n_roots, wave, _ = edges.shape
    for r in range(n_roots):
        for w in range(wave):
            for step in range(lengths[r, w] - 1, -1, -1):
                node = graph.sources[edges[r, w, step]]
                v[node] = bellman(node, graph, rewards, gamma, v, q)


@compiled
def back_up_mean(
    graph: GraphArrays,
    rewards: Floats,
    gamma: float,
    prior_visits: float,
    edges: Ints,
    lengths: Ints,
    end_values: Floats,
    counted: Floats,
    q: Floats,
    spans: Floats,
    extremes: Floats,
) -> None:
    """Running means of the simulated returns: plain UCT (Kocsis & Szepesvari 2006).

    Args beyond those of ``back_up_max``: ``end_values`` [R, W], value of the node a simulation ended
    at; ``counted`` [N, A], returns averaged so far; ``extremes`` [R, 2], lowest and highest return seen, from which
    ``spans`` [R] follow. All but the first arguments are updated in place.
    """
    n_roots, wave, _ = edges.shape
    for r in range(n_roots):
        for w in range(wave):
            total = end_values[r, w]
            for step in range(lengths[r, w] - 1, -1, -1):
                edge = edges[r, w, step]
                node, a = graph.sources[edge], graph.actions[edge]
                total = rewards[edge] + gamma * total
                counted[node, a] += 1.0
                q[node, a] += (total - q[node, a]) / (prior_visits + counted[node, a])
            extremes[r, 0], extremes[r, 1] = min(extremes[r, 0], total), max(extremes[r, 1], total)
        if extremes[r, 1] > extremes[r, 0]:
            spans[r] = extremes[r, 1] - extremes[r, 0]
