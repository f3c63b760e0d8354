"""Features of the cells of planes: neighbourhood, border, action, and which values are adjacent anywhere on the board.

Features are relative to the cell, so that parameters are tied over all positions (compare the similar modules in section 5 of
the paper). Grounding turns the graphs of each channel, which test relative features, into graphs of every cell of a board of any
size.
Shapes: N transitions, C channels, P positions, D relative features.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mbagent.data import Factors
from mbagent.models.dbn.arrays import FEATURE, NODE, OFF, ON, Graphs, linked, n_features
from mbagent.models.dbn.features import BEYOND, ActionEncoding, Layout, action_features, layout_with_mutexes, make_layout
from mbagent.models.dbn.planes.invariants import NO_INVARIANTS, Invariants, radix, with_invariants
from mbagent.spaces import PlaneLayout
from mbagent.types import Bools, Ints
from mbagent_envs.jit import compiled

_Cell = TypeVar("_Cell", bound=np.generic)

CELL, BORDER, ACTION, ADJACENCY, NEXT, WRAP, NEXT_ADJACENCY = 0, 1, 2, 3, 4, 5, 6
"""Kinds of relative features, and their parameters:

- CELL: channel, value, rows below, columns to the right;
- BORDER: rows below, columns to the right;
- ACTION: number of the feature among those of actions, and its stride, n, value, see ``features.action_features``;
- ADJACENCY: channel, value, channel (``BEYOND``: beyond the border), value, rows below, columns to the right; a value with itself
  at offset (0, 0): whether it occurs anywhere;
- NEXT, NEXT_ADJACENCY: a CELL and an ADJACENCY of the next state;
- WRAP: a CELL beyond the border, and so at the opposite side.
"""


class Reach(NamedTuple):
    """Extent of a neighbourhood.

    Attributes:
        radius: number of rows and columns in each direction.
        wrap: whether the neighbourhood continues at the opposite side of the board.
    """

    radius: int = 1
    wrap: bool = False


PIECE = 2000
"""Cells whose features are computed together."""

NEXT_RADIUS = 2
"""Radius of neighbourhoods in the next state: twice a move by one cell, the distance of two possible next positions."""


def relative_features(cardinalities: Sequence[int], parts: Sequence[int], reach: Reach) -> Ints:
    """All relative features, int64 [D, 7]; for the columns, see CELL.

    Args:
        cardinalities: number of values of each channel's cells, length C.
        parts: number of values of each action component.
        reach: see ``Reach``.
    """
    near = range(-reach.radius, reach.radius + 1)
    offsets = list(itertools.product(near, near))
    shown = [(c, v) for c, k in enumerate(cardinalities) for v in (range(k) if k != 2 else (1,))]
    features = [(CELL, c, v, dy, dx, 0, 0) for dy, dx in offsets for c, v in shown]
    features += [(BORDER, dy, dx, 0, 0, 0, 0) for dy, dx in offsets if (dy, dx) != (0, 0)]
    features += [(ACTION, number, *feature, 0, 0) for number, feature in enumerate(action_features(parts))]
    adjacencies = list(_adjacencies(shown))
    features += [(ADJACENCY, *adjacency) for adjacency in adjacencies]
    further = range(-NEXT_RADIUS, NEXT_RADIUS + 1)
    features += [(NEXT, c, v, dy, dx, 0, 0) for dy, dx in itertools.product(further, further) for c, v in shown]
    features += [(NEXT_ADJACENCY, *adjacency) for adjacency in adjacencies]
    if reach.wrap:
        features += [(WRAP, c, v, dy, dx, 0, 0) for dy, dx in offsets for c, v in shown if (dy, dx) != (0, 0)]
    return np.asarray(features, dtype=np.int64).reshape(-1, 7)


def _adjacencies(shown: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int, int, int, int, int]]:
    """Pairs of values in one cell or in neighbouring cells (including diagonals), and values at each of the four borders."""
    for i, first in enumerate(shown):
        for second in shown[i:]:
            for dy, dx in itertools.product((-1, 0, 1), (-1, 0, 1)):
                if first != second or (dy, dx) >= (0, 0):
                    yield (*first, *second, dy, dx)
        for dy, dx in ((-1, 0), (0, 1), (1, 0), (0, -1)):
            yield (*first, BEYOND, 0, dy, dx)


def informative_features(features: Ints, before: Factors, after: Factors) -> Ints:
    """Indices of the relative features that can be informative, given the observed planes.

    Left out are features of values that never occurred, and adjacencies of channels that only repeat another channel's previous
    state or are uniform over the board. For a uniform channel, only features of the cell at offset (0, 0) are kept.

    Args:
        features: int64 [D, 7].
        before: planes, int [N, C, H, W].
        after: those of the next states.
    """
    n_channels = before.shape[1]
    now, then = ([_values(planes[:, channel]) for channel in range(n_channels)] for planes in (before, after))
    uniform = {c for c in range(n_channels) if all((p[:, c] == p[:, c, :1, :1]).all() for p in (before, after))}
    live = {BEYOND} | {
        c
        for c in range(n_channels)
        if c not in uniform and not any(_repeats(after[:, c], before[:, other]) for other in range(n_channels) if other != c)
    }

    def known(kind: int, channel: int, value: int, other: int, second: int) -> bool:
        values = then if kind in (NEXT, NEXT_ADJACENCY) else now  # some values occur only in terminal states
        if kind in (CELL, NEXT, WRAP):
            return value in values[channel] and (channel not in uniform or (kind != WRAP and (other, second) == (0, 0)))
        if kind not in (ADJACENCY, NEXT_ADJACENCY):
            return True
        return channel in live and other in live and value in values[channel] and (other == BEYOND or second in values[other])

    return np.flatnonzero([known(*feature[:5]) for feature in features.tolist()])


def _values(plane: Factors) -> set[int]:
    """Values that occur in a plane [N, H, W]; testing each possible value is faster than sorting all cells."""
    return {value for value in range(int(plane.max(initial=0)) + 1) if (plane == value).any()}


def _repeats(after: Factors, before: Factors) -> bool:
    some = slice(0, 100)
    return bool((after[some] == before[some]).all() and (after == before).all())


def determined_by(channel: int, features: Ints, numbers: Ints, before: Factors, after: Factors, actions: Ints) -> Ints | None:
    """Indices of features that fully determine a channel's next values: another channel's current values, or an action.

    Args:
        channel: the channel.
        features: int64 [D, 7].
        numbers: indices of the candidate features, int64 [K].
        before: planes, int [N, C, H, W].
        after: those of the next states.
        actions: int64 [N].

    Returns:
        Indices, or None if no other channel and no action determines the channel.
    """
    here = numbers[(features[numbers, 0] == CELL) & (features[numbers, 3:5] == 0).all(axis=1)]
    for other in np.unique(features[here, 1]):
        if other != channel and _repeats(after[:, channel], before[:, other]):
            determined: Ints = here[features[here, 1] == other]
            return determined
    for number in numbers[features[numbers, 0] == ACTION]:
        taken = _action_is(features[number], actions)[:, None, None]
        if _repeats(after[:, channel], np.broadcast_to(taken, after[:, channel].shape).astype(after.dtype)):
            return np.asarray([number])
    return None


def feature_values(features: Ints, planes: Factors, actions: Ints, after: Factors | None = None) -> Bools:
    """Values of the relative features at each position of each transition, bool [N * P, D], transition by transition.

    Args:
        features: relative features, int64 [D, 7].
        planes: int [N, C, H, W].
        actions: int64 [N].
        after: the next states' planes, for features of the next state.
    """
    return np.ascontiguousarray(feature_planes(features, planes, actions, after).reshape(len(features), -1).T)


def feature_planes(features: Ints, planes: Factors, actions: Ints, after: Factors | None = None) -> Bools:
    """As ``feature_values``, but with the features as the first axis, bool [D, N, H, W]."""
    n, _, height, width = planes.shape
    table = np.empty((len(features), n, height, width), dtype=np.bool_)
    inside = np.ones((height, width), dtype=np.bool_)
    for d, (kind, *parts) in enumerate(features.tolist()):
        if kind == BORDER:
            table[d] = ~shifted(inside[None], parts[0], parts[1])
        elif kind == ACTION:
            table[d] = _action_is(features[d], actions)[:, None, None]
        elif kind in (ADJACENCY, NEXT_ADJACENCY):
            table[d] = far_value(features[d], planes, actions, after)[:, None, None]
        else:
            shown = _shown(kind, planes, after)[:, parts[0]] == parts[1]
            table[d] = wrapped(shown, *parts[2:4]) if kind == WRAP else shifted(shown, *parts[2:4])
    return table


def values_at(features: Ints, planes: Factors, actions: Ints, rows: Ints, y: Ints, x: Ints) -> Bools:
    """As ``feature_values``, but only for K given (transition, position) pairs, bool [K, D].

    Args:
        features: relative features of the current state, int64 [D, 7].
        planes: int [N, C, H, W].
        actions: int64 [N].
        rows: transition of each pair, int64 [K].
        y: row of each position, int64 [K].
        x: column of each position, int64 [K].
    """
    table = np.zeros((len(rows), len(features)), dtype=np.bool_)
    order = np.argsort(rows, kind="stable")
    for begin in range(0, len(rows), PIECE):
        some = order[begin : begin + PIECE]
        observed, where = np.unique(rows[some], return_inverse=True)
        wide, part = planes[observed].astype(np.int64), np.zeros((len(some), len(features)), dtype=np.bool_)
        _local_values(features, wide, where, y[some], x[some], part)
        for d in np.flatnonzero(np.isin(features[:, 0], (ACTION, ADJACENCY))):
            part[:, d] = far_value(features[d], wide, actions[observed], None)[where]
        table[some] = part
    return table


@compiled
def _local_values(features: Ints, planes: Ints, rows: Ints, y: Ints, x: Ints, out: Bools) -> None:
    """Writes the features of ``values_at`` that depend on the position to ``out``."""
    _, _, height, width = planes.shape
    for k in range(len(rows)):
        for d in range(len(features)):
            kind = features[d, 0]
            if kind == BORDER:
                row, col = y[k] + features[d, 1], x[k] + features[d, 2]
                out[k, d] = not (0 <= row < height and 0 <= col < width)
            elif kind in (CELL, WRAP):
                row, col = y[k] + features[d, 3], x[k] + features[d, 4]
                inside = 0 <= row < height and 0 <= col < width
                if inside and kind == CELL:
                    out[k, d] = planes[rows[k], features[d, 1], row, col] == features[d, 2]
                elif not inside and kind == WRAP:
                    out[k, d] = planes[rows[k], features[d, 1], row % height, col % width] == features[d, 2]


def _shown(kind: int, planes: Factors, after: Factors | None) -> Factors:
    if kind not in (NEXT, NEXT_ADJACENCY):
        return planes
    assert after is not None
    return after


def _action_is(feature: Ints, actions: Ints) -> Bools:
    """Values of an action feature, bool [N]."""
    on: Bools = actions // feature[2] % feature[3] == feature[4]
    return on


def far_value(feature: Ints, planes: Factors, actions: Ints, after: Factors | None) -> Bools:
    """As ``feature_values``, for one feature whose value is the same at all positions, bool [N]."""
    kind = int(feature[0])
    return _action_is(feature, actions) if kind == ACTION else are_adjacent(_shown(kind, planes, after), feature[1:])


def shifted(plane: NDArray[_Cell], below: int, right: int) -> NDArray[_Cell]:
    """Values [N, H, W] at a fixed offset (rows below, columns to the right) from each position; 0 beyond the border."""
    _, height, width = plane.shape
    result = np.zeros_like(plane)
    rows, cols = slice(max(0, -below), min(height, height - below)), slice(max(0, -right), min(width, width - right))
    source_rows = slice(max(0, below), min(height, height + below))
    source_cols = slice(max(0, right), min(width, width + right))
    result[:, rows, cols] = plane[:, source_rows, source_cols]
    return result


def wrapped(plane: NDArray[_Cell], below: int, right: int) -> NDArray[_Cell]:
    """Values [N, H, W] at a fixed offset from each position, with wrap-around; 0 where the offset stays within the border."""
    around = np.roll(plane, (-below, -right), axis=(1, 2))
    inside = shifted(np.ones((1, *plane.shape[1:]), dtype=np.bool_), below, right)
    return np.where(inside, np.zeros_like(around), around)


def are_adjacent(planes: Factors, adjacency: Ints) -> Bools:
    """Whether the adjacency holds anywhere: one channel has its value, and the other has its own at the offset, bool [N]."""
    first, value, second, other, below, right = (int(part) for part in adjacency)
    inside = np.ones((1, *planes.shape[2:]), dtype=np.bool_)
    there = ~shifted(inside, below, right) if second == BEYOND else shifted(planes[:, second] == other, below, right)
    found: Bools = ((planes[:, first] == value) & there).any(axis=(1, 2))
    return found


def feature_kinds(features: Ints) -> Ints:
    """Kind of each relative feature, int64 [D]: cells of each channel (now, next), border, action, adjacency (now, next)."""
    kind = features[:, 0]
    n_channels = int(features[kind == CELL, 1].max(initial=0)) + 1
    of_channel = np.isin(kind, (CELL, NEXT, WRAP))
    kinds = np.where(of_channel, features[:, 1] + n_channels * (kind == NEXT), 2 * n_channels + kind)
    return kinds.astype(np.int64)


def feature_name(feature: Ints) -> str:
    """A relative feature in words."""
    kind, *parts = (int(part) for part in feature)
    if kind == ACTION:
        return (
            f"action {parts[3]}" if parts[1] == 1 and parts[0] == parts[3] else f"action // {parts[1]} % {parts[2]} = {parts[3]}"
        )
    if kind == BORDER:
        return f"border at ({parts[0]:+d}, {parts[1]:+d})"
    if kind in (ADJACENCY, NEXT_ADJACENCY):
        other = "the border" if parts[2] == BEYOND else f"channel {parts[2]} = {parts[3]}"
        words = f"channel {parts[0]} = {parts[1]} anywhere"
        words += "" if parts[:2] == parts[2:4] and parts[4:] == [0, 0] else f" with {other} at ({parts[4]:+d}, {parts[5]:+d})"
    else:
        words = f"channel {parts[0]} = {parts[1]} at ({parts[2]:+d}, {parts[3]:+d})"
        words += " around the board" if kind == WRAP else ""
    return f"next {words}" if kind in (NEXT, NEXT_ADJACENCY) else words


WHOLE, ROW, COLUMN = 0, 1, 2
"""Cells of a channel that form a mutex group: all of them, or those of a row or column."""


class Mutex(NamedTuple):
    """A group of cells of one channel; at most one of them is on after a step.

    Attributes:
        channel: the channel, of bits.
        kind: WHOLE, ROW or COLUMN.
        line: index of the row or column from the top or left; if the bottom or right is nearer, a negative index from there (-1
            is the last line).
        exactly: whether exactly one cell is on.
    """

    channel: int
    kind: int
    line: int
    exactly: bool

    def lies_on(self, height: int, width: int) -> bool:
        """Whether a board of this size has the line."""
        length = {WHOLE: 1, ROW: height, COLUMN: width}[self.kind]
        return -length <= self.line < length

    def cells(self) -> tuple[slice | int, slice | int]:
        """Row and column indices of the cells."""
        rows = self.line if self.kind == ROW else slice(None)
        cols = self.line if self.kind == COLUMN else slice(None)
        return rows, cols


@dataclass(frozen=True)
class LocalGraphs:
    """Graphs, mutex groups and invariants that are the same at every position.

    Attributes:
        graphs: variables are the channels, then ``terminated`` and the reset; features are relative.
        synchronic: graphs of the channels whose cells have synchronic arcs; cells are drawn channel by channel, row by row from
            the upper left.
        features: the relative features, int64 [D, 7], see ``features.py``.
        cardinalities: number of values of each channel's cells, length C.
        encoding: the action encoding.
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
    cells = np.ascontiguousarray(board.to_planes(np.arange(n_factors)[None])[0])
    cardinalities = np.empty(n_factors, dtype=np.int64)
    for channel, values in enumerate(local.cardinalities):
        cardinalities[cells[channel]] = values
    tested = np.concatenate([local.graphs.node[:, FEATURE], local.synchronic.node[:, FEATURE]])
    used = np.unique(tested[tested >= 0])
    adjacencies, later = (used[local.features[used, 0] == kind] for kind in (ADJACENCY, NEXT_ADJACENCY))
    layout = make_layout([int(c) for c in cardinalities], (), local.encoding, ordinal=False)
    now, then = (np.ascontiguousarray(local.features[numbers, 1:]) for numbers in (adjacencies, later))
    layout = replace(layout, cells=cells, adjacencies=now, next_adjacencies=then, weights=radix(local.cardinalities))
    layout = with_mutexes(with_invariants(layout, local.invariants), local.mutexes)
    numbers = {int(d): len(layout.factor) + layout.encoding.n_features + i for i, d in enumerate(adjacencies)}
    numbers |= {int(d): n_features(layout) + len(layout.factor) + i for i, d in enumerate(later)}
    graphs, synchronic = (_Board(local, layout, numbers).graphs(which) for which in (local.graphs, local.synchronic))
    variables = [layout.cells[c].ravel() if c < len(cells) else np.asarray([n_factors]) for c in local.synchronic.changing]
    order = np.concatenate([*variables, np.zeros(0, dtype=np.int64)])
    return layout, graphs, replace(synchronic, changing=order[layout.mutex_of[order] < 0])


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
    """Graphs of all cells, under construction. The index of a cell's variable is that of its factor."""

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
        shared = {int(node): self._add(-1, 0, 0, int(node)) for node in np.flatnonzero(graphs.node[:, FEATURE] < 0)}
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
            np.where(leaves[:, None] >= 0, graphs.leaf[leaves], 0.0),
            np.concatenate([graphs.smoothing[graphs.pairs[c] : graphs.pairs[c + 1]] for c in channel_of]),
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
        stack = graphs.entry[begin:end, NODE].tolist()
        while stack:
            node = stack.pop()
            if node not in found and graphs.node[node, FEATURE] >= 0:
                found.add(node)
                stack += graphs.node[node, [OFF, ON]].tolist()
        return sorted(found)

    def _copy(self, nodes: Sequence[int], shared: dict[int, int], y: int, x: int) -> dict[int, int]:
        """The node at a position for each relative node; tests whose result the border determines are resolved."""
        graphs, copies = self.relative, dict(shared)
        for node in nodes:
            relative, off, on = graphs.node[node].tolist()
            off, on, feature = copies[off], copies[on], self._absolute(relative, y, x)
            copies[node] = off if feature == _NEVER or off == on else on if feature == _ALWAYS else self._add(feature, off, on)
        return copies

    def _absolute(self, relative: int, y: int, x: int) -> int:
        """Index, among the board's features, of a relative feature at a position; or ``_NEVER`` or ``_ALWAYS``."""
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
            (begin + int(pair - first), int(value), copies[int(node)])
            for pair in range(first, last)
            for value, node in graphs.entry[graphs.entries[pair] : graphs.entries[pair + 1]]
        ]


_NEVER, _ALWAYS = -2, -3
"""Features that are always off or on at a position, because of the border."""
