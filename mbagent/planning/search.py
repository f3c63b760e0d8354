"""Tree search for stochastic models, compiled: simulate, expand, back up (paper section 4.1).

The "tree" is a graph: a state reached on two paths is one node (a transposition). Every (node, action) keeps several sampled
successors. Simulations run in batches, one batch after the other in compiled code, until a batch reaches unexpanded nodes; then
these are expanded by one call of the model and one of the reward function. Shapes: R roots, W simulations of a batch, H horizon,
N nodes, M successor edges, A actions, G groups (one for each root).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mbagent.models.mdp import GraphArrays, StateGraph, add_edge, add_node
from mbagent.planning.value_iteration import Values, bellman, leaf_value, sweep
from mbagent.types import Floats, Ints
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.structs import Struct

BATCH_SHARE, LARGEST_BATCH = 4, 256
"""A batch may have a BATCH_SHARE-th of the simulations done before, at most LARGEST_BATCH: it does not see its own values."""

WIDENING_SWEEPS = 3
"""Number of sweeps of value iteration after a batch that widened the graph."""


class SearchRules(Struct):
    """Parameters of a search; see PlannerSettings.

    Attributes:
        gamma: discount of a step.
        c_uct: weight of exploration.
        prior_visits: number of visits that an initial value counts for.
        rollouts: whether leaves are evaluated by random play.
        batch_size: number of simulations of the first batches.
        mean: True to back up means of returns, False for Bellman backups.
        key: of the random numbers, uint64.
    """

    gamma: float
    c_uct: float
    prior_visits: float
    rollouts: bool
    batch_size: int
    mean: bool
    key: np.uint64


class SearchTree(Struct):
    """Statistics of a search on a graph, with spare capacity.

    Attributes:
        roots: nodes from which simulations start, int64 [R].
        values: of all nodes, [room, ...].
        visits: visit count of each action in each node, [room, A].
        counted: number of averaged returns, [room, A].
        root_visits: number of simulations that start with each root action, [R, A].
        spans: range of the values around each root, [R].
        extremes: lowest and highest return of each root, [R, 2].
    """

    roots: Ints
    values: Values
    visits: Floats
    counted: Floats
    root_visits: Floats
    spans: Floats
    extremes: Floats


class Batch(Struct):
    """Paths of the simulations of one batch, and the nodes to expand after it.

    Attributes:
        edges: successor edges taken, in order, int64 [R, W, H].
        lengths: number of edges of each path, int64 [R, W].
        leaves: the unexpanded node at which a simulation ended; -1 if it ended by termination or horizon, int64 [R, W].
        ends: the node at which a simulation ended; -1 after termination, int64 [R, W].
        end_values: value of that node, [R, W].
        reached: unexpanded nodes at which simulations ended, in order, with repetitions, int64 [R W].
        widened: further nodes to expand, int64 [R W].
        allowance: number of nodes that may still be widened around each root, int64 [R].
    """

    edges: Ints
    lengths: Ints
    leaves: Ints
    ends: Ints
    end_values: Floats
    reached: Ints
    widened: Ints
    allowance: Ints


def empty_batch(n_roots: int, batch_size: int, total: int, horizon: int) -> Batch:
    """Arrays for the paths of any batch, of at least ``batch_size`` of ``total`` simulations from each root."""
    most = min(total, max(batch_size, min(total // BATCH_SHARE, LARGEST_BATCH)))
    shape, size = (n_roots, most), n_roots * most
    edges, ints = np.zeros((*shape, horizon), dtype=np.int64), np.zeros((5, size), dtype=np.int64)
    lengths, leaves, ends = (row.reshape(shape) for row in ints[:3])
    return Batch(edges, lengths, leaves, ends, np.zeros(shape), ints[3], ints[4], np.zeros(n_roots, dtype=np.int64))


@compiled
def advance(
    graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, done: int, total: int
) -> tuple[int, int, int, int]:
    """Runs batches after ``done`` simulations from each root, until nodes must be expanded or ``total`` simulations are done.

    With rollouts, only one batch: its leaves must be evaluated.

    Returns:
        the number of simulations that were backed up; and of the batch that was not: the number of simulations, of nodes reached,
        and of nodes to expand by widening.
    """
    while done < total:
        size = min(max(rules.batch_size, done // BATCH_SHARE), batch.lengths.shape[1], total - done)
        simulate(graph, tree, rules, batch, done, size)
        n_reached, n_widened = _nodes_to_expand(graph, tree, rules, batch, size)
        if n_reached > 0 or n_widened > 0 or rules.rollouts:
            return done, size, n_reached, n_widened
        backup(graph, tree, rules, batch, size)
        done += size
    return done, 0, 0, 0


@compiled
def simulate(graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, done: int, size: int) -> None:
    """Runs ``size`` simulations from every root to a leaf, after ``done`` earlier ones.

    Visits are counted on the way down, so that the simulations of a batch spread out; their values follow in ``backup`` ("watch
    the unobserved", Liu et al. 2020). Simulation k uses the same random numbers for every root.
    """
    horizon = batch.edges.shape[2]
    for r in range(len(tree.roots)):
        weight = rules.c_uct * tree.spans[r]
        for w in range(size):
            node, length, leaf = tree.roots[r], 0, -1
            while length < horizon:
                if not graph.expanded[node]:
                    leaf = node
                    break
                chosen = select(tree, node, rules.prior_visits, weight)
                tree.visits[node, chosen] += 1.0
                noise = uniform_at(rules.key, (done + w) * horizon + length)
                edge = graph.first[node, chosen]
                last = edge + graph.counts[node, chosen] - 1
                while edge < last and noise >= graph.probabilities[edge]:
                    noise -= graph.probabilities[edge]
                    edge += 1
                batch.edges[r, w, length] = edge
                length += 1
                node = -1 if graph.terminated[edge] else graph.next_nodes[edge]
                if node < 0:
                    break
            if leaf < 0 and node >= 0 and not graph.expanded[node]:
                leaf = node
            batch.lengths[r, w], batch.leaves[r, w], batch.ends[r, w] = length, leaf, node


@inlined
def select(tree: SearchTree, node: int, prior_visits: float, weight: float) -> int:
    """The action with the greatest upper confidence bound: UCB1 (Auer et al. 2002; Kocsis & Szepesvari 2006).

    The bound is infinite without visits. ``weight`` is that of exploration, times the range of values.
    """
    q, visits = tree.values.q, tree.visits
    n_simulations = 0.0
    for a in range(q.shape[1]):
        n_simulations += visits[node, a]
    explore = np.log(prior_visits * q.shape[1] + n_simulations + 1.0)
    best, chosen = -np.inf, 0
    for a in range(q.shape[1]):
        n_visits, score = prior_visits + visits[node, a], np.inf
        if n_visits > 0.0:
            score = q[node, a] + weight * np.sqrt(explore / n_visits)
        if score > best:
            best, chosen = score, a
    return chosen


@compiled
def _nodes_to_expand(graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, size: int) -> tuple[int, int]:
    """Writes the nodes to expand to ``batch.reached`` and ``batch.widened``; returns their numbers.

    For every simulation that ended at the horizon among expanded states, the oldest unexpanded state around the root is expanded
    instead (widening), except with rollouts.
    """
    n_reached, allowed, n_widened = 0, 0, 0
    for r in range(len(tree.roots)):
        batch.allowance[r] = 0
        for w in range(size):
            if batch.leaves[r, w] >= 0:
                batch.reached[n_reached] = batch.leaves[r, w]
                n_reached += 1
            elif batch.ends[r, w] >= 0 and not rules.rollouts:
                batch.allowance[r] += 1
                allowed += 1
    for node in range(graph.sizes[0] if allowed > 0 else 0):
        if graph.expanded[node] or not graph.reached[node]:
            continue
        for r in range(len(tree.roots)):
            if graph.groups[tree.roots[r]] == graph.groups[node] and batch.allowance[r] > 0:
                batch.allowance[r] -= 1
                batch.widened[n_widened] = node
                n_widened += 1
                break
        if n_widened == allowed:
            break
    return n_reached, n_widened


@compiled
def take_in(
    graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, n_before: int, expanded: Ints, n_widened: int
) -> None:
    """Initialises nodes after the expansion that a batch asked for, when the rewards of all edges are known.

    Args:
        graph: the state graph.
        tree: updated.
        rules: of the search.
        batch: the batch.
        n_before: number of nodes before the expansion.
        expanded: the expanded nodes, sorted.
        n_widened: number of nodes in ``batch.widened``.
    """
    values, v, q = tree.values, tree.values.v, tree.values.q
    known = len(values.leaf.common) > 0
    for node in range(n_before, graph.sizes[0]):
        v[node] = leaf_value(values.leaf, graph.states[node]) if known else values.frontier[graph.groups[node]]
        for a in range(q.shape[1]):
            q[node, a], tree.visits[node, a], tree.counted[node, a] = 0.0, 0.0, 0.0
    if rules.rollouts:
        return
    for node in expanded:
        v[node] = bellman(node, graph, values.rewards, rules.gamma, v, q)
    if n_widened > 0:  # no path leads there, so no backup would propagate their values
        active = np.zeros(len(values.frontier), dtype=np.bool_)
        for i in range(n_widened):
            active[graph.groups[batch.widened[i]]] = True
        sweep(graph, values, rules.gamma, WIDENING_SWEEPS, active)


@compiled
def backup(graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, size: int) -> None:
    """Propagates values along the paths of a batch, whose ``end_values`` are inputs only with rollouts."""
    for r in range(len(tree.roots)):
        for w in range(size):
            if not rules.rollouts:
                batch.end_values[r, w] = tree.values.v[batch.ends[r, w]] if batch.ends[r, w] >= 0 else 0.0
    for r in range(len(tree.roots)):
        for w in range(size):
            if rules.mean:
                _back_up_mean(graph, tree, rules, batch, r, w)
            else:
                _back_up_max(graph, tree, rules, batch, r, w)
            if batch.lengths[r, w] > 0:
                tree.root_visits[r, graph.actions[batch.edges[r, w, 0]]] += 1.0
        if rules.mean and tree.extremes[r, 1] > tree.extremes[r, 0]:
            tree.spans[r] = tree.extremes[r, 1] - tree.extremes[r, 0]
    if not rules.rollouts:
        measure_spans(graph, tree)


@inlined
def _back_up_max(graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, r: int, w: int) -> None:
    """Bellman backups along a path, from its end to the root: trial-based heuristic tree search (Keller & Helmert 2013)."""
    values = tree.values
    for step in range(batch.lengths[r, w] - 1, -1, -1):
        node = graph.sources[batch.edges[r, w, step]]
        values.v[node] = bellman(node, graph, values.rewards, rules.gamma, values.v, values.q)


@inlined
def _back_up_mean(graph: GraphArrays, tree: SearchTree, rules: SearchRules, batch: Batch, r: int, w: int) -> None:
    """Running means of the simulated returns along a path: UCT (Kocsis and Szepesvari 2006).

    The initial value counts as ``prior_visits`` returns.
    """
    total, q, rewards = batch.end_values[r, w], tree.values.q, tree.values.rewards
    for step in range(batch.lengths[r, w] - 1, -1, -1):
        edge = batch.edges[r, w, step]
        node, a = graph.sources[edge], graph.actions[edge]
        total = rewards[edge] + rules.gamma * total
        tree.counted[node, a] += 1.0
        q[node, a] += (total - q[node, a]) / (rules.prior_visits + tree.counted[node, a])
    tree.extremes[r, 0], tree.extremes[r, 1] = min(tree.extremes[r, 0], total), max(tree.extremes[r, 1], total)


@compiled
def measure_spans(graph: GraphArrays, tree: SearchTree) -> None:
    """Updates the range of the values of the expanded states around each root.

    The range is at least the largest probability times absolute reward of an edge.
    """
    v, rewards, n_groups = tree.values.v, tree.values.rewards, len(tree.values.frontier)
    low, high = np.empty(n_groups, dtype=np.float64), np.empty(n_groups, dtype=np.float64)
    for g in range(n_groups):
        low[g], high[g] = np.inf, -np.inf
    for node in range(graph.sizes[0]):
        if graph.expanded[node]:
            g = graph.groups[node]
            low[g], high[g] = min(low[g], v[node]), max(high[g], v[node])
    for edge in range(graph.sizes[1]):
        g = graph.groups[graph.sources[edge]]
        high[g] = max(high[g], low[g] + graph.probabilities[edge] * abs(rewards[edge]))
    for r in range(len(tree.roots)):
        span = high[graph.groups[tree.roots[r]]] - low[graph.groups[tree.roots[r]]]
        tree.spans[r] = span if 0.0 < span < np.inf else 1.0


MAX_KEPT = 20_000
"""Maximum number of nodes of a graph that is reused."""


@compiled
def _copy_reachable(old: GraphArrays, new: GraphArrays, root: int, nodes: Ints, edges: Ints) -> None:
    """Copies the states reachable from ``root`` into an empty graph, breadth first.

    Writes the old index of each new node and edge to ``nodes`` and ``edges``.
    """
    nodes[add_node(new, old.states[root], old.groups[root])] = root
    done = 0
    while done < new.sizes[0]:
        node = nodes[done]
        if old.expanded[node]:
            for action in range(old.counts.shape[1]):
                for edge in range(old.first[node, action], old.first[node, action] + old.counts[node, action]):
                    edges[new.sizes[1]] = edge
                    target = old.next_nodes[edge]
                    place = add_edge(new, done, action, old.states[target], old.terminated[edge], old.probabilities[edge])
                    nodes[place] = target
            new.expanded[done] = True
        done += 1


def carry_over(old: StateGraph, tree: SearchTree, root: int, new: StateGraph) -> SearchTree:
    """Copies the part of a single-root search that is reachable from another node, the new root.

    Args:
        old: the graph of that search.
        tree: its statistics.
        root: node of ``old`` that becomes the root.
        new: another graph of the same model; overwritten, with ``root`` as its node 0.

    Returns:
        the statistics of ``new``. Earlier simulations through the new root's actions count as visits of the root.
    """
    new.clear()
    new.reserve(len(old), old.n_edges)
    nodes, edges = np.empty(len(old), dtype=np.int64), np.empty(old.n_edges, dtype=np.int64)
    _copy_reachable(old.arrays, new.arrays, root, nodes, edges)
    nodes, edges = nodes[: len(new)], edges[: new.n_edges]
    values, visits = tree.values, tree.visits[nodes]
    return replace(
        tree,
        roots=np.zeros(1, dtype=np.int64),
        values=replace(values, v=values.v[nodes], q=values.q[nodes], rewards=values.rewards[edges]),
        visits=visits,
        counted=tree.counted[nodes],
        root_visits=visits[:1].copy(),
    )
