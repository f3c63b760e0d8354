"""Grounding: from graphs with relative features, one set for each channel, to graphs of every cell of a board of any size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbagent.models.dbn.arrays import Graphs, linked, n_features
from mbagent.models.dbn.features import ActionEncoding, Layout, layout_with_mutexes, make_layout
from mbagent.models.dbn.invariants import NO_INVARIANTS, Invariants, radix
from mbagent.models.dbn.plane_features import ACTION, ADJACENCY, BORDER, NEXT, NEXT_ADJACENCY, WRAP
from mbagent.spaces import PlaneLayout
from mbagent.types import Ints

WHOLE, ROW, COLUMN = 0, 1, 2
"""Cells of a channel that form a mutex group: all of them, or those of a row or column."""


class Mutex(NamedTuple):
    """Cells of a channel of which at most one is on after a step.

    Attributes:
        channel: the channel, of bits.
        kind: WHOLE, ROW or COLUMN.
        line: number of the row or column, from the top or left; if it is nearer to the other end, counted from there, -1 first.
        exactly: whether exactly one is on.
    """

    channel: int
    kind: int
    line: int
    exactly: bool

    def lies_on(self, height: int, width: int) -> bool:
        """Whether a board has this line."""
        length = {WHOLE: 1, ROW: height, COLUMN: width}[self.kind]
        return -length <= self.line < length

    def cells(self) -> tuple[slice | int, slice | int]:
        """Indices of its rows and columns."""
        rows = self.line if self.kind == ROW else slice(None)
        cols = self.line if self.kind == COLUMN else slice(None)
        return rows, cols


@dataclass(frozen=True)
class LocalGraphs:
    """Graphs, mutex groups and invariants that are the same at every position.

    Attributes:
        graphs: variables are the channels, then ``terminated`` and the reset; features are relative.
        synchronic: graphs of channels whose cells have synchronic arcs; cells are drawn from the upper left on, channel after
            channel.
        features: the relative features, int64 [D, 7], see ``plane_features.py``.
        cardinalities: number of values of each channel's cells, length C.
        encoding: the actions.
        mutexes: mutex groups of cells.
        invariants: properties that every transition preserves.
    """

    graphs: Graphs
    synchronic: Graphs
    features: Ints
    cardinalities: tuple[int, ...]
    encoding: ActionEncoding
    mutexes: tuple[Mutex, ...]
    invariants: Invariants = NO_INVARIANTS


def instantiate(local: LocalGraphs, board: PlaneLayout) -> tuple[Layout, Graphs, Graphs]:
    """Layout, graphs and synchronic graphs for a board."""
    n_factors = board.channels * board.height * board.width
    cells = board.to_planes(np.arange(n_factors)[None])[0]
    cardinalities = np.empty(n_factors, dtype=np.int64)
    for channel, values in enumerate(local.cardinalities):
        cardinalities[cells[channel]] = values
    tested = np.concatenate([local.graphs.feature, local.synchronic.feature])
    used = np.unique(tested[tested >= 0])
    adjacencies, later = (used[local.features[used, 0] == kind] for kind in (ADJACENCY, NEXT_ADJACENCY))
    layout = make_layout([int(c) for c in cardinalities], (), local.encoding, ordinal=False)
    now, then = (np.ascontiguousarray(local.features[numbers, 1:]) for numbers in (adjacencies, later))
    layout = layout._replace(cells=cells, adjacencies=now, next_adjacencies=then, weights=radix(local.cardinalities))
    layout = with_mutexes(with_invariants(layout, local.invariants), local.mutexes)
    numbers = {int(d): len(layout.factor) + layout.encoding.n_features + i for i, d in enumerate(adjacencies)}
    numbers |= {int(d): n_features(layout) + len(layout.factor) + i for i, d in enumerate(later)}
    graphs, synchronic = (_Board(local, layout, numbers).graphs(which) for which in (local.graphs, local.synchronic))
    variables = [layout.cells[c].ravel() if c < len(cells) else np.asarray([n_factors]) for c in local.synchronic.changing]
    order = np.concatenate([*variables, np.zeros(0, dtype=np.int64)])
    return layout, graphs, synchronic._replace(changing=order[layout.mutex_of[order] < 0])


def with_invariants(layout: Layout, invariants: Invariants) -> Layout:
    """The layout with the given invariants."""
    return layout._replace(counts=invariants.counts, observed=invariants.observed)


def with_mutexes(layout: Layout, mutexes: Sequence[Mutex]) -> Layout:
    """The layout with the given mutex groups; a cell belongs to the first group that contains it."""
    of, exactly = layout.mutex_of.copy(), []
    groups: list[Ints] = []
    _, height, width = layout.cells.shape
    for mutex in mutexes:
        if not mutex.lies_on(height, width):
            continue
        members = layout.cells[mutex.channel][mutex.cells()].ravel()
        members = members[of[members] < 0]
        if len(members) > 1:
            of[members] = len(groups)
            groups.append(members)
            exactly.append(mutex.exactly)
    return layout_with_mutexes(layout, groups, exactly)


class _Board:
    """Graphs of all cells while they are built. A cell's variable has the number of its factor."""

    def __init__(self, local: LocalGraphs, layout: Layout, adjacencies: dict[int, int]) -> None:
        self.local, self.layout, self.relative = local, layout, local.graphs
        self.links: list[tuple[int, int, int]] = []
        self.leaves: list[int] = []
        self.features: list[list[int]] = local.features.tolist()
        self.first_feature = np.searchsorted(layout.factor, np.arange(layout.n_factors))
        self.adjacencies = adjacencies

    def graphs(self, graphs: Graphs) -> Graphs:
        """The graphs of all cells, from graphs with relative features."""
        local, layout, self.relative = self.local, self.layout, graphs
        _, height, width = layout.cells.shape
        pairs = np.concatenate([[0], np.cumsum(layout.encoding.n_action_classes * layout.outputs)]).astype(np.int64)
        shared = {int(node): self._add(-1, 0, 0, int(node)) for node in np.flatnonzero(graphs.feature < 0)}
        channel_of = np.full(len(layout.outputs), len(local.cardinalities))
        entries: list[tuple[int, int, int]] = []
        for channel in graphs.changing:
            nodes = self._nodes_of(int(channel))
            places = (
                [(int(layout.cells[channel, y, x]), y, x) for y in range(height) for x in range(width)]
                if channel < len(local.cardinalities)
                else [(layout.n_factors, 0, 0)]
            )
            for variable, y, x in places:
                copies = self._copy(nodes, shared, y, x)
                entries += self._entries(int(channel), int(pairs[variable]), copies)
        for channel in range(len(local.cardinalities)):
            channel_of[layout.cells[channel]] = channel
        channel_of[-1] = len(local.cardinalities) + 1
        leaves = np.asarray(self.leaves, dtype=np.int64)
        changing = np.flatnonzero(np.isin(channel_of, graphs.changing))
        return Graphs(
            changing.astype(np.int64),
            pairs,
            *linked(entries, int(pairs[-1]), self.links),
            np.where(leaves >= 0, graphs.rate[leaves], 0.0),
            np.where(leaves >= 0, graphs.spread[leaves], 0.0),
            np.concatenate([graphs.persistence[graphs.pairs[c] : graphs.pairs[c + 1]] for c in channel_of]),
            np.concatenate([graphs.unseen_mass[graphs.pairs[c] : graphs.pairs[c + 1]] for c in channel_of]),
            np.concatenate([[0], np.cumsum(layout.outputs)]).astype(np.int64),
            np.concatenate([graphs.base[graphs.start[c] : graphs.start[c + 1]] for c in channel_of]),
            graphs.still,
            graphs.noise,
        )

    def _add(self, feature: int, off: int, on: int, leaf: int = -1) -> int:
        self.links.append((feature, off, on))
        self.leaves.append(leaf)
        return len(self.links) - 1

    def _nodes_of(self, channel: int) -> list[int]:
        """Inner nodes of a channel's graphs, children first."""
        graphs = self.relative
        begin, end = graphs.entries[graphs.pairs[channel]], graphs.entries[graphs.pairs[channel + 1]]
        found: set[int] = set()
        stack = [int(node) for node in graphs.nodes[begin:end]]
        while stack:
            node = stack.pop()
            if node not in found and graphs.feature[node] >= 0:
                found.add(node)
                stack += [int(graphs.off[node]), int(graphs.on[node])]
        return sorted(found)

    def _copy(self, nodes: Sequence[int], shared: dict[int, int], y: int, x: int) -> dict[int, int]:
        """Nodes for a position; tests whose result the border determines are resolved."""
        graphs, copies = self.relative, dict(shared)
        for node in nodes:
            off, on = copies[int(graphs.off[node])], copies[int(graphs.on[node])]
            feature = self._absolute(int(graphs.feature[node]), y, x)
            copies[node] = off if feature == _NEVER or off == on else on if feature == _ALWAYS else self._add(feature, off, on)
        return copies

    def _absolute(self, relative: int, y: int, x: int) -> int:
        """Number of a relative feature at a position among the features of the board, or ``_NEVER`` or ``_ALWAYS``."""
        _, height, width = self.layout.cells.shape
        kind, *parts = self.features[relative]
        if kind == ACTION:
            return len(self.layout.factor) + parts[0]
        if kind in (ADJACENCY, NEXT_ADJACENCY):
            return self.adjacencies[relative]
        row, col = (y + parts[0], x + parts[1]) if kind == BORDER else (y + parts[2], x + parts[3])
        inside = 0 <= row < height and 0 <= col < width
        if kind == BORDER:
            return _NEVER if inside else _ALWAYS
        if inside == (kind == WRAP):
            return _NEVER
        row, col = row % height, col % width
        value = parts[1] if self.local.cardinalities[parts[0]] != 2 else 0
        begin = n_features(self.layout) if kind == NEXT else 0
        return int(begin + self.first_feature[self.layout.cells[parts[0], row, col]]) + value

    def _entries(self, channel: int, begin: int, copies: dict[int, int]) -> list[tuple[int, int, int]]:
        """Entries (pair, value, node) of a variable whose pairs begin at ``begin``."""
        graphs = self.relative
        first, last = graphs.pairs[channel], graphs.pairs[channel + 1]
        return [
            (begin + int(pair - first), int(graphs.values[entry]), copies[int(graphs.nodes[entry])])
            for pair in range(first, last)
            for entry in range(graphs.entries[pair], graphs.entries[pair + 1])
        ]


_NEVER, _ALWAYS = -2, -3
"""Features that are always off or on at a position, because of the border."""
