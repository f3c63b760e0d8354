"""Tree search on a lookahead: long runs of compiled simulations, interrupted only to expand further states.

Trial-based heuristic tree search (Keller and Helmert 2013) with transpositions: actions are selected by upper confidence bounds
(Auer et al. 2002), successors are sampled, and Bellman backups follow the path back. A simulation ends at an unexpanded state, at
the end of the episode, or after ``horizon`` steps. Simulations run in batches whose size grows with the number of simulations
done; those of a batch see each other's visits, but not yet their values ("watch the unobserved", Liu et al. 2020). A batch that
reaches no unexpanded state needs neither model nor goal, so the next one follows in the same compiled call.
Shapes: N nodes, M edges, A actions, F factors, R roots, W simulations in a batch, H horizon.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.models.mdp import GraphArrays, StateGraph
from mbagent.planning.lookahead import grow_lookahead
from mbagent.planning.planners import Expanded, ValueIterationPlanner
from mbagent.planning.value_iteration import (
    LOWEST_KNOWN,
    TOLERANCE,
    LeafValues,
    Values,
    bellman,
    break_ties,
    score_edges,
    settle,
    sweep,
)
from mbagent.types import Floats, Ints, States
from mbagent_envs.jit import borrowed, compiled, inlined
from mbagent_envs.random_keys import derive, derive_one, mix
from studies.planning.machine_search import BOUND_BELOW, BOUND_TOP, MOST_VISITS

FIRST_SWEEPS, GROWING_SWEEPS, GRAPH_FINAL_SWEEPS = 10, 3, 100
"""Maximum number of sweeps of value iteration: before the first simulation, after each expansion, after the last simulation."""

GRAPH_LEAF_SAMPLES = 4
"""Number of samples for each (state, action) of a node that the search expands."""

FIRST_BATCH, BATCH_SHARE = 8, 4
"""Simulations of the first batch; the size of later ones is at most the number of earlier simulations divided by BATCH_SHARE."""

_GRAPH_SALT = 0x6EA6C4
_GRAPH_STEP = np.uint64(0x9E3779B97F4A7C15)
_GRAPH_UNIT = 2.0**-53


class Tables(NamedTuple):
    """Statistics of a search on a graph, with spare capacity.

    Attributes:
        v, q, rewards, frontier: see ``value_iteration.Values``.
        n: simulations through each (node, action), int64 [room, A].
        met: simulations through each node, int64 [room].
        weight: probability of an edge times discount, 0 where the episode ends, [room].
        income: expected reward of each (node, action), [room, A].
        path: nodes and actions on the paths of the batch's simulations, int64 [R, W, H, 2].
        lengths: of the paths, int64 [R, W].
        leaves: distinct unexpanded nodes that the batch reached, int64 [R * W].
        spans: range of the values of the expanded nodes around each root, [R].
        root_visits: simulations through the roots' actions, [R, A].
    """

    v: Floats
    q: Floats
    rewards: Floats
    frontier: Floats
    n: Ints
    met: Ints
    weight: Floats
    income: Floats
    path: Ints
    lengths: Ints
    leaves: Ints
    spans: Floats
    root_visits: Floats


class Rules(NamedTuple):
    """Parameters of a search; see PlannerSettings.

    Attributes:
        n_simulations: for each root.
        batch_size: maximum number of simulations of a root in a batch.
        gamma: discount of a step.
        c_uct: weight of exploration.
        prior_visits: number of visits that an initial value counts as.
        key: of the random numbers.
    """

    n_simulations: int
    batch_size: int
    gamma: float
    c_uct: float
    prior_visits: int
    key: np.uint64


class GraphSearch(ValueIterationPlanner):
    """UCT on lookaheads around the roots, for thousands of simulations.

    Every search starts from the values of a lookahead, each of which counts as ``prior_visits`` visits, and expands it where
    simulations leave it. ``batch_size`` bounds the number of simulations of a root between two calls of the model.

    Attributes:
        expanded: number of successors sampled from the model so far; equal ones of a (state, action) are counted once.
    """

    expanded = 0

    def _expand(self, roots: States) -> Expanded:
        """Searches from each root [R, F]."""
        graph, settings = self._empty_graph(), self.settings
        nodes = graph.add(roots, np.arange(len(roots), dtype=np.int64))
        grow_lookahead(graph, nodes, settings.lookahead_states, settings.lookahead_samples, settings.horizon, settings.seed)
        zeros, n_simulations = np.zeros((len(graph), graph.model.n_actions)), settings.num_simulations
        first = Values(zeros[:, 0].copy(), zeros, score_edges(graph, self._known_goal()), np.zeros(len(roots)))
        settle(graph, first, settings.gamma, FIRST_SWEEPS)
        tables = _tables(graph, first, len(roots), min(settings.batch_size, n_simulations), settings.horizon)
        weigh(graph.arrays, tables, settings.gamma, 0)
        measure_spans(graph.arrays, tables)
        key = np.uint64(derive(settings.seed, _GRAPH_SALT)[0])
        rules = Rules(n_simulations, settings.batch_size, settings.gamma, settings.c_uct, int(settings.prior_visits), key)
        done, growths = np.zeros(2, dtype=np.int64), 0
        while n := run_batches(graph.arrays, nodes, tables, rules, BOUND_TOP, BOUND_BELOW, done):
            growths += 1
            tables = self._grown(graph, nodes, tables, n, int(derive(settings.seed, _GRAPH_SALT, growths)[0]))
        size, n_edges = len(graph), graph.n_edges
        self.expanded += n_edges
        solution = Values(tables.v[:size], tables.q[:size], tables.rewards[:n_edges], tables.frontier)
        settle(graph, solution, settings.gamma, GRAPH_FINAL_SWEEPS)
        scores = break_ties(graph, solution.q, nodes, settings.gamma)
        return Expanded(graph, nodes, solution, tables.root_visits, scores)

    def _grown(self, graph: StateGraph, roots: Ints, tables: Tables, n: int, seed: int) -> Tables:
        """Expands the ``n`` leaves that a batch reached, and updates the tables."""
        leaves, n_nodes, n_edges = np.sort(tables.leaves[:n]), len(graph), graph.n_edges
        graph.expand(leaves, GRAPH_LEAF_SAMPLES, seed)
        tables = _lengthened(tables, len(graph.arrays.tags), len(graph.arrays.sources))
        tables.rewards[n_edges : graph.n_edges] = score_edges(graph, self._known_goal(), n_edges)
        weigh(graph.arrays, tables, self.settings.gamma, n_edges)
        take_in(graph.arrays, tables, self.settings.gamma, leaves, n_nodes, LOWEST_KNOWN)
        return tables


def _tables(graph: StateGraph, first: Values, n_roots: int, batch_size: int, horizon: int) -> Tables:
    """Tables before the first simulation."""
    tables = Tables(
        first.v, first.q, first.rewards, first.frontier,
        np.zeros(first.q.shape, dtype=np.int64), np.zeros(len(first.v), dtype=np.int64),
        np.empty(len(first.rewards)), np.empty(first.q.shape),
        np.empty((n_roots, batch_size, horizon, 2), dtype=np.int64), np.zeros((n_roots, batch_size), dtype=np.int64),
        np.empty(n_roots * batch_size, dtype=np.int64), np.empty(n_roots), np.zeros((n_roots, graph.model.n_actions)),
    )  # fmt: skip
    return _lengthened(tables, len(graph.arrays.tags), len(graph.arrays.sources))


def _lengthened(tables: Tables, n: int, m: int) -> Tables:
    """Tables with room for n nodes and m edges."""
    longer = {}
    for names, size in ((("v", "q", "n", "met", "income"), n), (("rewards", "weight"), m)):
        for name in names:
            old = getattr(tables, name)
            if len(old) < size:
                longer[name] = np.empty((size, *old.shape[1:]), dtype=old.dtype)
                longer[name][: len(old)] = old
    return tables._replace(**longer)


@compiled
def weigh(graph: GraphArrays, tables: Tables, gamma: float, first_edge: int) -> None:
    """Computes ``weight`` and ``income`` of the edges from number ``first_edge`` on, which are all edges of their nodes."""
    rewards, weight, income = tables.rewards, tables.weight, tables.income
    node = -1
    for edge in range(first_edge, graph.sizes[1]):
        if graph.sources[edge] != node:
            node = graph.sources[edge]
            for a in range(income.shape[1]):
                income[node, a] = 0.0
        probability = graph.probabilities[edge]
        income[node, graph.actions[edge]] += probability * rewards[edge]
        weight[edge] = 0.0 if graph.terminated[edge] else gamma * probability


@compiled
def measure_spans(graph: GraphArrays, tables: Tables) -> None:
    """Updates the range of the values around each root r, those of group r; 1 if all are equal."""
    low, high = np.full(len(tables.spans), np.inf), np.full(len(tables.spans), -np.inf)
    for node in range(graph.sizes[0]):
        if graph.expanded[node]:
            g = graph.groups[node]
            low[g], high[g] = min(low[g], tables.v[node]), max(high[g], tables.v[node])
    for r in range(len(low)):
        tables.spans[r] = high[r] - low[r] if high[r] > low[r] else 1.0


@compiled
def take_in(graph: GraphArrays, tables: Tables, gamma: float, leaves: Ints, n_before: int, leaf: LeafValues) -> None:
    """Initialises values of the expanded ``leaves`` and of the nodes from number ``n_before`` on, then sweeps their groups."""
    n, m = graph.sizes[0], graph.sizes[1]
    v, q, rewards, active = tables.v[:n], tables.q[:n], tables.rewards[:m], np.zeros(len(tables.frontier), dtype=np.bool_)
    for node in range(n_before, n):
        v[node], tables.met[node] = tables.frontier[graph.groups[node]], 0
        q[node], tables.n[node] = 0.0, 0
    for node in leaves:
        tables.met[node] = 0
        v[node] = bellman(node, graph, rewards, gamma, v, q)
        active[graph.groups[node]] = True
    sweep(graph, rewards, gamma, TOLERANCE, GROWING_SWEEPS, active, v, q, tables.frontier, leaf)
    measure_spans(graph, tables)


@inlined
def _descend(
    r: int, w: int, root: int, noise: np.uint64, scale: float, prior: int, graph: GraphArrays, top: Floats, below: Floats,
    q: Floats, n: Ints, met: Ints, path: Ints,
) -> tuple[int, int, np.uint64]:  # fmt: skip
    """Runs simulation w from root r.

    Returns:
        (length, the unexpanded node that it reached or -1, state of the random numbers).
    """
    first, counts, probabilities = graph.first, graph.counts, graph.probabilities
    following, terminated, expanded, n_actions = graph.next_nodes, graph.terminated, graph.expanded, q.shape[1]
    s, length, leaf = root, 0, -1
    while length < path.shape[2]:
        noise += _GRAPH_STEP
        word, factor = mix(noise), scale * top[min(met[s] + prior * n_actions, MOST_VISITS - 1)]
        best, a = -np.inf, 0
        for b in range(n_actions):
            score = q[s, b] + factor * below[min(n[s, b] + prior, MOST_VISITS - 1)]
            # Ties are broken at random: in a fixed order, simulations may repeat the same few states for ever.
            if score > best or (score == best and (word >> np.uint64(b % 11)) & np.uint64(1)):
                best, a = score, b
        n[s, a] += 1
        met[s] += 1
        path[r, w, length, 0], path[r, w, length, 1] = s, a
        length += 1
        u, e = float(word >> np.uint64(11)) * _GRAPH_UNIT, first[s, a]
        last = e + counts[s, a] - 1
        while e < last and u >= probabilities[e]:
            u -= probabilities[e]
            e += 1
        if terminated[e]:
            break
        s = following[e]
        if not expanded[s]:
            leaf = s
            break
    return length, leaf, noise


@inlined
def _back_up(
    r: int, w: int, length: int, graph: GraphArrays, weight: Floats, income: Floats, q: Floats, v: Floats, path: Ints
) -> None:
    """Bellman backups of the (node, action) pairs of simulation w from root r, the last one first."""
    first, counts, following = graph.first, graph.counts, graph.next_nodes
    for i in range(length - 1, -1, -1):
        s, a = path[r, w, i, 0], path[r, w, i, 1]
        total, begin = income[s, a], first[s, a]
        for e in range(begin, begin + counts[s, a]):
            total += weight[e] * v[following[e]]
        q[s, a] = total
        best = q[s, 0]
        for b in range(1, q.shape[1]):
            best = max(best, q[s, b])
        v[s] = best


@compiled
def _run_batch(graph: GraphArrays, roots: Ints, t: Tables, rules: Rules, top: Floats, below: Floats, done: int, size: int) -> int:
    """Runs the simulations of a batch; returns the number of distinct unexpanded nodes that they reach."""
    q, n, met, path, lengths, leaves, n_leaves = t.q, t.n, t.met, t.path, t.lengths, t.leaves, 0
    for r in range(len(roots)):
        root, scale = roots[r], rules.c_uct * t.spans[r]
        noise = derive_one(rules.key, np.uint64(done))  # the same for every root
        for w in range(size):
            lengths[r, w], leaf, noise = _descend(
                r, w, root, noise, scale, rules.prior_visits, graph, top, below, q, n, met, path
            )
            t.root_visits[r, path[r, w, 0, 1]] += 1.0
            if leaf >= 0 and met[leaf] == 0:
                met[leaf] = 1  # an unexpanded node with this mark is listed already
                leaves[n_leaves] = leaf
                n_leaves += 1
    return n_leaves


@compiled
def run_batches(graph: GraphArrays, roots: Ints, tables: Tables, rules: Rules, top: Floats, below: Floats, done: Ints) -> int:
    """Runs batches until all simulations are done, or a batch reaches unexpanded nodes.

    Args:
        graph: the state graph.
        roots: int64 [R].
        tables: updated.
        rules: of the search.
        top: factor of the upper confidence bound that depends on total visits, see ``machine_search``.
        below: factor that depends on an action's visits.
        done: number of simulations done, and of those in a batch that waits for expansions, int64 [2]; updated.

    Returns:
        number of nodes, listed in ``tables.leaves``, to expand before the search can continue; 0 if it is complete.
    """
    graph, t = borrowed(graph), borrowed(tables)
    while True:
        for r in range(len(roots)):
            for w in range(done[1]):
                _back_up(r, w, t.lengths[r, w], graph, t.weight, t.income, t.q, t.v, t.path)
        done[0] += done[1]
        done[1] = min(max(done[0] // BATCH_SHARE, FIRST_BATCH), rules.batch_size, rules.n_simulations - done[0])
        if done[1] == 0:
            return 0
        n_leaves = _run_batch(graph, roots, t, rules, top, below, done[0], done[1])
        if n_leaves > 0:
            return n_leaves
