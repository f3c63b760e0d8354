"""The finite-state machine of all states a model can reach (paper section 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Bools, Floats, States, TransitionModel
from mbagent.models.state_graph import StateGraph


@dataclass(frozen=True)
class ReachableMDP:
    """States, and for each (state, action) the successors with probability and terminated; no rewards.

    Attributes:
        states: int64 [N, F], the start states first.
        offsets: int64 [N, A + 1]; successors of state i under action a are ``offsets[i, a] : offsets[i, a + 1]``.
        next_states: int64 [M], indices of states.
        probabilities: float64 [M].
        terminated: bool [M].
        complete: whether every reachable state was expanded within the budget. If not, the machine is partial: states
            that were met but not expanded have no successors.
    """

    states: States
    offsets: NDArray[np.int64]
    next_states: NDArray[np.int64]
    probabilities: Floats
    terminated: Bools
    complete: bool


MOST_ROOM = 100_000_000
"""Entries of a graph's tables of (state, action) that the outcomes of one state may make room for, 16 bytes each."""


def grow_reachable(
    model: TransitionModel, start: States, max_states: int, n_samples: int, seed: int = 0
) -> tuple[StateGraph, bool]:
    """Expands states breadth-first from ``start`` until none is left or ``max_states`` are expanded.

    Args:
        model: the model to imagine with.
        start: int64 [B, F].
        max_states: number of states expanded at most.
        n_samples: draws for a (state, action) with too many successors to enumerate; fewer where there are so many actions
            that room for their outcomes would be too large.
        seed: which random numbers those draws use.

    Returns:
        (graph with one group 0, whether every reachable state was expanded).
    """
    n_samples = max(1, min(n_samples, MOST_ROOM // (2 * model.n_actions**2)))
    graph = StateGraph(model)
    layer = np.unique(graph.add(start, np.zeros(len(start), dtype=np.int64)))
    expanded = 0
    while len(layer):
        layer = layer[: max_states - expanded]
        if len(layer) == 0:
            return graph, False
        expanded += len(layer)
        graph.expand(layer, n_samples, seed)
        waiting = np.flatnonzero(~graph.expanded)
        layer = waiting[~graph.only_terminal(waiting)]
    return graph, True


def reachable_mdp(
    model: TransitionModel, start: States, max_states: int = 10_000, n_samples: int = 32, seed: int = 0
) -> ReachableMDP:
    """The machine reachable from ``start`` int64 [B, F], as plain arrays; see ``grow_reachable`` for the arguments.

    Where more than ``max_states`` states can be reached, the nearest ones are expanded and ``complete`` is False.

    Raises:
        ValueError: a budget of no states or no draws, or no start state.
    """
    for name, value in (("max_states", max_states), ("n_samples", n_samples), ("the number of start states", len(start))):
        if value < 1:
            raise ValueError(f"A machine needs at least one of each, but {name} is {value}; give 1 or more.")
    graph, complete = grow_reachable(model, start, max_states, n_samples, seed)
    order = np.lexsort((graph.actions, graph.sources))
    counts = graph.counts
    ends = np.cumsum(counts.ravel()).reshape(counts.shape)
    starts = ends[:, :1] - counts[:, :1]
    return ReachableMDP(
        states=graph.states.copy(),
        offsets=np.concatenate([starts, ends], axis=1),
        next_states=graph.next_nodes[order],
        probabilities=graph.probabilities[order],
        terminated=graph.terminated[order],
        complete=complete,
    )
