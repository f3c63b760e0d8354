"""A growing graph of imagined states: which states each (state, action) may lead to (paper section 2).

Both the reachable finite-state machine and the search tree are such graphs. States met twice share one node.
Nodes belong to *groups*: a group never looks into another one, so that what is imagined for one root observation cannot
depend on which other observations are planned for in the same batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Bools, Floats, States, Successors, TransitionModel, hash_rows
from mbagent_envs.random_keys import derive

Indices = NDArray[np.int64]


class GraphArrays(NamedTuple):
    """What compiled kernels need of a graph; shapes and meanings as in StateGraph."""

    groups: Indices
    expanded: Bools
    first: Indices
    counts: Indices
    next_nodes: Indices
    probabilities: Floats
    terminated: Bools
    sources: Indices
    actions: Indices


class StateGraph:
    """States, and for every expanded (state, action) its successors.

    Shapes: N nodes, A actions, F factors, M successors in all. The successors of node i under action a lie at
    ``first[i, a] : first[i, a] + count[i, a]`` of the successor arrays.

    Args:
        model: where successors come from.

    Attributes (arrays are views of what is filled so far):
        states: int64 [N, F]. groups: int64 [N]. expanded: bool [N].
        first, counts: int64 [N, A].
        next_nodes: int64 [M]. probabilities: float64 [M]. terminated: bool [M].
        sources: int64 [M], the node each successor comes from. actions: int64 [M].
    """

    def __init__(self, model: TransitionModel) -> None:
        """See the class."""
        self.model = model
        n_factors, n_actions = len(model.cardinalities), model.n_actions
        self._index: dict[int, int] = {}
        self._nodes = _Table(
            states=np.zeros((0, n_factors), dtype=np.int64),
            groups=np.zeros(0, dtype=np.int64),
            expanded=np.zeros(0, dtype=np.bool_),
            first=np.zeros((0, n_actions), dtype=np.int64),
            counts=np.zeros((0, n_actions), dtype=np.int64),
        )
        self._edges = _Table(
            next_nodes=np.zeros(0, dtype=np.int64),
            probabilities=np.zeros(0, dtype=np.float64),
            terminated=np.zeros(0, dtype=np.bool_),
            sources=np.zeros(0, dtype=np.int64),
            actions=np.zeros(0, dtype=np.int64),
        )

    def __len__(self) -> int:
        """Number of nodes N."""
        return self._nodes.size

    @property
    def n_edges(self) -> int:
        """Number of successors M."""
        return self._edges.size

    def __getattr__(self, name: str) -> NDArray[np.generic]:
        """The filled part of the array ``name``."""
        for table in (self.__dict__.get("_nodes"), self.__dict__.get("_edges")):
            if table is not None and name in table.arrays:
                view: NDArray[np.generic] = table.view(name)
                return view
        raise AttributeError(name)

    states: States
    groups: Indices
    expanded: Bools
    first: Indices
    counts: Indices
    next_nodes: Indices
    probabilities: Floats
    terminated: Bools
    sources: Indices
    actions: Indices

    @property
    def arrays(self) -> GraphArrays:
        """Views of what is filled so far."""
        return GraphArrays(*(getattr(self, name) for name in GraphArrays._fields))

    def add(self, states: States, groups: Indices) -> Indices:
        """Nodes [B] of the given states [B, F] in the given groups [B]; new ones are appended in order of appearance."""
        tags = derive(hash_rows(states), groups)
        _, first, inverse = np.unique(tags, return_index=True, return_inverse=True)
        order = np.argsort(first, kind="stable")
        nodes = np.empty(len(first), dtype=np.int64)
        fresh: list[int] = []
        size = len(self)
        for unique in order:
            tag = int(tags[first[unique]])
            node = self._index.get(tag)
            if node is None:
                node = size + len(fresh)
                self._index[tag] = node
                fresh.append(first[unique])
            nodes[unique] = node
        if fresh:
            self._nodes.append(
                len(fresh),
                states=states[fresh],
                groups=groups[fresh],
            )
        return nodes[inverse]

    def find(self, states: States, group: int = 0) -> Indices:
        """Nodes [B] of states [B, F] in one group, -1 where there is none."""
        tags = derive(hash_rows(states), np.full(len(states), group))
        return np.array([self._index.get(int(tag), -1) for tag in tags], dtype=np.int64)

    def expand(self, nodes: Indices, n_samples: int, seed: int) -> Indices:
        """Asks the model for the successors of unexpanded, distinct ``nodes`` [B] under every action.

        Returns:
            the nodes that were new, in order of appearance, int64.
        """
        if len(nodes) == 0:
            return np.zeros(0, dtype=np.int64)
        n_actions = self.model.n_actions
        sources = np.repeat(nodes, n_actions)
        actions = np.tile(np.arange(n_actions), len(nodes))
        found = self.model.successors(self.states[sources], actions, n_samples, seed)
        return self._append(nodes, sources, actions, found)

    def _append(self, nodes: Indices, sources: Indices, actions: Indices, found: Successors) -> Indices:
        rows, size, start = found.rows, len(self), self.n_edges
        next_nodes = self.add(found.states, self.groups[sources[rows]])
        self._edges.append(
            len(rows),
            next_nodes=next_nodes,
            probabilities=found.probabilities,
            terminated=found.terminated,
            sources=sources[rows],
            actions=actions[rows],
        )
        shape = (len(nodes), self.model.n_actions)
        self.first[nodes] = start + found.offsets[:-1].reshape(shape)
        self.counts[nodes] = np.diff(found.offsets).reshape(shape)
        self.expanded[nodes] = True
        return np.arange(size, len(self), dtype=np.int64)

    def only_terminal(self, nodes: Indices) -> Bools:
        """Whether each of the new ``nodes`` [B] was reached by terminated transitions only: nothing comes after it."""
        alive = np.zeros(len(self), dtype=np.bool_)
        alive[self.next_nodes[~self.terminated]] = True
        return ~alive[nodes]


class _Table:
    """Arrays that grow together by doubling."""

    def __init__(self, **arrays: NDArray[np.generic]) -> None:
        self.arrays = arrays
        self.size = 0

    def view(self, name: str) -> NDArray[np.generic]:
        return self.arrays[name][: self.size]

    def append(self, n: int, **rows: NDArray[np.generic]) -> None:
        """Appends n rows; arrays not named are filled with zeros."""
        capacity = len(next(iter(self.arrays.values())))
        if self.size + n > capacity:
            more = max(1024, capacity, n)
            for name, array in self.arrays.items():
                self.arrays[name] = np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])
        for name, values in rows.items():
            self.arrays[name][self.size : self.size + n] = values
        self.size += n
