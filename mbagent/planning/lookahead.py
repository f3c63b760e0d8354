"""A machine of its own for each root: what can happen soon, imagined wide near the root and thin further on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.state_graph import StateGraph
from mbagent_envs.random_keys import derive

LAYER_WIDTH = 32
"""Draws for a (state, action) are chosen so that a layer's states times draws stay about this many."""


def layer_seed(seed: int, depth: int) -> int:
    """Random numbers of one depth: shared by all states and actions there, so that imagined luck is the same for all."""
    return int(derive(seed, depth)[0])


def grow_lookahead(graph: StateGraph, roots: NDArray[np.int64], max_states: int, n_samples: int, horizon: int, seed: int) -> None:
    """Expands the graph breadth-first around every root, each in its own group, until a budget a root is used up.

    The draws for each (state, action) shrink from ``n_samples`` near the root to one further on, so that the budget
    reaches deep: with shared random numbers, states that differ only in what the agent did merge again.

    Args:
        graph: holds the roots, root g in group g, and nothing else.
        roots: int64 [R], their nodes.
        max_states: states expanded for each root, at most (the root itself always is).
        n_samples: draws near the root.
        horizon: layers, at most.
        seed: which random numbers.
    """
    budget = np.full(len(roots), max_states, dtype=np.int64)
    layer = roots
    for depth in range(horizon):
        groups = graph.groups[layer]
        sizes = np.bincount(groups, minlength=len(roots))
        place = place_in_group(groups)
        keep = place < budget[groups]
        layer, groups = layer[keep], groups[keep]
        if len(layer) == 0:
            return
        budget -= np.bincount(groups, minlength=len(roots))
        draws = _draws(sizes, n_samples)[groups]
        before = len(graph)
        for n in np.unique(draws):
            graph.expand(layer[draws == n], int(n), layer_seed(seed, depth))
        fresh = np.arange(before, len(graph), dtype=np.int64)
        layer = fresh[~graph.only_terminal(fresh)]


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
