"""Decision graphs as flat arrays: nodes test a feature, and contexts with equal rates share a leaf.

After Chickering, Heckerman and Meek 1997, "A Bayesian approach to learning Bayesian networks with local structure". Arrays from
files are validated, since compiled kernels check nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.dbn.effects import Smoothing, chained
from mbagent.models.dbn.features import BEYOND, Layout, Question
from mbagent.models.dbn.leaf_prior import LeafPrior, fitted_prior
from mbagent.models.dbn.score import Search
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.structs import Struct

FEATURE, OFF, ON = range(3)
"""Columns of ``Graphs.node``."""

NODE = 1
"""Column of ``Graphs.entry``."""


class Graphs(Struct):
    """The graphs of all variables.

    Attributes:
        changing: variables that have graphs, int64.
        pairs: where each variable's pairs (action class, value) begin, int64 [U + 1]; the index of a pair within a variable is
            ``action_class * cardinality + value``, see ``features.ActionEncoding``.
        entries: where the entries of each pair begin, int64 [pairs + 1].
        entry: the value whose probability an entry predicts, and its first node, int64 [E, 2].
        node: the feature that a node tests, -1 at a leaf, and the next node where it is off and where it is on, int32 [nodes, 3].
        leaf: probability at a leaf, and its standard error, 0 if all its rows agree, [nodes, 2].
        smoothing: share of a pair's rows in which the variable kept its value, 1 without rows; and probability of values never
            observed after the pair, [pairs, 2].
        start: where each variable's values begin in ``base``, int64 [U + 1].
        base: distribution of each variable's unseen values, [sum of cardinalities].
        still: probability that a variable without graphs changes, [1].
        noise: 0, or for planning: values without any observation count as impossible if they are less probable than this share
            of the most probable value, [1].
    """

    changing: Ints
    pairs: Ints
    entries: Ints
    entry: Ints
    node: NDArray[np.int32]
    leaf: Floats
    smoothing: Floats
    start: Ints
    base: Floats
    still: Floats
    noise: Floats


class Nodes:
    """Nodes of all graphs while they are built."""

    def __init__(self) -> None:
        self.links: list[tuple[int, int, int]] = []
        self.rates: list[tuple[float, float]] = []

    def add(self, feature: int, off: int, on: int, rate: float = 0.0, spread: float = 0.0) -> int:
        """Adds a node; returns its index."""
        self.links.append((feature, off, on))
        self.rates.append((rate, spread))
        return len(self.links) - 1

    def graph(self, search: Search, prior: LeafPrior) -> Ints:
        """Adds a target's graph; returns the first node of each of its initial contexts."""
        n, e = search.counts()
        rates = prior.rates(n, e, search.prior_mean)
        spreads = np.sqrt(e * (n - e) / np.maximum(n, 1) ** 3)
        level = [self.add(-1, 0, 0, float(rate), float(spread)) for rate, spread in zip(rates, spreads, strict=True)]
        for split in reversed(search.splits):
            level = [
                level[off] if level[off] == level[on] else self.add(split.feature, level[off], level[on])
                for off, on in zip(split.off, split.on, strict=True)
            ]
        return np.asarray(level, dtype=np.int64)


def linked(
    entries: Ints | Sequence[tuple[int, int, int]], n_pairs: int, links: Sequence[tuple[int, int, int]]
) -> tuple[Ints, Ints, NDArray[np.int32]]:
    """``entries``, ``entry`` and ``node`` of ``Graphs``, from entries (pair, value, node) and nodes (feature, off, on)."""
    table = np.asarray(entries, dtype=np.int64).reshape(-1, 3)
    table = table[np.lexsort(table.T[::-1])]
    begins = np.searchsorted(table[:, 0], np.arange(n_pairs + 1)).astype(np.int64)
    return begins, np.ascontiguousarray(table[:, 1:]), np.asarray(links, dtype=np.int32).reshape(-1, 3)


def ranges(first: Ints, sizes: Ints) -> Ints:
    """Consecutive integers from each of ``first`` [N] on, ``sizes`` [N] of them, concatenated."""
    result: Ints = np.arange(sizes.sum()) + np.repeat(first - np.cumsum(sizes) + sizes, sizes)
    return result


def build(
    layout: Layout, asked: Sequence[Question], found: Sequence[Search], smoothings: Sequence[Smoothing], still: float
) -> Graphs:
    """The graphs of all variables.

    Args:
        layout: the variables.
        asked: the questions.
        found: the finished search for each question.
        smoothings: of each variable.
        still: probability that a variable without graphs changes.
    """
    nodes, prior = Nodes(), fitted_prior(found)
    pairs = np.concatenate([[0], np.cumsum(layout.encoding.n_action_classes * layout.outputs)]).astype(np.int64)
    entries = [np.zeros((0, 3), dtype=np.int64)]
    with_operand: dict[int, list[tuple[Question, Ints]]] = {}
    for question, search in zip(asked, found, strict=True):
        first = nodes.graph(search, prior)[question.context]
        if question.operand is not None:
            with_operand.setdefault(question.variable, []).append((question, first))
        else:
            entries.append(np.stack([pairs[question.variable] + question.pairs, question.values, first], axis=1))
    for variable, questions in with_operand.items():
        entries += _by_operand(nodes, questions, pairs[variable], int(layout.outputs[variable]), layout.encoding.n_action_classes)
    return Graphs(
        np.asarray(sorted({question.variable for question in asked}), dtype=np.int64),
        pairs,
        *linked(np.concatenate(entries), int(pairs[-1]), nodes.links),
        np.asarray(nodes.rates, dtype=np.float64).reshape(-1, 2),
        np.concatenate([np.stack([smoothing.persistence, smoothing.unseen_mass], axis=1) for smoothing in smoothings]),
        np.concatenate([[0], np.cumsum(layout.outputs)]).astype(np.int64),
        np.concatenate([smoothing.base for smoothing in smoothings]),
        np.asarray([still]),
        np.zeros(1),
    )


def _by_operand(
    nodes: Nodes, questions: Sequence[tuple[Question, Ints]], begin: int, cardinality: int, n_action_classes: int
) -> list[Ints]:
    """Entries (pair, value, node) [N, 3] of a variable with an operand, the same for all action classes."""
    rows = [np.stack([*np.divmod(q.pairs, cardinality), q.values, first], axis=1) for q, first in questions]
    features = questions[0][0].operand
    assert features is not None
    now, value, node = chained(np.concatenate(rows), features, nodes.add, nodes.add(-1, 0, 0)).T
    return [np.stack([begin + action_class * cardinality + now, value, node], axis=1) for action_class in range(n_action_classes)]


@inlined
def read(state: Ints, variable: int, layout: Layout) -> int:
    """Value of a variable in a state [F]; 0 for ``terminated`` and the reset."""
    first, last = layout.first[variable], layout.first[variable + 1]
    if last - first == 1:
        return int(state[layout.members[first]])
    for member in range(first, last):
        if state[layout.members[member]] == 1:
            return int(member - first)
    return 0


@compiled
def write(state: Ints, variable: int, value: int, layout: Layout) -> None:
    """Sets a variable's value in a state [F]."""
    first, last = layout.first[variable], layout.first[variable + 1]
    if last - first == 1:
        state[layout.members[first]] = value
    elif last > first:
        for member in range(first, last):  # all of them: a given state may have several bits on
            state[layout.members[member]] = 1 if member == first + value else 0


@compiled
def show(state: Ints, action: int, layout: Layout, on: Bools) -> None:
    """Writes the features of a state [F] and an action to ``on`` [D]."""
    n = len(layout.factor)
    for feature in range(n):
        value = state[layout.factor[feature]]
        on[feature] = layout.value[feature] <= value <= layout.top[feature]
    encoding = layout.encoding
    on[n : n + encoding.n_features] = False
    for i in range(encoding.first[action], encoding.first[action + 1]):
        on[n + encoding.feature[i]] = True
    n += encoding.n_features
    for m in range(len(layout.adjacencies)):
        on[n + m] = are_adjacent(state, layout.cells, layout.adjacencies[m])


@compiled
def are_adjacent(state: Ints, cells: Ints, adjacency: Ints) -> bool:
    """Whether an adjacency (see ``features.Layout``) occurs in a state [F]."""
    _, height, width = cells.shape
    below, right = adjacency[4], adjacency[5]
    for y in range(height):
        for x in range(width):
            if state[cells[adjacency[0], y, x]] == adjacency[1]:
                row, col = y + below, x + right
                inside = 0 <= row < height and 0 <= col < width
                if adjacency[2] == BEYOND:
                    if not inside:
                        return True
                elif inside and state[cells[adjacency[2], row, col]] == adjacency[3]:
                    return True
    return False


@compiled
def n_features(layout: Layout) -> int:
    """Number of features D."""
    return len(layout.factor) + layout.encoding.n_features + len(layout.adjacencies)


@compiled
def show_next(following: Ints, layout: Layout, on: Bools) -> None:
    """Writes the features of a next state [F] to ``on``, after those of the current state."""
    n = n_features(layout)
    for feature in range(len(layout.factor)):
        value = following[layout.factor[feature]]
        on[n + feature] = layout.value[feature] <= value <= layout.top[feature]


@compiled
def show_next_adjacencies(following: Ints, layout: Layout, on: Bools) -> None:
    """Writes the adjacency features of a next state [F] to ``on``, after all other features."""
    n = n_features(layout) + len(layout.factor)
    for m in range(len(layout.next_adjacencies)):
        on[n + m] = are_adjacent(following, layout.cells, layout.next_adjacencies[m])


@inlined
def without_noise(rate: float, spread: float, n: int, noise: float) -> float:
    """A leaf's rate for one of ``n`` values, for planning; negative if it is to be ignored when negligible.

    If all rows of a leaf agree (``spread`` 0), its outcome is taken as certain. For bits this is decided here; for variables of
    more values, in ``with_rest``, when the rates of all values are known.
    """
    if noise == 0.0 or spread > 0.0:
        return rate
    if 1.0 - rate < noise * rate:
        return 1.0
    if n > 2:
        return -rate
    return 0.0 if rate < noise * (1.0 - rate) else rate


@compiled
def with_rest(out: Floats, graphs: Graphs, variable: int, pair: int, value: int, total: float, slack: float, asked: bool) -> None:
    """Completes a variable's distribution in ``out`` with the current value and the unseen values.

    The graphs give the rates of all values but the current one, which gets the remaining probability. If the variable was never
    observed to keep its value, the remainder counts as an estimation error unless it exceeds ``slack``. For planning, it also
    counts as one if graphs test features (``asked``) and the remainder is at most ``slack`` and less than half of the pair's
    persistence: the rows in which the value was kept may belong to other leaves.
    """
    start, end, base, noise = graphs.start[variable], graphs.start[variable + 1], graphs.base, graphs.noise[0]
    persistence, unseen_mass, known = graphs.smoothing[pair, 0], graphs.smoothing[pair, 1], has_graphs(graphs, pair)
    stay = 1.0 - total
    observed = not known or (persistence > 0.0 and (stay > slack or not asked or stay >= 0.5 * persistence))
    if known:
        stay = max(0.0, stay - slack) if persistence == 0.0 else max(stay, min(slack, persistence))
    out[start + value] = stay if observed or noise == 0.0 else -stay
    scale, top, left = (1.0 - unseen_mass) / (total + stay), 0.0, 0.0
    for k in range(start, end):
        top = max(top, abs(out[k]) * scale + unseen_mass * base[k])
    for k in range(start, end):
        chance = abs(out[k]) * scale + unseen_mass * base[k]
        out[k] = chance if out[k] > 0.0 or chance >= noise * top else 0.0
        left += out[k]
    for k in range(start, end if noise > 0.0 else start):
        out[k] /= left


@inlined
def has_graphs(graphs: Graphs, pair: int) -> bool:
    """Whether a pair (action class, value) of a variable has graphs."""
    return bool(graphs.entries[pair + 1] > graphs.entries[pair])


@inlined
def leaf_of(node: int, graphs: Graphs, on: Bools) -> int:
    """The leaf that a row with the features ``on`` [D] reaches from a node."""
    while graphs.node[node, 0] >= 0:  # without a branch, which the processor could not predict
        node = graphs.node[node, 1 + np.int64(on[graphs.node[node, 0]])]
    return node


@compiled
def distributions(
    variables: Ints, state: Ints, action: int, layout: Layout, graphs: Graphs, on: Bools, values: Ints, out: Floats
) -> None:
    """Writes some variables' values to ``values`` [U], their next distributions to ``out`` from ``start[variable]`` on."""
    noise, action_class = graphs.noise[0], layout.encoding.action_class[action]
    usual = graphs.still[0] if graphs.still[0] >= noise else 0.0
    for variable in variables:
        n, start, value = layout.outputs[variable], graphs.start[variable], read(state, variable, layout)
        values[variable] = value
        pair = graphs.pairs[variable] + action_class * n + value
        begin, end = graphs.entries[pair], graphs.entries[pair + 1]
        if n <= 2:  # only the value 1 has a graph
            one = 0.0 if begin < end else usual if value == 0 else 1.0 - usual
            for e in range(begin, end):
                if graphs.entry[e, 0] == 1:
                    leaf = leaf_of(graphs.entry[e, 1], graphs, on)
                    one = without_noise(graphs.leaf[leaf, 0], graphs.leaf[leaf, 1], n, noise)
            out[start], out[start + 1] = 1.0 - one, one
            continue
        total, slack, tested = 0.0, 0.0, False
        for k in range(start, start + n):
            out[k] = 0.0
        for e in range(begin, end):
            tested |= graphs.node[graphs.entry[e, 1], 0] >= 0
            leaf = leaf_of(graphs.entry[e, 1], graphs, on)
            rate = without_noise(graphs.leaf[leaf, 0], graphs.leaf[leaf, 1], n, noise)
            out[start + graphs.entry[e, 0]] = rate
            total += abs(rate)
            slack += 3.0 * graphs.leaf[leaf, 1]
        with_rest(out, graphs, variable, pair, value, total, slack, tested)


SAVED: dict[str, tuple[str, int | None]] = {
    "changing": ("changing", None),
    "pairs": ("pairs", None),
    "entries": ("entries", None),
    "values": ("entry", 0),
    "nodes": ("entry", 1),
    "column": ("node", 0),
    "off": ("node", 1),
    "on": ("node", 2),
    "rate": ("leaf", 0),
    "spread": ("leaf", 1),
    "stays": ("smoothing", 0),
    "novelty": ("smoothing", 1),
    "start": ("start", None),
    "base": ("base", None),
    "still": ("still", None),
}
"""Arrays in files by name: field and column of ``Graphs``. ``noise`` belongs to planning and is not saved."""

_FLOATS = ("rate", "spread", "stays", "novelty", "base", "still")


def to_arrays(graphs: Graphs) -> dict[str, NDArray[Any]]:
    """The graphs' arrays by name, int64 or float64 [n]."""
    arrays = {}
    for name, (field, column) in SAVED.items():
        array = getattr(graphs, field)
        arrays[name] = np.array(array if column is None else array[:, column], dtype=np.float64 if name in _FLOATS else np.int64)
    return arrays


def table_of(array: NDArray[Any], width: int) -> NDArray[np.int64]:
    """The array as integers, int64 [n, width].

    Raises:
        ValueError: the array has another width.
    """
    if np.ndim(array) != 2 or np.shape(array)[1] != width:
        raise ValueError(f"These weights do not fit: a table of {width} columns has the shape {np.shape(array)}.")
    return np.ascontiguousarray(array, dtype=np.int64)


def from_arrays(arrays: Mapping[str, NDArray[Any]], layout: Layout, n_features: int) -> Graphs:
    """The graphs, from the result of ``to_arrays``.

    Args:
        arrays: by name.
        layout: the variables.
        n_features: number of features that nodes can test.

    Raises:
        ValueError: the arrays are not graphs of these variables.
    """
    missing = sorted(set(SAVED) ^ set(arrays))
    if missing:
        raise ValueError(f"These weights are not decision graphs (first difference: {missing[0]!r}).")
    flat: dict[str, NDArray[Any]] = {
        name: np.ascontiguousarray(arrays[name], dtype=np.float64 if name in _FLOATS else np.int64).reshape(-1) for name in SAVED
    }
    if not _sound(flat, layout, n_features):
        raise ValueError(
            "These weights do not fit: they are not graphs of these variables; load them into a model of the same environment."
        )

    def stacked(*names: str) -> NDArray[Any]:
        return np.stack([flat[name] for name in names], axis=1)

    return Graphs(
        changing=flat["changing"],
        pairs=flat["pairs"],
        entries=flat["entries"],
        entry=stacked("values", "nodes"),
        node=stacked("column", "off", "on").astype(np.int32),
        leaf=stacked("rate", "spread"),
        smoothing=stacked("stays", "novelty"),
        start=flat["start"],
        base=flat["base"],
        still=flat["still"],
        noise=np.zeros(1),
    )


def _sound(flat: Mapping[str, NDArray[Any]], layout: Layout, n_features: int) -> bool:
    """Whether all indices and values of the arrays from a file are valid and no path is a cycle."""
    n_variables, n_nodes, n_entries = len(layout.outputs), len(flat["column"]), len(flat["values"])
    pairs = np.concatenate([[0], np.cumsum(layout.encoding.n_action_classes * layout.outputs)])
    start = np.concatenate([[0], np.cumsum(layout.outputs)])
    if not (np.array_equal(flat["pairs"], pairs) and np.array_equal(flat["start"], start)):
        return False
    lengths = {
        "off": n_nodes,
        "on": n_nodes,
        "rate": n_nodes,
        "spread": n_nodes,
        "nodes": n_entries,
        "entries": pairs[-1] + 1,
        "stays": pairs[-1],
        "novelty": pairs[-1],
        "base": start[-1],
        "still": 1,
    }
    if any(len(flat[name]) != length for name, length in lengths.items()):
        return False
    entries, inner, numbers = flat["entries"], flat["column"] >= 0, np.arange(n_nodes)
    return bool(
        _within(flat["changing"], n_variables)
        and _within(flat["column"] + 1, n_features + 1)
        and _within(flat["nodes"], n_nodes)
        and (np.diff(entries) >= 0).all()
        and (entries[0], entries[-1]) == (0, n_entries)
        and all(((flat[name] >= 0) & (flat[name] < numbers))[inner].all() for name in ("off", "on"))
        and _values_fit(flat, layout)
        and all(np.isfinite(flat[name]).all() and _within(flat[name], 1.0) for name in _FLOATS)
        and (np.add.reduceat(flat["base"], start[:-1]) <= 1.0 + 1e-6).all()
    )


def _values_fit(flat: Mapping[str, NDArray[Any]], layout: Layout) -> bool:
    """Whether each entry's value is less than its variable's cardinality."""
    pair = np.repeat(np.arange(len(flat["entries"]) - 1), np.diff(flat["entries"]))
    variable = np.searchsorted(flat["pairs"], pair, side="right") - 1
    return bool(((flat["values"] >= 0) & (flat["values"] < layout.outputs[variable])).all())


def _within(values: NDArray[Any], n: float) -> bool:
    """Whether all integers are in [0, n), or all floats in [0, n]."""
    below = values < n if values.dtype == np.int64 else values <= n
    return bool(((values >= 0) & below).all())
