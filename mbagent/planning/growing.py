"""Growing a lookahead machine around one root in compiled code; what ``lookahead.grow_lookahead`` does for any model."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.compiled_model import work_for
from mbagent.models.state_graph import GraphArrays, expand_with, most_outcomes, room_for_outcomes
from mbagent_envs._compiled import borrowed, compiled
from mbagent_envs.random_keys import derive_one, uniform_at

Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]

LAYER_WIDTH = 32
"""Draws for a (state, action) are chosen so that a layer's states times draws stay about this many."""

ABOUT_AS_LIKELY = 0.5
"""States at least this share as likely as the likeliest are expanded together."""

_GRID = np.uint64(0x5EED)
_FAR = np.int64(2**62)


@compiled
def n_draws(layer: int, n_samples: int) -> int:
    """Draws for each (state, action) of a layer of so many states: a power of two, ``n_samples`` at most."""
    wanted, draws = max(LAYER_WIDTH // max(layer, 1), 1), 1
    if wanted >= n_samples:
        return n_samples
    while 2 * draws <= wanted:
        draws *= 2
    return min(draws, n_samples)


@compiled
def _next_batch(graph: GraphArrays, nodes: Ints, n: int, reach: Floats, depth: Ints, budget: int, horizon: int) -> int:
    """Sorts the nodes to expand next to the front of the waiting ``nodes`` [n]; returns how many they are.

    They are those about as likely as the likeliest, the likeliest first, then the nearest, then the oldest.
    """
    top = 0.0
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
def grow_around(
    kernel: Any,
    graph: GraphArrays,
    root: int,
    begin: int,
    budget: int,
    n_samples: int,
    horizon: int,
    seed: int,
    reach: Floats,
    depth: Ints,
) -> int:
    """Expands the likeliest states around a root until the budget is used up, or there is no room for the next ones.

    Args:
        kernel: the model's arrays.
        graph: nodes from number ``begin`` on, and the root, belong to this root.
        root: its node.
        begin: number of nodes before growing began.
        budget: states to expand, at most.
        n_samples: draws near the root.
        horizon: steps from the root, at most.
        seed: which random numbers.
        reach: probability of each node's likeliest path from the root, [room]; kept from one call to the next.
        depth: least number of steps to it, int64 [room]; likewise.

    Returns:
        the budget left; 0 if there is nothing more to do.
    """
    n_actions = graph.counts.shape[1]
    made = work_for(kernel, n_samples), room_for_outcomes(n_actions, graph.states.shape[1], n_samples)
    work_out, kernel, graph = borrowed(made), borrowed(kernel), borrowed(graph)
    waiting, chosen, n = np.empty(len(graph.tags), dtype=np.int64), np.empty(budget, dtype=np.int64), 0
    if not graph.expanded[root]:
        reach[root], depth[root] = 1.0, 0
        waiting[0] = root
        n = 1
    for node in range(begin, graph.sizes[0]):
        if not graph.expanded[node] and node != root:
            waiting[n] = node
            n += 1
    while budget > 0:
        size = _next_batch(graph, waiting, n, reach, depth, budget, horizon)
        if size == 0:
            budget = 0
            break
        most = most_outcomes(n_actions, n_samples) * size
        if graph.sizes[0] + most > len(graph.tags) or graph.sizes[1] + most > len(graph.sources):
            break
        for i in range(size):
            chosen[i] = waiting[i]
        n = _drop(waiting, n, size)
        n = _expand_levels(kernel, work_out, graph, chosen[:size], waiting, n, n_samples, seed, reach, depth)
        budget -= size
    return budget + 0 * len(made[1].counts)  # what is lent must live until here


@compiled
def _drop(waiting: Ints, n: int, size: int) -> int:
    """Removes the first ``size`` of ``n`` entries; returns how many are left."""
    for i in range(size, n):
        waiting[i - size] = waiting[i]
    return n - size


@compiled
def _expand_levels(
    kernel: Any,
    work_out: Any,
    graph: GraphArrays,
    chosen: Ints,
    waiting: Ints,
    n: int,
    n_samples: int,
    seed: int,
    reach: Floats,
    depth: Ints,
) -> int:
    """Expands nodes, depth after depth; adds new ones to the ``n`` that are waiting and returns how many these are."""
    first_edge, first_node, last = graph.sizes[1], graph.sizes[0], np.int64(-1)
    for _ in range(len(chosen)):
        level, layer = _FAR, 0
        for node in chosen:
            if last < depth[node] < level:
                level, layer = depth[node], 0
            if depth[node] == level:
                layer += 1
        if layer == 0:
            break
        draws = n_draws(layer, n_samples)
        key = derive_one(derive_one(np.uint64(seed), np.uint64(level)), _GRID)
        offset = uniform_at(key, 0)
        for node in chosen:
            if depth[node] == level:
                expand_with(kernel, work_out[0], graph, node, draws, key, offset, work_out[1])
        last = level
    for node in range(first_node, graph.sizes[0]):
        reach[node], depth[node] = 0.0, _FAR
        waiting[n] = node
        n += 1
    for edge in range(first_edge, graph.sizes[1]):
        if not graph.terminated[edge]:
            source, target = graph.sources[edge], graph.next_nodes[edge]
            reach[target] = max(reach[target], reach[source] * graph.probabilities[edge])
            depth[target] = min(depth[target], depth[source] + 1)
    return n
