"""Decision graphs that classify transitions, for example by reward, from state, action and next state.

Each class but the most frequent has a graph that predicts whether a transition belongs to it. Graphs test the action, single
factors before or after the step and, on planes, adjacencies anywhere on the board before or after it. Features are evaluated
only when a graph tests them.
Shapes: B rows, F factors, C channels, D features, J graphs, K classes, W action classes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch
from mbagent.models.dbn.arrays import Nodes, are_adjacent
from mbagent.models.dbn.features import (
    Layout,
    Observed,
    action_encoding,
    action_feature_table,
    ask,
    distinct,
    feature_kinds,
    make_layout,
)
from mbagent.models.dbn.leaf_prior import best_prior
from mbagent.models.dbn.planes.features import (
    ADJACENCY,
    NEXT_ADJACENCY,
    Reach,
    far_value,
    informative_features,
    relative_features,
)
from mbagent.models.dbn.split_search import find_splits
from mbagent.spaces import PlaneLayout
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled, inlined

SHOWN, NEXT_SHOWN, ACTION_PART, MEETS, NEXT_MEETS = range(5)
"""Kinds of features: a factor's value in a range, now or next; a feature of actions; an adjacency, now or next, see
``features.Layout``."""

MOST_REWARD_ENTRIES = 50_000_000
"""Maximum number of rows times features of a search; of more rows, a sample: those of rare classes, up to one half, and others,
evenly spaced."""

MOST_SINGLE = 4000
"""Maximum number of features of single cells on planes; with more, only actions and adjacencies are used."""


SAVED_CLASSES = ("columns", "cells", "ways", "acts", "classes", "first", "node", "rate")
"""Names in files of the fields of ``ClassGraphs``, in their order."""


class ClassGraphs(NamedTuple):
    """The graphs, as arrays.

    Attributes:
        features: kind and up to six parameters of each feature, int64 [D, 7].
        cells: factor number of each cell, int64 [C, H, W]; empty without planes.
        action_classes: action class of each action, int64 [A].
        encoding: features of each action, bool [A, action features].
        classes: class that each graph predicts, int64 [J].
        first: first node for each graph and action class, int64 [J, W]; -1 if the action class did not occur in the searched
            rows.
        node: (feature, next node if it is off, next node if it is on), int64 [nodes, 3]; the feature is -1 at a leaf, and next
            nodes have smaller numbers.
        rate: probability of the class at a leaf, [nodes].
    """

    features: Ints
    cells: Ints
    action_classes: Ints
    encoding: Bools
    classes: Ints
    first: Ints
    node: Ints
    rate: Floats


def fit_classes(
    rows: TransitionBatch, classes: Ints, cardinalities: Sequence[int], parts: Sequence[int], planes: PlaneLayout | None
) -> ClassGraphs:
    """Fits decision graphs that predict the class of a transition.

    Args:
        rows: N transitions.
        classes: class of each transition, int64 [N]; 0 is the most frequent.
        cardinalities: number of values of each factor, length F.
        parts: number of values of each action component.
        planes: positions of the cells, if factors form planes.
    """
    encoding, layout = action_encoding(parts), make_layout(cardinalities, (), action_encoding(parts), ordinal=planes is None)
    candidates = _candidates(rows, layout, cardinalities, parts, planes)
    chosen = _chosen(classes, max(1, MOST_REWARD_ENTRIES // max(len(candidates), 1)))
    some, kinds = rows.select(chosen), _kinds(rows, layout, candidates)
    first, pattern = distinct(np.packbits(_values(some, layout, candidates, planes), axis=1), some.actions)
    table = _values(some.select(first), layout, candidates, planes)
    zeros, nodes = np.zeros(len(some), dtype=np.int64), Nodes()
    present = [int(k) for k in np.unique(classes) if k > 0]
    questions = [
        ask(0, 2, Observed(pattern, encoding.action_class[some.actions], zeros, (classes[chosen] == k).astype(np.int64)))[0]
        for k in present
    ]
    found = find_splits([question.target for question in questions], table, kinds, encoding.n_action_classes)
    begins = np.full((len(questions), encoding.n_action_classes), -1, dtype=np.int64)
    for j, (question, search) in enumerate(zip(questions, found, strict=True)):
        begins[j, question.pairs // 2] = nodes.graph(search, best_prior(found))
    links = np.asarray(nodes.links, dtype=np.int64).reshape(-1, 3)
    used, number = np.unique(links[:, 0][links[:, 0] >= 0], return_inverse=True)
    links[links[:, 0] >= 0, 0] = number
    switches, cells = action_feature_table(encoding, np.arange(len(encoding.action_class))), cells_in(planes, len(cardinalities))
    graphs = ClassGraphs(
        candidates[used], cells, encoding.action_class, switches, np.asarray(present), begins, links, _rates(nodes)
    )
    return graphs._replace(rate=_counted(graphs, rows, classes))


def cells_in(planes: PlaneLayout | None, n_factors: int) -> Ints:
    """Factor number of each cell, int64 [C, H, W]; empty without planes."""
    if planes is None:
        return np.zeros((0, 0, 0), dtype=np.int64)
    cells: Ints = np.ascontiguousarray(planes.to_planes(np.arange(n_factors)[None])[0], dtype=np.int64)
    return cells


def _rates(nodes: Nodes) -> Floats:
    rates: Floats = np.asarray(nodes.rates, dtype=np.float64).reshape(-1, 2)[:, 0]
    return np.ascontiguousarray(rates)


def _chosen(classes: Ints, most: int) -> Ints:
    """Numbers of the rows used in the search: at most ``most``, and the first row of each class."""
    if len(classes) <= most:
        return np.arange(len(classes))
    rare, common = np.flatnonzero(classes > 0), np.flatnonzero(classes == 0)
    n_rare = min(len(rare), most // 2)
    picked = [group[np.linspace(0, len(group) - 1, n).astype(np.int64)] for group, n in ((rare, n_rare), (common, most - n_rare))]
    chosen: Ints = np.unique(np.concatenate([*picked, np.unique(classes, return_index=True)[1]]))
    return chosen


def _candidates(
    rows: TransitionBatch, layout: Layout, cardinalities: Sequence[int], parts: Sequence[int], planes: PlaneLayout | None
) -> Ints:
    """Features that can be informative, int64 [D, 7]."""
    single = np.zeros((len(layout.factor), 7), dtype=np.int64)
    single[:, 1:4] = np.stack([layout.factor, layout.value, layout.top], axis=1)
    encoding = np.zeros((layout.encoding.n_features, 7), dtype=np.int64)
    encoding[:, 0], encoding[:, 1] = ACTION_PART, np.arange(layout.encoding.n_features)
    following = single.copy()
    following[:, 0] = NEXT_SHOWN
    determined = [_varying(single, rows.before), _varying(following, rows.after)]
    if planes is None:
        return np.concatenate([*determined, encoding])
    each = planes.to_planes(np.asarray(cardinalities)[None])[0]
    relative = relative_features(tuple(int(k) for k in each[:, 0, 0]), parts, Reach())
    relative = relative[informative_features(relative, planes.to_planes(rows.before), planes.to_planes(rows.after))]
    adjacencies = relative[np.isin(relative[:, 0], (ADJACENCY, NEXT_ADJACENCY))]
    adjacencies[:, 0] = np.where(adjacencies[:, 0] == ADJACENCY, MEETS, NEXT_MEETS)
    determined = determined if sum(map(len, determined)) <= MOST_SINGLE else []
    return np.concatenate([*determined, encoding, adjacencies])


def _varying(features: Ints, states: NDArray[Any]) -> Ints:
    """The features whose factor has more than one value in the given states."""
    varies = (states != states[:1]).any(axis=0)
    determined: Ints = features[varies[features[:, 1]]]
    return determined


def _kinds(rows: TransitionBatch, layout: Layout, candidates: Ints) -> Ints:
    """Kind of each feature, int64 [D]; a split by one makes others of its kind more probable, see ``find_splits``."""
    of_single = feature_kinds(layout, rows.before, (rows.before != rows.after).any(axis=0))
    number = {tuple(key): i for i, key in enumerate(np.stack([layout.factor, layout.value, layout.top], axis=1).tolist())}
    most, kinds = int(of_single.max(initial=0)) + 1, np.empty(len(candidates), dtype=np.int64)
    for d, (kind, *parts) in enumerate(candidates.tolist()):
        own = int(of_single[number[tuple(parts[:3])]]) if kind in (SHOWN, NEXT_SHOWN) else 0
        kinds[d] = own + most * (1 + kind) if kind != SHOWN else own
    return kinds


def _values(rows: TransitionBatch, layout: Layout, candidates: Ints, planes: PlaneLayout | None) -> Bools:
    """Values of the candidate features, bool [N, D]."""
    table, kind = np.empty((len(rows), len(candidates)), dtype=np.bool_), candidates[:, 0]
    for which, states in ((SHOWN, rows.before), (NEXT_SHOWN, rows.after)):
        here = np.flatnonzero(kind == which)
        values = states[:, candidates[here, 1]]
        table[:, here] = (values >= candidates[here, 2]) & (values <= candidates[here, 3])
    table[:, kind == ACTION_PART] = action_feature_table(layout.encoding, rows.actions)
    if planes is not None:
        before, after = planes.to_planes(rows.before), planes.to_planes(rows.after)
        for d in np.flatnonzero(np.isin(kind, (MEETS, NEXT_MEETS))):
            feature = candidates[d].copy()
            feature[0] = ADJACENCY if kind[d] == MEETS else NEXT_ADJACENCY
            table[:, d] = far_value(feature, before, rows.actions, after)
    return table


def _counted(graphs: ClassGraphs, rows: TransitionBatch, classes: Ints) -> Floats:
    """Rates at the leaves, estimated from all rows, not only those used in the search."""
    rates = graphs.rate.copy()
    for j, k in enumerate(graphs.classes):
        parts = [leaves_of(graphs, j, part.states, part.actions, part.next_states) for part in rows.parts(10_000)]
        leaves = np.concatenate(parts)
        observed = leaves >= 0
        n, e = (
            np.bincount(leaves[observed], weights=which[observed], minlength=len(rates)) for which in (classes >= 0, classes == k)
        )
        rates = np.where(n > 0, e / np.maximum(n, 1), rates)
    return rates


@inlined
def _leaf(
    node: int,
    state: Ints,
    action: int,
    following: Ints,
    features: Ints,
    cells: Ints,
    encoding: Bools,
    nodes: Ints,
) -> int:
    """Leaf a transition reaches from ``node``, -1 if ``node`` is -1; arguments are arrays: reading tuples is slower."""
    while node >= 0 and nodes[node, 0] >= 0:
        feature = nodes[node, 0]
        kind = features[feature, 0]
        if kind == ACTION_PART:
            on = encoding[action, features[feature, 1]]
        elif kind == SHOWN:
            on = features[feature, 2] <= state[features[feature, 1]] <= features[feature, 3]
        elif kind == NEXT_SHOWN:
            on = features[feature, 2] <= following[features[feature, 1]] <= features[feature, 3]
        elif kind == MEETS:
            on = are_adjacent(state, cells, features[feature, 1:])
        else:
            on = are_adjacent(following, cells, features[feature, 1:])
        node = nodes[node, 2] if on else nodes[node, 1]
    return int(node)


@compiled
def leaves_of(graphs: ClassGraphs, j: int, states: Ints, actions: Ints, following: Ints) -> Ints:
    """Leaf of graph ``j`` that each transition reaches, int64 [B]; -1 for none."""
    features, cells, encoding, nodes = graphs.features, graphs.cells, graphs.encoding, graphs.node
    first, action_classes, result = graphs.first, graphs.action_classes, np.empty(len(actions), dtype=np.int64)
    for b in range(len(actions)):
        result[b] = _leaf(
            first[j, action_classes[actions[b]]], states[b], actions[b], following[b], features, cells, encoding, nodes
        )
    return result


@compiled
def class_chances(graphs: ClassGraphs, n_classes: int, states: Ints, actions: Ints, following: Ints) -> Floats:
    """Probability of each class for each transition, [B, K]; class 0 gets the remaining probability."""
    features, cells, encoding, nodes = graphs.features, graphs.cells, graphs.encoding, graphs.node
    first, action_classes, classes, rate = graphs.first, graphs.action_classes, graphs.classes, graphs.rate
    result = np.zeros((len(actions), n_classes), dtype=np.float64)
    for b in range(len(actions)):
        total, action_class = 0.0, action_classes[actions[b]]
        for j in range(len(classes)):
            leaf = _leaf(first[j, action_class], states[b], actions[b], following[b], features, cells, encoding, nodes)
            if leaf >= 0:
                result[b, classes[j]] = rate[leaf]
                total += rate[leaf]
        if total > 1.0:
            for k in range(n_classes):
                result[b, k] /= total
        result[b, 0] = max(0.0, 1.0 - total)
    return result


def check_graphs(
    state: Mapping[str, NDArray[Any]], cardinalities: Sequence[int], n_actions: int, n_classes: int, cells: Ints
) -> ClassGraphs:
    """Validated graphs from the arrays of a file.

    Raises:
        ValueError: the arrays are not graphs of these factors, actions and classes.
    """
    wrong = "These weights are not those of a learned reward of this environment; the file is damaged or of another environment."
    if set(state) != set(SAVED_CLASSES):
        raise ValueError(wrong)
    kinds = {"acts": np.bool_, "rate": np.float64}
    g = ClassGraphs(*(np.ascontiguousarray(state[name], dtype=kinds.get(name, np.int64)) for name in SAVED_CLASSES))
    shapes = (g.features.ndim, g.encoding.ndim, g.first.ndim, g.node.ndim, g.action_classes.ndim, g.classes.ndim, g.rate.ndim)
    if shapes != (2, 2, 2, 2, 1, 1, 1) or g.features.shape[1] != 7 or g.node.shape[1] != 3 or len(g.rate) != len(g.node):
        raise ValueError(wrong)
    kind, parts = g.features[:, 0], g.features[:, 1:]
    single, adjacency = np.isin(kind, (SHOWN, NEXT_SHOWN)), np.isin(kind, (MEETS, NEXT_MEETS))
    inner, n = g.node[:, 0] >= 0, np.arange(len(g.node))
    sound = (
        g.cells.shape == cells.shape
        and (g.cells == cells).all()
        and len(g.action_classes) == len(g.encoding) == n_actions
        and _within(g.action_classes, 0, g.first.shape[1])
        and _within(g.classes, 1, n_classes)
        and len(g.first) == len(g.classes)
        and _within(g.first, -1, len(g.node))
        and _within(g.node[:, 0], -1, len(g.features))
        and all(_within(g.node[inner, i], 0, len(g.node)) and (g.node[inner, i] < n[inner]).all() for i in (1, 2))
        and _within(kind, SHOWN, NEXT_MEETS + 1)
        and _within(parts[single, 0], 0, len(cardinalities))
        and _within(parts[kind == ACTION_PART, 0], 0, g.encoding.shape[1])
        and _within(parts[adjacency, 0], 0, len(cells))
        and _within(parts[adjacency, 2], -1, len(cells))
        and bool((np.abs(parts[adjacency, 4:6]) <= 1).all())
        and bool(((g.rate >= 0.0) & (g.rate <= 1.0)).all())
    )
    if not sound:
        raise ValueError(wrong)
    return g


def _within(numbers: Ints, low: int, high: int) -> bool:
    return bool(((numbers >= low) & (numbers < high)).all())
