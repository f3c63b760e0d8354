"""Best-first lookahead: the MDP of the most probable states around each root, with more samples near the root.

For models with compiled kernels, the expansion is compiled, too; the result is the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.kernel import Kernel, Outcomes
from mbagent.models.mdp import GraphArrays, StateGraph, expand_with
from mbagent.types import Floats, Ints
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive, derive_one, uniform_at
from mbagent_envs.structs import Struct

LAYER_WIDTH = 32
"""Approximate number of states times samples for each (state, action) in a layer, from which the number of samples follows."""

ABOUT_AS_LIKELY = 0.5
"""States whose probability is at least this share of the highest one are expanded together."""

_GRID = np.uint64(0x5EED)
_FAR = np.int64(2**62)


class Growth(Struct):
    """State of the expansion around a root, kept between calls of ``grow_around``.

    Attributes:
        root: its node.
        begin: number of nodes before the expansion: later ones, and the root, belong to this root.
        n_samples: number of samples near the root.
        horizon: maximum number of steps from the root.
        seed: of the random numbers.
        reach: probability of each node's most probable path from the root, [room].
        depth: minimum number of steps to each node, int64 [room].
        waiting: work space for the unexpanded nodes, int64 [room].
        chosen: work space for the nodes that are expanded together, int64 [budget].
    """

    root: int
    begin: int
    n_samples: int
    horizon: int
    seed: int
    reach: Floats
    depth: Ints
    waiting: Ints
    chosen: Ints


@compiled
def n_draws(layer: int, n_samples: int) -> int:
    """Samples per (state, action) in a layer of size ``layer``: ``n_samples``; in large ones, a smaller power of two."""
    wanted, draws = max(LAYER_WIDTH // max(layer, 1), 1), 1
    if wanted >= n_samples:
        return n_samples
    while 2 * draws <= wanted:
        draws *= 2
    return min(draws, n_samples)


@compiled
def _next_batch(growth: Growth, n: int, budget: int) -> int:
    """Moves the nodes to expand next to the front of the ``n`` unexpanded nodes; returns their number.

    These are the nodes with almost the highest probability (ABOUT_AS_LIKELY), sorted by probability, then depth, then number.
    """
    nodes, reach, depth, horizon, top = growth.waiting, growth.reach, growth.depth, growth.horizon, 0.0
    for i in range(n):
        if depth[nodes[i]] < horizon:
            top = max(top, reach[nodes[i]])
    if top <= 0.0:
        return 0
    size = 0
    for i in range(n):
        node = nodes[i]
        if depth[node] < horizon and reach[node] >= ABOUT_AS_LIKELY * top:
            place = size
            nodes[i] = nodes[size]
            while place > 0 and _before(node, nodes[place - 1], reach, depth):
                nodes[place] = nodes[place - 1]
                place -= 1
            nodes[place] = node
            size += 1
    return min(size, budget)


@compiled
def _before(node: int, other: int, reach: Floats, depth: Ints) -> bool:
    if reach[node] != reach[other]:
        return bool(reach[node] > reach[other])
    if depth[node] != depth[other]:
        return bool(depth[node] < depth[other])
    return node < other


@compiled
def grow_around(kernel: Kernel, work: Any, out: Outcomes, graph: GraphArrays, growth: Growth, budget: int) -> int:
    """Expands the most probable states around a root until the budget is used, or the arrays have no room for the next batch.

    Args:
        kernel: the model's arrays.
        work: see ``StateGraph.work_space``.
        out: likewise.
        graph: the state graph.
        growth: the root, and what is known of its nodes.
        budget: maximum number of states to expand.

    Returns:
        the remaining budget; 0 if nothing remains to be expanded.
    """
    root, waiting, n = growth.root, growth.waiting, 0
    if not graph.expanded[root]:
        growth.reach[root], growth.depth[root] = 1.0, 0
        waiting[0] = root
        n = 1
    for node in range(growth.begin, graph.sizes[0]):
        if not graph.expanded[node] and node != root:
            waiting[n] = node
            n += 1
    while budget > 0:
        size = _next_batch(growth, n, budget)
        if size == 0:
            budget = 0
            break
        n_needed = len(out.probabilities) * size
        if graph.sizes[0] + n_needed > len(graph.tags) or graph.sizes[1] + n_needed > len(graph.sources):
            break
        for i in range(size):
            growth.chosen[i] = waiting[i]
        n = _drop(waiting, n, size)
        n = _expand_levels(kernel, work, out, graph, growth, size, n)
        budget -= size
    return budget


@compiled
def _drop(waiting: Ints, n: int, size: int) -> int:
    """Removes the first ``size`` of ``n`` entries; returns the number of remaining entries."""
    for i in range(size, n):
        waiting[i - size] = waiting[i]
    return n - size


@compiled
def _expand_levels(kernel: Kernel, work: Any, out: Outcomes, graph: GraphArrays, growth: Growth, size: int, n: int) -> int:
    """Expands the ``size`` chosen nodes by increasing depth; adds new nodes to the ``n`` waiting ones, returns their number."""
    chosen, reach, depth = growth.chosen[:size], growth.reach, growth.depth
    first_edge, first_node, last = graph.sizes[1], graph.sizes[0], np.int64(-1)
    for _ in range(size):
        level, layer = _FAR, 0
        for node in chosen:
            if last < depth[node] < level:
                level, layer = depth[node], 0
            if depth[node] == level:
                layer += 1
        if layer == 0:
            break
        draws = n_draws(layer, growth.n_samples)
        key = derive_one(derive_one(np.uint64(growth.seed), np.uint64(level)), _GRID)
        offset = uniform_at(key, 0)
        for node in chosen:
            if depth[node] == level:
                expand_with(kernel, work, graph, node, draws, key, offset, out)
        last = level
    for node in range(first_node, graph.sizes[0]):
        reach[node], depth[node] = 0.0, _FAR
        growth.waiting[n] = node
        n += 1
    for edge in range(first_edge, graph.sizes[1]):
        if not graph.terminated[edge]:
            source, target = graph.sources[edge], graph.next_nodes[edge]
            reach[target] = max(reach[target], reach[source] * graph.probabilities[edge])
            depth[target] = min(depth[target], depth[source] + 1)
    return n


def layer_seed(seed: int, depth: int) -> int:
    """Seed for one depth: all its states and actions share random numbers, so that they differ only in their effects."""
    return int(derive(seed, depth)[0])


def grow_lookahead(graph: StateGraph, roots: NDArray[np.int64], max_states: int, n_samples: int, horizon: int, seed: int) -> None:
    """Expands the graph around every root, each root in its own group, until every root's budget is used up.

    The most probable states are expanded first; among equally probable states, the nearest first. So states that the agent's
    actions reach with certainty come before states reached by chance, and one random event with many outcomes near the root
    (such as a new maze) does not use up the budget. The number of samples for each (state, action) decreases from ``n_samples``
    near the root to one further away, so that the budget suffices for deep states. Since random numbers are shared, states that
    differ only because of the agent's past actions can become equal again, which saves budget.

    Args:
        graph: contains only the roots; root g is in group g.
        roots: int64 [R], nodes of the roots.
        max_states: maximum number of states expanded for each root, including the root, which is always expanded.
        n_samples: number of samples near the root.
        horizon: maximum number of steps from the root.
        seed: of the random numbers.
    """
    if graph.kernel is not None:
        _grow_compiled(graph, roots, max_states, n_samples, horizon, seed)
        return
    budget = np.full(len(roots), max_states, dtype=np.int64)
    reach, depth = np.zeros(len(graph)), np.zeros(len(graph), dtype=np.int64)
    reach[roots] = 1.0
    while True:
        chosen = _likeliest(graph, reach, depth, budget, horizon)
        if len(chosen) == 0:
            return
        budget -= np.bincount(graph.groups[chosen], minlength=len(roots))
        start = graph.n_edges
        for level in np.unique(depth[chosen]):
            layer = chosen[depth[chosen] == level]
            sizes = np.bincount(graph.groups[layer], minlength=len(roots))
            draws = _draws(sizes, n_samples)[graph.groups[layer]]
            for n in np.unique(draws):
                graph.expand(layer[draws == n], int(n), layer_seed(seed, int(level)))
        reach, depth = _update_reach(graph, start, reach, depth)


def _likeliest(
    graph: StateGraph, reach: NDArray[np.float64], depth: NDArray[np.int64], budget: NDArray[np.int64], horizon: int
) -> NDArray[np.int64]:
    """Nodes to expand next, within the budget: in each group those that ``_next_batch`` would select, in the same order."""
    waiting = np.flatnonzero(~graph.expanded & (reach > 0.0) & (depth < horizon))
    groups = graph.groups[waiting]
    top = np.zeros(len(budget))
    np.maximum.at(top, groups, reach[waiting])
    likely = reach[waiting] >= ABOUT_AS_LIKELY * top[groups]
    nodes = waiting[likely]
    nodes = nodes[np.lexsort((nodes, depth[nodes], -reach[nodes]))]
    groups = graph.groups[nodes]
    return nodes[place_in_group(groups) < budget[groups]]


def _update_reach(
    graph: StateGraph, start: int, reach: NDArray[np.float64], depth: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Reach and depth of all nodes, updated for the new edges: those from index ``start`` on.

    The reach of a node is the probability of its most probable path from the root, given that path's actions.
    """
    alive = ~graph.terminated[start:]
    sources, targets = graph.sources[start:][alive], graph.next_nodes[start:][alive]
    fresh = len(graph) - len(reach)
    reach = np.concatenate([reach, np.zeros(fresh)])
    depth = np.concatenate([depth, np.full(fresh, np.iinfo(np.int64).max)])
    np.maximum.at(reach, targets, reach[sources] * graph.probabilities[start:][alive])
    np.minimum.at(depth, targets, depth[sources] + 1)
    return reach, depth


def _draws(sizes: NDArray[np.int64], n_samples: int) -> NDArray[np.int64]:
    """Numbers of samples for layer sizes: n_samples or lower powers of two (few distinct values need few model calls)."""
    wanted = np.maximum(LAYER_WIDTH // np.maximum(sizes, 1), 1)
    powers = 2 ** np.floor(np.log2(wanted)).astype(np.int64)
    return np.where(wanted >= n_samples, n_samples, np.minimum(powers, n_samples))


def place_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of each entry within its group."""
    order = np.argsort(groups, kind="stable")
    ordered = groups[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]]) if len(groups) else np.zeros(0, dtype=np.int64)
    lengths = np.diff(np.r_[starts, len(groups)])
    place = np.empty_like(groups)
    place[order] = np.arange(len(groups)) - np.repeat(starts, lengths)
    return place


def _grow_compiled(graph: StateGraph, roots: NDArray[np.int64], max_states: int, n_samples: int, horizon: int, seed: int) -> None:
    """``grow_lookahead`` for models with compiled kernels, one root at a time."""
    kernel, (work, out) = graph.kernel, graph.work_space(n_samples)
    assert kernel is not None
    for root in roots:
        budget, begin, at_once = max_states, len(graph), 64
        reach, depth = np.zeros(0), np.zeros(0, dtype=np.int64)
        while budget > 0:
            n_needed = len(out.probabilities) * min(budget, at_once)
            graph.reserve(n_needed, n_needed)
            room = len(graph.arrays.tags)
            reach, depth = np.append(reach, np.zeros(room - len(reach))), np.append(depth, np.zeros(room - len(depth), np.int64))
            waiting, chosen = np.empty(room, dtype=np.int64), np.empty(budget, dtype=np.int64)
            growth = Growth(int(root), begin, n_samples, horizon, int(seed), reach, depth, waiting, chosen)
            left = grow_around(kernel, work, out, graph.arrays, growth, budget)
            if left == budget:  # there was no room for the next batch
                at_once *= 2
            budget = left
