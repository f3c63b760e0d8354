"""What happens between two calls of the goal in a search, compiled: which leaves a wave grows, and what it learns.

Shapes: R roots, W simulations in a wave, N nodes, M edges, A actions, G groups.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.state_graph import GraphArrays
from mbagent.planning.leaf_values import LeafValues, leaf_value
from mbagent.planning.tree import Ints, Paths, back_up_max, back_up_mean, initialise, select
from mbagent.planning.value_iteration import TOLERANCE, sweep
from mbagent_envs._compiled import compiled

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

WIDENING_SWEEPS = 3
"""Sweeps of value iteration after a wave that widened the graph."""


class Tables(NamedTuple):
    """What a search knows of a graph, with room to grow.

    Attributes:
        v: value of each node, [room].
        q: value of each of its actions, [room, A].
        visits: simulations through each of them, [room, A].
        counted: returns averaged so far, [room, A].
        rewards: of each edge, [room].
        frontier: value of unexpanded nodes, [G].
        root_visits: simulations through the roots' actions, [R, A].
        spans: range of the values around each root, [R].
        extremes: lowest and highest return seen, [R, 2].
        leaf: what is known of unexpanded nodes.
    """

    v: Floats
    q: Floats
    visits: Floats
    counted: Floats
    rewards: Floats
    frontier: Floats
    root_visits: Floats
    spans: Floats
    extremes: Floats
    leaf: LeafValues


class Rules(NamedTuple):
    """How to search; see PlannerSettings.

    Attributes:
        gamma: discount of a step.
        c_uct: weight of exploration.
        prior_visits: visits that a first value counts for.
        rollouts: whether leaves are valued by random play.
        mean: whether returns are averaged, instead of the best taken.
        key: of the luck.
    """

    gamma: float
    c_uct: float
    prior_visits: float
    rollouts: bool
    mean: bool
    key: np.uint64


@compiled
def begin_wave(
    graph: GraphArrays, roots: Ints, tables: Tables, rules: Rules, done: int, paths: Paths, leaves: Ints
) -> tuple[int, int]:
    """Runs a wave of simulations down to leaves, after ``done`` others, and writes the nodes to expand to ``leaves`` [2 R W].

    For every simulation that only went round in known states, the state that has waited longest is widened, instead.

    Returns:
        how many nodes to expand, ascending, and how many were widened, which stand from ``leaves[R W]`` on.
    """
    select(
        roots, graph, tables.q, tables.visits, tables.spans, rules.prior_visits, rules.c_uct, rules.key, done,
        paths.edges, paths.lengths, paths.leaves, paths.ends,
    )  # fmt: skip
    n_roots, wave = paths.leaves.shape
    n, n_widened, first = 0, 0, n_roots * wave
    if not rules.rollouts:
        n_widened = _widen(graph, roots, paths, leaves[first:])
    found = np.empty(2 * first, dtype=np.int64)
    for leaf in paths.leaves.ravel():
        if leaf >= 0:
            found[n] = leaf
            n += 1
    for i in range(n_widened):
        found[n] = leaves[first + i]
        n += 1
    ordered, n_distinct = np.sort(found[:n]), 0
    for i in range(n):
        if i == 0 or ordered[i] != ordered[i - 1]:
            leaves[n_distinct] = ordered[i]
            n_distinct += 1
    return n_distinct, n_widened


@compiled
def _widen(graph: GraphArrays, roots: Ints, paths: Paths, out: Ints) -> int:
    """Writes the states that have waited longest, as many for each root as simulations went round; returns how many."""
    n_roots, wave = paths.leaves.shape
    allowance, total = np.zeros(n_roots, dtype=np.int64), 0
    for r in range(n_roots):
        for w in range(wave):
            if paths.leaves[r, w] < 0 and paths.ends[r, w] >= 0:
                allowance[r] += 1
                total += 1
    n = 0
    for node in range(graph.sizes[0]):
        if n == total:
            break
        if graph.expanded[node] or not graph.reached[node]:
            continue
        for r in range(n_roots):
            if graph.groups[roots[r]] == graph.groups[node] and allowance[r] > 0:
                allowance[r] -= 1
                out[n] = node
                n += 1
                break
    return n


@compiled
def end_wave(
    graph: GraphArrays,
    roots: Ints,
    tables: Tables,
    rules: Rules,
    n_before: int,
    leaves: Ints,
    widened: Ints,
    paths: Paths,
    end_values: Floats,
) -> None:
    """Takes in what a wave has found, once its leaves are expanded and the new edges' rewards are known.

    Args:
        graph: what was imagined.
        roots: int64 [R].
        tables: updated.
        rules: of the search.
        n_before: number of nodes before the leaves were expanded.
        leaves: the expanded nodes, ascending.
        widened: those of them that no path led to.
        paths: of the wave.
        end_values: value of the node that each simulation ended at, [R, W]; with ``rules.rollouts`` only.
    """
    n, m = graph.sizes[0], graph.sizes[1]
    v, q, rewards = tables.v[:n], tables.q[:n], tables.rewards[:m]
    for node in range(n_before, n):
        known = len(tables.leaf.common) > 0
        v[node] = leaf_value(tables.leaf, graph.states[node]) if known else tables.frontier[graph.groups[node]]
        q[node], tables.visits[node], tables.counted[node] = 0.0, 0.0, 0.0
    if not rules.rollouts:
        initialise(leaves, graph, rewards, rules.gamma, v, q)
        if len(widened):  # no path leads there yet that a backup would follow
            active = np.zeros(len(tables.frontier), dtype=np.bool_)
            for node in widened:
                active[graph.groups[node]] = True
            sweep(graph, rewards, rules.gamma, TOLERANCE, WIDENING_SWEEPS, active, v, q, tables.frontier, tables.leaf)
        for r in range(len(roots)):
            for w in range(paths.ends.shape[1]):
                end_values[r, w] = v[paths.ends[r, w]] if paths.ends[r, w] >= 0 else 0.0
    if rules.mean:
        back_up_mean(
            graph, rewards, rules.gamma, rules.prior_visits, paths.edges, paths.lengths, end_values,
            tables.counted, q, tables.spans, tables.extremes,
        )  # fmt: skip
    else:
        back_up_max(graph, rewards, rules.gamma, paths.edges, paths.lengths, v, q)
    for r in range(len(roots)):
        for w in range(paths.lengths.shape[1]):
            if paths.lengths[r, w] > 0:
                tables.root_visits[r, graph.actions[paths.edges[r, w, 0]]] += 1.0
    if not rules.rollouts:
        measure_spans(graph, roots, tables)


@compiled
def measure_spans(graph: GraphArrays, roots: Ints, tables: Tables) -> None:
    """Updates the range of the values of the expanded states around each root: at least that of the rewards."""
    n, m, n_groups = graph.sizes[0], graph.sizes[1], len(tables.frontier)
    low, high = np.full(n_groups, np.inf), np.full(n_groups, -np.inf)
    for node in range(n):
        if graph.expanded[node]:
            g = graph.groups[node]
            low[g], high[g] = min(low[g], tables.v[node]), max(high[g], tables.v[node])
    for edge in range(m):
        g = graph.groups[graph.sources[edge]]
        high[g] = max(high[g], low[g] + graph.probabilities[edge] * abs(tables.rewards[edge]))
    for r in range(len(roots)):
        span = high[graph.groups[roots[r]]] - low[graph.groups[roots[r]]]
        tables.spans[r] = span if 0.0 < span < np.inf else 1.0
