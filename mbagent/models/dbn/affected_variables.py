"""Decision graphs as few flat arrays, with an index of the variables that a state affects, so that search evaluates only these.

In the all-zero state, each variable has a *usual* distribution for each action; mostly it keeps its value. In another state, a
variable can only differ from this if a feature that is tested on its usual path differs, or if its own value does. If few cells
of a board are occupied, these variables are few, regardless of the size of the board.
Shapes: A actions, U variables, F factors, R values of all factors, W words of 64 variables, M adjacency features, Q mutex groups.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.dbn.arrays import Graphs, are_adjacent, distributions, n_features, show, with_rest, without_noise
from mbagent.models.dbn.features import ActionEncoding, Layout
from mbagent.models.dbn.sampling import only_possible
from mbagent.models.systematic_sampling import NEGLIGIBLE
from mbagent.types import Bools, Floats, Ints, Words
from mbagent_envs.jit import compiled, inlined

MOST_WORDS = 4_000_000
"""Maximum number of words of tables for each single action; beyond it, one table serves all actions."""

FIRST, MEMBERS, OUTPUTS, START, PAIR, MUTEX = range(6)
"""Columns of ``AffectedIndex.variables``."""


class AffectedIndex(NamedTuple):
    """Graphs as few arrays, and the variables that each value of each factor affects.

    Attributes:
        variables: where its factors begin, how many there are, number of values, where its distribution and its pairs begin, and
            its mutex group or -1, int64 [U, 6].
        members: factors of the variables, int64.
        entries: where the entries of each pair begin, int64 [pairs + 1]; see ``arrays.Graphs``.
        entry: value and first node, int64 [E, 2].
        node: feature, and the next node where it is off and on, int32 [nodes, 3].
        leaf: rate and spread, [nodes, 2].
        smoothing: persistence and unseen mass of each pair, [pairs, 2].
        base: distribution of unseen values, [sum of cardinalities].
        still: probability that a variable without graphs changes, [1].
        noise: see ``arrays.Graphs``.
        exactly: whether exactly one bit of a mutex group is on, bool [Q].
        row: where each factor's values begin among the rows, int64 [F + 1].
        shown: where each factor's features begin, int64 [F + 1].
        features: the lowest and highest value for which each state feature is on, int64 [D', 2].
        cells, adjacencies, counts, observed, weights: see ``features.Layout``.
        touched: variables that a factor's value affects, as bits, uint64 [A or 1, R, W].
        by_adjacency: variables that each adjacency feature affects, uint64 [A or 1, M, W].
        always: variables that may change even in the all-zero state, uint64 [A, W].
        usual_on: features that are on in the all-zero state without an action, bool [D].
        encoding, factor, next_adjacencies: see ``features.Layout``.
        end_first, end_node, end_rate: graph of the end if it is synchronic, else empty, see ``end_graph``.
    """

    variables: Ints
    members: Ints
    entries: Ints
    entry: Ints
    node: NDArray[np.int32]
    leaf: Floats
    smoothing: Floats
    base: Floats
    still: Floats
    noise: Floats
    exactly: Bools
    row: Ints
    shown: Ints
    features: Ints
    cells: Ints
    adjacencies: Ints
    counts: Ints
    observed: Bools
    weights: Ints
    touched: Words
    by_adjacency: Words
    always: Words
    usual_on: Bools
    encoding: ActionEncoding
    factor: Ints
    next_adjacencies: Ints
    end_first: Ints
    end_node: NDArray[np.int32]
    end_rate: Floats


def affected_index(layout: Layout, graphs: Graphs, synchronic: Graphs, cardinalities: tuple[int, ...]) -> AffectedIndex:
    """The arrays and the index of some graphs.

    Args:
        layout: the variables.
        graphs: of all variables, for planning.
        synchronic: of no variable, or only of ``terminated``.
        cardinalities: number of values of each factor, length F.
    """
    row = np.concatenate([[0], np.cumsum(cardinalities)]).astype(np.int64)
    shown = np.searchsorted(layout.factor, np.arange(layout.n_factors + 1)).astype(np.int64)
    always, touched, by_adjacency, on = _tables(layout, graphs, row)
    sizes = np.diff(layout.first)
    variables = np.stack(
        [layout.first[:-1], sizes, layout.outputs, graphs.start[:-1], graphs.pairs[:-1], layout.mutex_of], axis=1
    )
    end_first, end_node, end_rate = end_graph(layout, synchronic)
    return AffectedIndex(
        variables=np.ascontiguousarray(variables, dtype=np.int64),
        members=layout.members,
        entries=graphs.entries,
        entry=np.stack([graphs.values, graphs.nodes], axis=1),
        node=np.stack([graphs.feature, graphs.off, graphs.on], axis=1).astype(np.int32),
        leaf=np.stack([graphs.rate, graphs.spread], axis=1),
        smoothing=np.stack([graphs.persistence, graphs.unseen_mass], axis=1),
        base=graphs.base,
        still=graphs.still,
        noise=graphs.noise,
        exactly=layout.exactly,
        row=row,
        shown=shown,
        features=np.stack([layout.value, layout.top], axis=1),
        cells=layout.cells,
        adjacencies=layout.adjacencies,
        counts=layout.counts,
        observed=layout.observed,
        weights=layout.weights,
        touched=touched,
        by_adjacency=by_adjacency,
        always=always,
        usual_on=on,
        encoding=layout.encoding,
        factor=layout.factor,
        next_adjacencies=layout.next_adjacencies,
        end_first=end_first,
        end_node=end_node,
        end_rate=end_rate,
    )


def _tables(layout: Layout, graphs: Graphs, row: Ints) -> tuple[Words, Words, Words, Bools]:
    """``always``, ``touched``, ``by_adjacency`` and ``usual_on`` of ``AffectedIndex``."""
    n_words, n_rows, n_actions = -(-len(layout.outputs) // 64), int(row[-1]), len(layout.encoding.action_class)
    n_tables = n_actions if n_actions * n_rows * n_words <= MOST_WORDS else 1
    touched = np.zeros((n_tables, n_rows, n_words), dtype=np.uint64)
    by_adjacency = np.zeros((n_tables, len(layout.adjacencies), n_words), dtype=np.uint64)
    zeros, on = np.zeros(layout.n_factors, dtype=np.int64), np.zeros(n_features(layout), dtype=np.bool_)
    always = np.zeros((n_actions, n_words), dtype=np.uint64)
    _usual(layout, graphs, zeros, on, always)
    _dependents(layout, graphs, row, zeros, on, touched, by_adjacency)
    show(zeros, 0, layout, on)
    on[len(layout.factor) : len(layout.factor) + layout.encoding.n_features] = False
    return always, touched, by_adjacency, on


@compiled
def set_bit(words: Words, variable: int) -> None:
    """Adds a variable to a set [W]."""
    words[variable >> 6] |= np.uint64(1) << np.uint64(variable & 63)


@compiled
def _usual(layout: Layout, graphs: Graphs, zeros: Ints, on: Bools, always: Words) -> None:
    """Fills ``always``; see ``AffectedIndex``."""
    values, rates = np.zeros(len(layout.outputs), dtype=np.int64), np.zeros(graphs.start[-1], dtype=np.float64)
    every_variable = np.arange(len(layout.outputs))
    for action in range(len(layout.encoding.action_class)):
        show(zeros, action, layout, on)
        distributions(every_variable, zeros, action, layout, graphs, on, values, rates)
        for variable in graphs.changing:
            start = graphs.start[variable]
            if layout.mutex_of[variable] >= 0:
                active = rates[start + 1] > 0.0
            else:
                active = only_possible(rates, start, layout.outputs[variable]) != 0
            if active:
                set_bit(always[action], variable)


@compiled
def _dependents(layout: Layout, graphs: Graphs, row: Ints, zeros: Ints, on: Bools, touched: Words, by_adjacency: Words) -> None:
    """Fills the last two arguments; see ``AffectedIndex``.

    In the all-zero state every graph follows a default path. A variable's distribution can change only if a feature tested on
    that path changes; only these features affect the variable.
    """
    first_action, first_adjacency = len(layout.factor), len(layout.factor) + layout.encoding.n_features
    for variable in range(len(layout.outputs) - 2):
        if layout.mutex_of[variable] >= 0 or (graphs.changing == variable).any():
            for factor in layout.members[layout.first[variable] : layout.first[variable + 1]]:
                for r in range(row[factor] + 1, row[factor + 1]):
                    for table in range(len(touched)):
                        set_bit(touched[table, r], variable)
    for action in range(len(layout.encoding.action_class)):
        table = action if len(touched) > 1 else 0
        show(zeros, action, layout, on)
        for variable in graphs.changing:
            pair = graphs.pairs[variable] + layout.encoding.action_class[action] * layout.outputs[variable]
            for entry in range(graphs.entries[pair], graphs.entries[pair + 1]):
                node = graphs.nodes[entry]
                while graphs.feature[node] >= 0:
                    feature = graphs.feature[node]
                    if feature >= first_adjacency:
                        set_bit(by_adjacency[table, feature - first_adjacency], variable)
                    elif feature < first_action:
                        _touch(feature, variable, layout, row, touched[table])
                    node = graphs.on[node] if on[feature] else graphs.off[node]


@compiled
def _touch(feature: int, variable: int, layout: Layout, row: Ints, touched: Words) -> None:
    """Adds a variable to the sets of the values for which a feature differs from its state at value 0."""
    factor, usual = layout.factor[feature], layout.value[feature] <= 0 <= layout.top[feature]
    for r in range(row[factor] + 1, row[factor + 1]):
        value = r - row[factor]
        if (layout.value[feature] <= value <= layout.top[feature]) != usual:
            set_bit(touched[r], variable)


@inlined
def show_state(state: Ints, shown: Ints, features: Ints, different: Ints, on: Bools) -> int:
    """Writes the factors that are not 0 to ``different`` and their features to ``on``; returns how many factors there are."""
    n = 0
    for factor in range(len(state)):
        value = state[factor]
        if value != 0:
            different[n] = factor
            n += 1
            for feature in range(shown[factor], shown[factor + 1]):
                on[feature] = features[feature, 0] <= value <= features[feature, 1]
    return n


@inlined
def affected_variables_of(
    action: int,
    state: Ints,
    different: Ints,
    row: Ints,
    touched: Words,
    by_adjacency: Words,
    always: Words,
    first_adjacency: int,
    on: Bools,
    usual: Bools,
    words: Words,
    variables: Ints,
) -> int:
    """Writes the affected variables to ``variables``, ascending; returns how many there are."""
    table, n_words, n = action if len(touched) > 1 else 0, len(words), 0
    for j in range(n_words):
        words[j] = always[action, j]
    for factor in different:
        for j in range(n_words):
            words[j] |= touched[table, row[factor] + state[factor], j]
    for m in range(by_adjacency.shape[1]):
        if on[first_adjacency + m] != usual[first_adjacency + m]:
            for j in range(n_words):
                words[j] |= by_adjacency[table, m, j]
    for j in range(n_words):
        word, variable = words[j], j << 6
        while word:
            while not word & np.uint64(0xFF):
                word >>= np.uint64(8)
                variable += 8
            if word & np.uint64(1):
                variables[n] = variable
                n += 1
            word >>= np.uint64(1)
            variable += 1
    return n


@inlined
def value_of(variable: int, state: Ints, variables: Ints, members: Ints) -> int:
    """A variable's current value."""
    first, n = variables[variable, FIRST], variables[variable, MEMBERS]
    if n == 1:
        return int(state[members[first]])
    for member in range(n):
        if state[members[first + member]] == 1:
            return int(member)
    return 0


@inlined
def rates_of(
    touched: Ints,
    state: Ints,
    action_class: int,
    on: Bools,
    variables: Ints,
    members: Ints,
    entries: Ints,
    entry: Ints,
    nodes: NDArray[np.int32],
    leaf: Floats,
    smoothing: Floats,
    base: Floats,
    still: Floats,
    noise: float,
    values: Ints,
    out: Floats,
) -> None:
    """As ``arrays.distributions``, of the affected variables; writes their current values to ``values``, in the same order."""
    for i in range(len(touched)):
        variable = touched[i]
        n, start, value = variables[variable, OUTPUTS], variables[variable, START], value_of(variable, state, variables, members)
        values[i] = value
        pair = variables[variable, PAIR] + action_class * n + value
        begins, ends = entries[pair], entries[pair + 1]
        total, slack, tested = 0.0, 0.0, False
        for k in range(start, start + n):
            out[k] = 0.0
        for e in range(begins, ends):
            node = entry[e, 1]
            tested |= nodes[node, 0] >= 0
            while nodes[node, 0] >= 0:  # without a branch, which the processor could not predict
                node = nodes[node, 1 + np.int64(on[nodes[node, 0]])]
            rate = without_noise(leaf[node, 0], leaf[node, 1], n, noise)
            out[start + entry[e, 0]] = rate
            total += abs(rate)
            slack += 3.0 * leaf[node, 1]
        if n == 2:
            usual = still[0] if still[0] >= noise else 0.0
            rate = out[start + 1] if ends > begins else usual if value == 0 else 1.0 - usual
            out[start], out[start + 1] = 1.0 - rate, rate
            continue
        with_rest(out, base, start, n, value, total, slack, smoothing[pair, 0], smoothing[pair, 1], ends > begins, tested, noise)


def only_end_is_synchronic(layout: Layout, synchronic: Graphs) -> bool:
    """Whether no variable but ``terminated`` has synchronic arcs."""
    return bool((synchronic.changing == len(layout.outputs) - 2).all())


def end_graph(layout: Layout, synchronic: Graphs) -> tuple[Ints, NDArray[np.int32], Floats]:
    """The graph of ``terminated``: first node of each action class, nodes (feature, off, on) and their rates.

    The first node is -1 for a class under which no episode ended, int64 [classes]. All arrays are empty if ``terminated`` has no
    synchronic arcs.
    """
    if len(synchronic.changing) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.int32), np.zeros(0)
    first = np.full(layout.encoding.n_action_classes, -1, dtype=np.int64)
    for action_class in range(layout.encoding.n_action_classes):
        pair = synchronic.pairs[len(layout.outputs) - 2] + 2 * action_class
        if synchronic.entries[pair + 1] > synchronic.entries[pair]:
            first[action_class] = synchronic.nodes[synchronic.entries[pair]]
    rates = [without_noise(rate, spread, 2, NEGLIGIBLE) for rate, spread in zip(synchronic.rate, synchronic.spread, strict=True)]
    return (
        first,
        np.stack([synchronic.feature, synchronic.off, synchronic.on], axis=1).astype(np.int32),
        np.asarray(rates, dtype=np.float64),
    )


@inlined
def end_rate(
    node: int,
    nodes: NDArray[np.int32],
    rate: Floats,
    otherwise: float,
    following: Ints,
    on: Bools,
    factor: Ints,
    features: Ints,
    cells: Ints,
    next_adjacencies: Ints,
) -> float:
    """Probability that the episode ends with this next state [F]; ``on`` are the features of the current state, [D]."""
    if node < 0:
        return otherwise
    while nodes[node, 0] >= 0:
        feature = nodes[node, 0]
        if feature < len(on):
            is_on = on[feature]
        elif feature < len(on) + len(factor):
            c = feature - len(on)
            is_on = features[c, 0] <= following[factor[c]] <= features[c, 1]
        else:
            is_on = are_adjacent(following, cells, next_adjacencies[feature - len(on) - len(factor)])
        node = nodes[node, 2] if is_on else nodes[node, 1]
    return float(rate[node])
