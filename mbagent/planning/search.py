"""Tree search for stochastic models, compiled: select, expand, back up (paper section 4.1).

The "tree" is a graph: a state reached on two paths is one node (a transposition). Every (node, action) keeps several sampled
successors. Simulations run in batches, with one call of the reward function after each. Shapes: R roots, W simulations of a
batch, H horizon, N nodes, M successor edges, A actions, G groups.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.models.mdp import GraphArrays, StateGraph, add_edge, add_node
from mbagent.planning.value_iteration import TOLERANCE, LeafValues, bellman, leaf_value, sweep
from mbagent.types import Floats, Ints
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at


class Paths(NamedTuple):
    """Paths of the simulations of one batch.

    Attributes:
        edges: int64 [R, W, H], successor edges taken, in order.
        lengths: int64 [R, W], number of edges.
        leaves: int64 [R, W], the unexpanded node at which a simulation ended; -1 if it ended by termination or horizon.
        ends: int64 [R, W], the node at which a simulation ended; -1 after termination.
    """

    edges: Ints
    lengths: Ints
    leaves: Ints
    ends: Ints


def empty_paths(n_roots: int, batch_size: int, horizon: int) -> Paths:
    """Arrays for the paths of one batch."""
    shape = (n_roots, batch_size)
    ints = np.zeros((*shape, horizon), dtype=np.int64)
    return Paths(ints, np.zeros(shape, np.int64), np.full(shape, -1, np.int64), np.full(shape, -1, np.int64))


@compiled
def choose(node: int, q: Floats, visits: Floats, prior_visits: float, weight: float) -> int:
    """The action of ``node`` with the greatest upper confidence bound, which is infinite for actions without visits."""
    total = prior_visits * q.shape[1] + visits[node].sum()
    best, chosen = -np.inf, 0
    for a in range(q.shape[1]):
        n_visits = prior_visits + visits[node, a]
        score = np.inf
        if n_visits > 0.0:
            score = q[node, a] + weight * np.sqrt(np.log(total + 1.0) / n_visits)
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
    """Runs the simulations of a batch from every root to a leaf; fills the last four arguments (see Paths).

    Actions are selected by UCB1 (Auer et al. 2002; Kocsis & Szepesvari 2006) with exploration scaled by ``spans`` [R], the
    range of values. Visits are counted on the way down, so that the simulations of a batch spread out; their values follow
    in ``back_up_max`` or ``back_up_mean`` ("watch the unobserved", Liu et al. 2020). Simulation k uses the same random
    numbers for every root.
    """
    n_roots, n_simulations, horizon = edges.shape
    for r in range(n_roots):
        for w in range(n_simulations):
            node, length, leaf = roots[r], 0, -1
            while length < horizon:
                if not graph.expanded[node]:
                    leaf = node
                    break
                chosen = choose(node, q, visits, prior_visits, c_uct * spans[r])
                visits[node, chosen] += 1.0
                noise = uniform_at(key, (first_simulation + w) * horizon + length)
                edge = graph.first[node, chosen]
                last = edge + graph.counts[node, chosen] - 1
                while edge < last and noise >= graph.probabilities[edge]:
                    noise -= graph.probabilities[edge]
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
    """Bellman backups along every path, from its end to the root: trial-based heuristic tree search (Keller & Helmert 2013)."""
    n_roots, n_simulations, _ = edges.shape
    for r in range(n_roots):
        for w in range(n_simulations):
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
    """Running means of the simulated returns: UCT (Kocsis and Szepesvari 2006).

    The initial value counts as ``prior_visits`` returns. Arguments that ``back_up_max`` does not have: ``prior_visits``;
    ``end_values`` [R, W], value of the node at which a simulation ended; ``counted`` [N, A], number of averaged returns;
    ``extremes`` [R, 2], lowest and highest return, from which ``spans`` [R] are computed. ``counted``, ``q``, ``spans`` and
    ``extremes`` are updated in place.
    """
    n_roots, n_simulations, _ = edges.shape
    for r in range(n_roots):
        for w in range(n_simulations):
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


WIDENING_SWEEPS = 3
"""Number of sweeps of value iteration after a batch that widened the graph."""


class Tables(NamedTuple):
    """Statistics of a search on a graph, with spare capacity.

    Attributes:
        v: value of each node, [room].
        q: value of each of its actions, [room, A].
        visits: simulations through each of them, [room, A].
        counted: number of averaged returns, [room, A].
        rewards: of each edge, [room].
        frontier: value of unexpanded nodes without learned values, [G].
        root_visits: simulations through the roots' actions, [R, A].
        spans: range of the values around each root, [R].
        extremes: lowest and highest return, [R, 2].
        leaf: learned values of unexpanded nodes.
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
    """Parameters of a search; see PlannerSettings.

    Attributes:
        gamma: discount of a step.
        c_uct: weight of exploration.
        prior_visits: number of visits that an initial value counts as.
        rollouts: whether leaves are evaluated by random play.
        mean: whether backups are means of returns instead of Bellman backups.
        key: of the random numbers.
    """

    gamma: float
    c_uct: float
    prior_visits: float
    rollouts: bool
    mean: bool
    key: np.uint64


@compiled
def begin_batch(
    graph: GraphArrays, roots: Ints, tables: Tables, rules: Rules, done: int, paths: Paths, leaves: Ints
) -> tuple[int, int]:
    """Runs a batch of simulations to leaves, after ``done`` earlier ones, and writes the nodes to expand to ``leaves`` [2 R W].

    For every simulation that visits only expanded states, the oldest unexpanded state is expanded instead (widening).

    Returns:
        number of nodes to expand, which are sorted, and number of those by widening, which are repeated from ``leaves[R W]`` on.
    """
    select(
        roots, graph, tables.q, tables.visits, tables.spans, rules.prior_visits, rules.c_uct, rules.key, done,
        paths.edges, paths.lengths, paths.leaves, paths.ends,
    )  # fmt: skip
    n_roots, n_simulations = paths.leaves.shape
    n, n_widened, first = 0, 0, n_roots * n_simulations
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
    """Writes the oldest unexpanded nodes, for each root as many as simulations visited only expanded ones; returns the number."""
    n_roots, n_simulations = paths.leaves.shape
    allowance, total = np.zeros(n_roots, dtype=np.int64), 0
    for r in range(n_roots):
        for w in range(n_simulations):
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
def end_batch(
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
    """Backs up the values of a batch after its leaves are expanded and the new edges' rewards are known.

    Args:
        graph: the state graph.
        roots: int64 [R].
        tables: updated.
        rules: of the search.
        n_before: number of nodes before the leaves were expanded.
        leaves: the expanded nodes, sorted.
        widened: those of them that were expanded by widening, not reached by a path.
        paths: of the batch.
        end_values: value of the node at which each simulation ended, [R, W]; an input only with ``rules.rollouts``.
    """
    n, m = graph.sizes[0], graph.sizes[1]
    v, q, rewards = tables.v[:n], tables.q[:n], tables.rewards[:m]
    for node in range(n_before, n):
        known = len(tables.leaf.common) > 0
        v[node] = leaf_value(tables.leaf, graph.states[node]) if known else tables.frontier[graph.groups[node]]
        q[node], tables.visits[node], tables.counted[node] = 0.0, 0.0, 0.0
    if not rules.rollouts:
        initialise(leaves, graph, rewards, rules.gamma, v, q)
        if len(widened):  # no path leads there, so no backup would propagate their values
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
    """Updates the range of the values of the expanded states around each root: at least that of the expected rewards."""
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


def carry_over(old: StateGraph, tables: Tables, root: int, new: StateGraph) -> Tables:
    """Copies the part of a search with one root that is reachable from another of its nodes.

    Args:
        old: the graph of that search.
        tables: its statistics.
        root: node of ``old`` that becomes the root.
        new: another graph of the same model; overwritten, with ``root`` as its node 0.

    Returns:
        the tables of ``new``. Earlier simulations through the new root's actions count as visits of the root.
    """
    new.clear()
    new.reserve(len(old), old.n_edges)
    nodes, edges = np.empty(len(old), dtype=np.int64), np.empty(old.n_edges, dtype=np.int64)
    _copy_reachable(old.arrays, new.arrays, root, nodes, edges)
    nodes, edges = nodes[: len(new)], edges[: new.n_edges]
    visits = tables.visits[nodes]
    return tables._replace(
        v=tables.v[nodes],
        q=tables.q[nodes],
        visits=visits,
        counted=tables.counted[nodes],
        rewards=tables.rewards[edges],
        root_visits=visits[:1].copy(),
    )
