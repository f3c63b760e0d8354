"""A machine of its own for each root: what is likely to happen soon, imagined wide near the root and thin further on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.state_graph import StateGraph, most_outcomes
from mbagent.planning.growing import ABOUT_AS_LIKELY, LAYER_WIDTH, grow_around
from mbagent_envs.random_keys import derive


def layer_seed(seed: int, depth: int) -> int:
    """Random numbers of one depth: shared by all states and actions there, so that imagined luck is the same for all."""
    return int(derive(seed, depth)[0])


def grow_lookahead(graph: StateGraph, roots: NDArray[np.int64], max_states: int, n_samples: int, horizon: int, seed: int) -> None:
    """Expands the graph around every root, each in its own group, until a budget a root is used up.

    The likeliest states go first: what the agent's own moves surely lead to is known before luck is followed, so that
    one event with many outcomes near the root (a new maze, say) does not use up the budget and leave the sure part of
    the world a blank. Among equally likely states the nearest go first. The draws for each (state, action) shrink from
    ``n_samples`` near the root to one further on, so that the budget reaches deep: with shared random numbers, states
    that differ only in what the agent did merge again.

    Args:
        graph: holds the roots, root g in group g, and nothing else.
        roots: int64 [R], their nodes.
        max_states: states expanded for each root, at most (the root itself always is).
        n_samples: draws near the root.
        horizon: steps from the root, at most.
        seed: which random numbers.
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
        reach, depth = _follow(graph, start, reach, depth)


def _likeliest(
    graph: StateGraph, reach: NDArray[np.float64], depth: NDArray[np.int64], budget: NDArray[np.int64], horizon: int
) -> NDArray[np.int64]:
    """The nodes to expand next: of each group those about as likely as its likeliest, nearest first, within the budget."""
    waiting = np.flatnonzero(~graph.expanded & (reach > 0.0) & (depth < horizon))
    groups = graph.groups[waiting]
    top = np.zeros(len(budget))
    np.maximum.at(top, groups, reach[waiting])
    likely = reach[waiting] >= ABOUT_AS_LIKELY * top[groups]
    nodes = waiting[likely]
    nodes = nodes[np.lexsort((nodes, depth[nodes], -reach[nodes]))]
    groups = graph.groups[nodes]
    return nodes[place_in_group(groups) < budget[groups]]


def _follow(
    graph: StateGraph, start: int, reach: NDArray[np.float64], depth: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Reach and depth of all nodes after edges from number ``start`` on were added.

    A node's reach is the probability of its likeliest path from the root, the agent's own choices counting as sure.
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
    """Draws for layers of the given sizes: a power of two (few different values make few model calls), or n_samples."""
    wanted = np.maximum(LAYER_WIDTH // np.maximum(sizes, 1), 1)
    powers = 2 ** np.floor(np.log2(wanted)).astype(np.int64)
    return np.where(wanted >= n_samples, n_samples, np.minimum(powers, n_samples))


def place_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Running number of each entry within its group."""
    order = np.argsort(groups, kind="stable")
    ordered = groups[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]]) if len(groups) else np.zeros(0, dtype=np.int64)
    lengths = np.diff(np.r_[starts, len(groups)])
    place = np.empty_like(groups)
    place[order] = np.arange(len(groups)) - np.repeat(starts, lengths)
    return place


def _grow_compiled(graph: StateGraph, roots: NDArray[np.int64], max_states: int, n_samples: int, horizon: int, seed: int) -> None:
    """The same with a model that compiled code can ask: one root after the other."""
    n_actions = graph.model.n_actions
    for root in roots:
        budget, begin, at_once = max_states, len(graph), 64
        reach, depth = np.zeros(0), np.zeros(0, dtype=np.int64)
        while budget > 0:
            most = most_outcomes(n_actions, n_samples) * min(budget, at_once)
            graph.reserve(most, most)
            more = len(graph.arrays.tags) - len(reach)
            reach, depth = np.append(reach, np.zeros(more)), np.append(depth, np.zeros(more, dtype=np.int64))
            left = grow_around(graph.kernel, graph.arrays, root, begin, budget, n_samples, horizon, seed, reach, depth)
            if left == budget:  # there was no room for all that are about as likely
                at_once *= 2
            budget = left
