"""The state graph, and the MDP of all states that a model can reach (paper section 2).

The reachable MDP and the search tree are both state graphs: a state reached by two paths is one node. Each node belongs to a
*group*. No edge leads from one group to another, so that the plan for one observation cannot depend on the other observations in
the batch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.kernel import CompiledModel, Kernel, Outcomes, work_for
from mbagent.models.protocol import Successors, TransitionModel
from mbagent.models.systematic_sampling import start as grid_of
from mbagent.types import Bools, Floats, Ints, Keys, States
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.random_keys import derive, mix
from mbagent_envs.structs import Struct

FEWEST_SLOTS = 1024
"""Number of slots of the smallest hash table."""

NODES_AT_ONCE = 16_384
"""Number of successors for which memory is reserved at once, unless one state may have more; 16 bytes per node and action."""


class GraphArrays(Struct):
    """The arrays of a state graph for compiled kernels. N nodes and M edges are in use; the capacity (room) may be larger.

    Attributes:
        states, groups, expanded, first, counts, left_out: see StateGraph, [room, ...].
        reached: whether any non-terminal transition leads to the node, bool [room].
        tags: hash of each node's state and group, uint64 [room].
        next_nodes, probabilities, terminated, sources, actions: see StateGraph, [room].
        slots: hash table of the nodes, -1 where free, int64 [a power of two].
        weights: hash weights, uint64 [F].
        sizes: N and M, int64 [2].
    """

    states: States
    groups: Ints
    expanded: Bools
    first: Ints
    counts: Ints
    left_out: Floats
    reached: Bools
    tags: Keys
    next_nodes: Ints
    probabilities: Floats
    terminated: Bools
    sources: Ints
    actions: Ints
    slots: Ints
    weights: Keys
    sizes: Ints


@compiled
def tag_of(state: Ints, group: int, weights: Keys) -> np.uint64:
    """Hash of a state [F] and a group: two sums of values times half of a weight, since these products are vectorised."""
    half, low, high = np.uint64(0xFFFFFFFF), np.uint64(0), np.uint64(0)
    for f in range(len(state)):
        value = np.uint64(state[f] + 1) & half
        low += value * (weights[f] & half)
        high += value * (weights[f] >> np.uint64(32))
    return mix(mix(low) ^ high ^ mix(np.uint64(group) + np.uint64(1)))


@compiled
def add_node(graph: GraphArrays, state: Ints, group: int) -> int:
    """The node of a state [F] in a group, added if it does not exist. The arrays must have spare capacity."""
    tag, slots, sizes = tag_of(state, group, graph.weights), graph.slots, graph.sizes
    place = np.int64(tag & np.uint64(len(slots) - 1))
    while slots[place] >= 0:
        if graph.tags[slots[place]] == tag:
            return int(slots[place])
        place = (place + 1) & (len(slots) - 1)
    node = sizes[0]
    slots[place] = node
    graph.tags[node] = tag
    graph.groups[node] = group
    graph.expanded[node], graph.reached[node] = False, False
    for f in range(len(state)):
        graph.states[node, f] = state[f]
    for a in range(graph.counts.shape[1]):
        graph.first[node, a], graph.counts[node, a], graph.left_out[node, a] = 0, 0, 0.0
    sizes[0] = node + 1
    return int(node)


@compiled
def add_edge(graph: GraphArrays, source: int, action: int, state: Ints, terminated: bool, probability: float) -> int:
    """Adds a successor of a (node, action) pair, returns the successor's node; add a pair's successors consecutively."""
    target, edge = add_node(graph, state, graph.groups[source]), graph.sizes[1]
    graph.next_nodes[edge], graph.probabilities[edge], graph.terminated[edge] = target, probability, terminated
    graph.sources[edge], graph.actions[edge] = source, action
    if graph.counts[source, action] == 0:
        graph.first[source, action] = edge
    graph.counts[source, action] += 1
    graph.reached[target] |= not terminated
    graph.sizes[1] = edge + 1
    return target


@inlined
def expand_with(
    kernel: Kernel, work: Any, graph: GraphArrays, node: int, n_samples: int, key: np.uint64, offset: float, out: Outcomes
) -> None:
    """Appends all successors of a node, as listed by a kernel."""
    kernel.outcomes(kernel, work, graph.states[node], n_samples, key, offset, out)
    i = 0
    for action in range(len(out.counts)):
        graph.left_out[node, action] = out.left_out[action]
        for _ in range(out.counts[action]):
            add_edge(graph, node, action, out.states[i], out.terminated[i], out.probabilities[i])
            i += 1
    graph.expanded[node] = True


def most_outcomes(n_actions: int, n_samples: int) -> int:
    """Maximum number of outcomes of a state; see ``models.kernel.Kernel.outcomes``."""
    return 2 * n_actions * max(n_samples, 2)


def room_for_outcomes(n_actions: int, n_factors: int, n_samples: int) -> Outcomes:
    """Arrays for all outcomes of a state."""
    most = most_outcomes(n_actions, n_samples)
    return Outcomes(
        np.empty(n_actions, dtype=np.int64),
        np.empty((most, n_factors), dtype=np.int64),
        np.empty(most, dtype=np.bool_),
        np.empty(most, dtype=np.float64),
        np.zeros(n_actions, dtype=np.float64),
    )


@compiled
def _expand_all(
    kernel: Kernel, work: Any, out: Outcomes, graph: GraphArrays, nodes: Ints, n_samples: int, key: np.uint64, offset: float
) -> int:
    """Expands nodes [B] as long as the arrays have capacity; returns the number of expanded nodes."""
    most, done = len(out.probabilities), 0
    for node in nodes:
        if graph.sizes[0] + most > len(graph.states) or graph.sizes[1] + most > len(graph.sources):
            break
        expand_with(kernel, work, graph, node, n_samples, key, offset, out)
        done += 1
    return done


@compiled
def _append(graph: GraphArrays, nodes: Ints, offsets: Ints, states: States, terminated: Bools, probabilities: Floats) -> None:
    """Appends successors listed by a model; row i * A + a of the compressed rows holds those of ``nodes[i]`` under action a."""
    n_actions = graph.counts.shape[1]
    for i in range(len(nodes)):
        for a in range(n_actions):
            for e in range(offsets[i * n_actions + a], offsets[i * n_actions + a + 1]):
                add_edge(graph, nodes[i], a, states[e], terminated[e], probabilities[e])
        graph.expanded[nodes[i]] = True


@compiled
def _add_all(graph: GraphArrays, states: States, groups: Ints, nodes: Ints) -> None:
    for b in range(len(states)):
        nodes[b] = add_node(graph, states[b], groups[b])


@compiled
def _find_all(graph: GraphArrays, states: States, group: int, nodes: Ints) -> None:
    slots = graph.slots
    for b in range(len(states)):
        tag = tag_of(states[b], group, graph.weights)
        place = np.int64(tag & np.uint64(len(slots) - 1))
        nodes[b] = -1
        while slots[place] >= 0:
            if graph.tags[slots[place]] == tag:
                nodes[b] = slots[place]
                break
            place = (place + 1) & (len(slots) - 1)


@compiled
def _place_all(tags: Keys, slots: Ints) -> None:
    """Fills an empty hash table."""
    for node in range(len(tags)):
        place = np.int64(tags[node] & np.uint64(len(slots) - 1))
        while slots[place] >= 0:
            place = (place + 1) & (len(slots) - 1)
        slots[place] = node


_NODE_FIELDS = ("states", "groups", "expanded", "first", "counts", "left_out", "reached", "tags")
_EDGE_FIELDS = ("next_nodes", "probabilities", "terminated", "sources", "actions")


class StateGraph:
    """States, and the successors of every expanded state under each action.

    Shapes: N nodes, A actions, F factors, M successors in all. The successors of node i under action a are at
    ``first[i, a] : first[i, a] + counts[i, a]`` of the successor arrays.

    Args:
        model: transition model that lists the successors.

    Attributes (arrays are views of the part in use):
        states: int64 [N, F]. groups: int64 [N]. expanded: bool [N].
        first, counts: int64 [N, A].
        left_out: float64 [N, A], probability of rare successors that were merged with others, see ``systematic_sampling.py``.
        next_nodes: int64 [M]. probabilities: float64 [M]. terminated: bool [M].
        sources: int64 [M], the predecessor node of each entry. actions: int64 [M].
        arrays: the same arrays for compiled kernels, with spare capacity.
        kernel: the model's arrays for compiled search; None if the model has none.
    """

    def __init__(self, model: TransitionModel) -> None:
        """See the class."""
        self.model = model
        self.kernel = model.kernel() if isinstance(model, CompiledModel) else None
        self._work: tuple[int, Any, Outcomes] | None = None
        n_factors, n_actions = len(model.cardinalities), model.n_actions
        none = np.zeros(0, dtype=np.int64)
        table, flags = np.zeros((0, n_actions), dtype=np.int64), np.zeros(0, dtype=np.bool_)
        self.arrays = GraphArrays(
            np.zeros((0, n_factors), dtype=np.int64), none, flags, table, table, table.astype(np.float64), flags,
            none.astype(np.uint64),
            none, none.astype(np.float64), flags, none, none,
            np.full(FEWEST_SLOTS, -1, dtype=np.int64),
            derive(np.arange(n_factors, dtype=np.uint64), 0x5851F42D) | np.uint64(1),
            np.zeros(2, dtype=np.int64),
        )  # fmt: skip

    def __len__(self) -> int:
        """Number of nodes N."""
        return int(self.arrays.sizes[0])

    @property
    def n_edges(self) -> int:
        """Number of successors M."""
        return int(self.arrays.sizes[1])

    def __getattr__(self, name: str) -> NDArray[Any]:
        """View of the part of an array that is in use."""
        if name in _NODE_FIELDS or name in _EDGE_FIELDS:
            array: NDArray[Any] = getattr(self.arrays, name)
            return array[: self.arrays.sizes[0 if name in _NODE_FIELDS else 1]]
        raise AttributeError(name)

    states: States
    groups: Ints
    expanded: Bools
    first: Ints
    counts: Ints
    left_out: Floats
    next_nodes: Ints
    probabilities: Floats
    terminated: Bools
    sources: Ints
    actions: Ints

    def clear(self) -> None:
        """Removes all states; the memory is kept."""
        self.arrays.slots.fill(-1)
        self.arrays.sizes.fill(0)

    def reserve(self, n_nodes: int, n_edges: int) -> None:
        """Reserves memory for ``n_nodes`` further nodes and ``n_edges`` further edges."""
        arrays = self.arrays
        for extra, fields, used in ((n_nodes, _NODE_FIELDS, len(self)), (n_edges, _EDGE_FIELDS, self.n_edges)):
            old = len(getattr(arrays, fields[0]))
            if used + extra > old:
                size = max(used + extra, 2 * old, 1024)
                arrays = replace(arrays, **{name: _longer(getattr(arrays, name), used, size) for name in fields})
        if 2 * len(arrays.tags) > len(arrays.slots):
            slots = np.full(1 << (2 * len(arrays.tags) - 1).bit_length(), -1, dtype=np.int64)
            _place_all(arrays.tags[: len(self)], slots)
            arrays = replace(arrays, slots=slots)
        self.arrays = arrays

    def add(self, states: States, groups: Ints) -> Ints:
        """Nodes [B] of the given states [B, F] in the given groups [B]; new ones are appended in order of appearance."""
        self.reserve(len(states), 0)
        nodes = np.empty(len(states), dtype=np.int64)
        _add_all(self.arrays, np.ascontiguousarray(states, dtype=np.int64), groups, nodes)
        return nodes

    def find(self, states: States, group: int = 0) -> Ints:
        """Nodes [B] of states [B, F] in one group; -1 for states that this group does not contain."""
        nodes = np.empty(len(states), dtype=np.int64)
        _find_all(self.arrays, np.ascontiguousarray(states, dtype=np.int64), group, nodes)
        return nodes

    def expand(self, nodes: Ints, n_samples: int, seed: int) -> Ints:
        """Expands ``nodes`` [B], which must be distinct and unexpanded: adds their successors under every action.

        Returns:
            the new nodes, in order of appearance, int64.
        """
        size = len(self)
        if self.kernel is not None:
            key, offset = grid_of(seed)
            work, out = self.work_space(n_samples)
            of_one = most_outcomes(self.model.n_actions, n_samples)
            while len(nodes):
                most = of_one * max(1, min(len(nodes), NODES_AT_ONCE // of_one))
                self.reserve(most, most)
                nodes = nodes[_expand_all(self.kernel, work, out, self.arrays, nodes, n_samples, key, offset) :]
        elif len(nodes):
            n_actions = self.model.n_actions
            sources, actions = np.repeat(nodes, n_actions), np.tile(np.arange(n_actions), len(nodes))
            self._append(nodes, self.model.successors(self.states[sources], actions, n_samples, seed))
        return np.arange(size, len(self), dtype=np.int64)

    def work_space(self, n_samples: int) -> tuple[Any, Outcomes]:
        """Work arrays of the kernel and arrays for the outcomes of a state."""
        if self._work is None or self._work[0] != n_samples:
            out = room_for_outcomes(self.model.n_actions, len(self.model.cardinalities), n_samples)
            self._work = n_samples, work_for(self.kernel, n_samples), out
        return self._work[1:]

    def _append(self, nodes: Ints, found: Successors) -> None:
        self.reserve(len(found.states), len(found.states))
        states = np.ascontiguousarray(found.states, dtype=np.int64)
        _append(self.arrays, nodes, found.offsets, states, found.terminated, found.probabilities)

    def only_terminal(self, nodes: Ints) -> Bools:
        """Whether only terminal transitions lead to each of ``nodes`` [B]; these lack successors, except start states."""
        result: Bools = ~self.arrays.reached[nodes]
        return result


def _longer(array: NDArray[Any], used: int, size: int) -> NDArray[Any]:
    """An array of ``size`` rows that begins with a copy of the first ``used`` rows; unwritten rows do not occupy memory yet."""
    longer = np.empty((size, *array.shape[1:]), dtype=array.dtype)
    longer[:used] = array[:used]
    return longer


@dataclass(frozen=True)
class ReachableMDP:
    """States, and the successors of each (state, action) with their probabilities and ``terminated``; no rewards.

    Attributes:
        states: int64 [N, F], the start states first.
        offsets: int64 [N, A + 1]; successors of state i under action a are ``offsets[i, a] : offsets[i, a + 1]``.
        next_states: int64 [M], indices into ``states``.
        probabilities: float64 [M].
        terminated: bool [M].
        complete: whether every reachable state was expanded within the budget. If not, the MDP is partial: states that were
            reached but not expanded have no successors.
    """

    states: States
    offsets: NDArray[np.int64]
    next_states: NDArray[np.int64]
    probabilities: Floats
    terminated: Bools
    complete: bool


MOST_ROOM = 100_000_000
"""Maximum number of (state, action) entries, 16 bytes each, that may be reserved for the outcomes of one state."""


def grow_reachable(
    model: TransitionModel, start: States, max_states: int, n_samples: int, seed: int = 0
) -> tuple[StateGraph, bool]:
    """Expands states breadth-first from ``start`` until none is left or ``max_states`` are expanded.

    Args:
        model: transition model.
        start: int64 [B, F].
        max_states: maximum number of expanded states.
        n_samples: number of samples for a (state, action) with too many successors to enumerate; reduced if there are so many
            actions that their outcomes would need too much memory (MOST_ROOM).
        seed: seed of these samples.

    Returns:
        (graph whose only group is 0, whether every reachable state was expanded).
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
    """The MDP reachable from ``start`` int64 [B, F], as plain arrays; see ``grow_reachable`` for the arguments.

    If more than ``max_states`` states can be reached, the nearest ones are expanded and ``complete`` is False.

    Raises:
        ValueError: ``max_states`` or ``n_samples`` is below 1, or there is no start state.
    """
    for name, value in (("max_states", max_states), ("n_samples", n_samples), ("the number of start states", len(start))):
        if value < 1:
            raise ValueError(f"A reachable MDP needs a state, a sample and a start state, but {name} is {value}; give 1 or more.")
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
