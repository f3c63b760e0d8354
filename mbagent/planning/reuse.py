"""Taking the part of a search that still matters along to the next decision."""

from __future__ import annotations

import numpy as np

from mbagent.models.state_graph import GraphArrays, StateGraph, add_edge, add_node
from mbagent.planning.tree import Ints
from mbagent.planning.waves import Tables
from mbagent_envs._compiled import compiled

MAX_KEPT = 20_000
"""Nodes taken along, at most; of a larger graph nothing is."""


@compiled
def _copy_reachable(old: GraphArrays, new: GraphArrays, root: int, nodes: Ints, edges: Ints) -> None:
    """Copies what can be reached from ``root`` into an empty graph, breadth first.

    Writes the old number of each new node and edge to ``nodes`` and ``edges``.
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
    """Copies what a search of one root knows of the states reachable from another of its nodes.

    Args:
        old: the graph of that search.
        tables: what it found.
        root: node of ``old`` to begin from.
        new: another graph of the same model; overwritten, and ``root`` is its node 0.

    Returns:
        the tables of ``new``. Simulations through the new root's actions count as its own.
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
