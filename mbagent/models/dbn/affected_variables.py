"""Decision graphs in flat arrays, with an index of the variables that a state affects, so that search evaluates only these.

In the all-zero state, each variable has a *usual* distribution for each action; most variables keep their values. In another
state, a variable's distribution can differ from the usual one only if a feature tested on its usual path, or its own value,
differs. Only variables that can differ in this way, or that may change even in the all-zero state, are evaluated. If few cells
of a board are occupied, few variables are, whatever its size.
Shapes: A actions, U variables, F factors, R values of all factors, W words of 64 variables, M adjacency features, Q mutex groups.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from mbagent.models.dbn.arrays import FEATURE, NODE, OFF, Graphs, are_adjacent, n_features, ranges, without_noise
from mbagent.models.dbn.features import Layout
from mbagent.models.dbn.sampling import conditionals, work_space
from mbagent.types import Bools, Ints, Words
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.structs import Struct

MOST_WORDS = 4_000_000
"""Maximum number of words of tables for each single action; beyond it, one table serves all actions."""


class AffectedIndex(Struct):
    """Graphs, and the variables that each value of each factor affects.

    Attributes:
        layout: the variables.
        graphs: of all variables, for planning.
        synchronic: of no variable, or only of ``terminated``.
        row: where each factor's values begin among the rows, int64 [F + 1].
        touched: variables that each value affects, as bits, uint64 [A or 1, R, W].
        by_adjacency: variables that each adjacency feature affects, uint64 [A or 1, M, W].
        always: variables that may change even in the all-zero state, uint64 [A, W].
        usual_on: features that are on in the all-zero state without an action, bool [D].
    """

    layout: Layout
    graphs: Graphs
    synchronic: Graphs
    row: Ints
    touched: Words
    by_adjacency: Words
    always: Words
    usual_on: Bools

    @classmethod
    def of(cls, layout: Layout, graphs: Graphs, synchronic: Graphs, cardinalities: tuple[int, ...]) -> Self:
        """The index of some graphs.

        Args:
            layout: the variables.
            graphs: of all variables, for planning.
            synchronic: of no variable, or only of ``terminated``.
            cardinalities: number of values of each factor, length F.
        """
        row = np.concatenate([[0], np.cumsum(cardinalities)]).astype(np.int64)
        n_words, n_rows, n_actions = -(-len(layout.outputs) // 64), int(row[-1]), len(layout.encoding.action_class)
        n_tables = n_actions if n_actions * n_rows * n_words <= MOST_WORDS else 1
        index = cls(
            layout=layout,
            graphs=graphs,
            synchronic=synchronic,
            row=row,
            touched=np.zeros((n_tables, n_rows, n_words), dtype=np.uint64),
            by_adjacency=np.zeros((n_tables, len(layout.adjacencies), n_words), dtype=np.uint64),
            always=np.zeros((n_actions, n_words), dtype=np.uint64),
            usual_on=np.zeros(n_features(layout), dtype=np.bool_),
        )
        index._fill()
        return index

    def _fill(self) -> None:
        """Fills the tables and ``usual_on``.

        In the all-zero state every graph follows a default path. A variable's distribution can change only if a feature tested
        on that path changes, or if its own value does; only these affect the variable.
        """
        layout, graphs, on = self.layout, self.graphs, self.usual_on
        zeros, first = np.zeros((1, layout.n_factors), dtype=np.int64), graphs.start[:-1]
        work = work_space(layout, graphs, replace(self.synchronic, changing=np.zeros(0, dtype=np.int64)))
        for variable in np.union1d(graphs.changing, np.flatnonzero(layout.mutex_of >= 0)):
            for factor in layout.members[layout.first[variable] : layout.first[variable + 1]]:
                self.touched[:, self.row[factor] + 1 : self.row[factor + 1], variable >> 6] |= _bit(variable)
        on[: len(layout.factor)] = (layout.value <= 0) & (layout.top >= 0)
        for m, adjacency in enumerate(layout.adjacencies):
            on[m - len(layout.adjacencies)] = are_adjacent(zeros[0], layout.cells, adjacency)
        for action in range(len(self.always)):
            acting = len(layout.factor) + layout.encoding.feature[slice(*layout.encoding.first[action : action + 2])]
            on[acting] = True
            self._add_tested(action)
            on[acting] = False
            possible = conditionals(zeros, np.array([action]), zeros, work)[0] > 0.0
            active = (np.add.reduceat(possible, first, dtype=np.int64) - possible[first])[graphs.changing] > 0
            changing = graphs.changing[active]
            np.bitwise_or.at(self.always[action], changing >> 6, _bit(changing))

    def _add_tested(self, action: int) -> None:
        """Adds each variable to the sets of the features that its graphs test in the all-zero state under an action."""
        layout, graphs, on = self.layout, self.graphs, self.usual_on
        pairs = graphs.pairs[graphs.changing] + layout.encoding.action_class[action] * layout.outputs[graphs.changing]
        sizes = graphs.entries[pairs + 1] - graphs.entries[pairs]
        variables, nodes = np.repeat(graphs.changing, sizes), graphs.entry[ranges(graphs.entries[pairs], sizes), NODE]
        table, first_adjacency = action if len(self.touched) > 1 else 0, len(on) - len(layout.adjacencies)
        while len(nodes):
            inner = graphs.node[nodes, FEATURE] >= 0
            nodes, variables = nodes[inner], variables[inner]
            features = graphs.node[nodes, FEATURE]
            far, near = features >= first_adjacency, features < len(layout.factor)
            sets = features[far] - first_adjacency, variables[far] >> 6
            np.bitwise_or.at(self.by_adjacency[table], sets, _bit(variables[far]))
            factor, tested = layout.factor[features[near]], features[near]
            n_values = self.row[factor + 1] - self.row[factor] - 1
            values, tested = ranges(np.ones_like(n_values), n_values), np.repeat(tested, n_values)
            different = ((values >= layout.value[tested]) & (values <= layout.top[tested])) != on[tested]
            rows = (self.row[layout.factor[tested]] + values)[different]
            affected = np.repeat(variables[near], n_values)[different]
            np.bitwise_or.at(self.touched[table], (rows, affected >> 6), _bit(affected))
            nodes = graphs.node[nodes, OFF + on[features]]


def _bit(variables: Ints) -> Words:
    """Word with the bit of each variable."""
    result: Words = np.uint64(1) << (np.asarray(variables) & 63).astype(np.uint64)
    return result


@inlined
def show_state(state: Ints, layout: Layout, different: Ints, on: Bools) -> int:
    """Writes the nonzero factors to ``different`` and their features to ``on``; returns the number of these factors."""
    n = 0
    for factor in range(len(state)):
        value = state[factor]
        if value != 0:
            different[n] = factor
            n += 1
            for feature in range(layout.first_feature[factor], layout.first_feature[factor + 1]):
                on[feature] = layout.value[feature] <= value <= layout.top[feature]
    first_adjacency = len(layout.factor) + layout.encoding.n_features
    for m in range(len(layout.adjacencies)):
        on[first_adjacency + m] = are_adjacent(state, layout.cells, layout.adjacencies[m])
    return n


@compiled
def affected_variables_of(
    action: int, state: Ints, different: Ints, index: AffectedIndex, on: Bools, words: Words, variables: Ints
) -> int:
    """Writes the affected variables to ``variables``, ascending; returns how many there are.

    Args:
        action: the action.
        state: int64 [F].
        different: factors that are not 0, int64.
        index: the index.
        on: features of the state, bool [D].
        words: work space, uint64 [W].
        variables: int64 [U].
    """
    touched, by_adjacency, n_words, n = index.touched, index.by_adjacency, len(words), 0
    table, first_adjacency = action if len(touched) > 1 else 0, len(on) - by_adjacency.shape[1]
    for j in range(n_words):
        words[j] = index.always[action, j]
    for factor in different:
        row = index.row[factor] + state[factor]
        for j in range(n_words):
            words[j] |= touched[table, row, j]
    for m in range(by_adjacency.shape[1]):
        if on[first_adjacency + m] != index.usual_on[first_adjacency + m]:
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


def only_end_is_synchronic(layout: Layout, synchronic: Graphs) -> bool:
    """Whether no variable but ``terminated`` has synchronic arcs."""
    return bool((synchronic.changing == len(layout.outputs) - 2).all())


@compiled
def end_rate(action: int, following: Ints, on: Bools, layout: Layout, synchronic: Graphs) -> float:
    """Probability that the episode ends in this next state [F]; ``on`` holds the current state's features, [D].

    Features of the next state are evaluated only when the graph tests them.
    """
    pair = synchronic.pairs[len(layout.outputs) - 2] + 2 * layout.encoding.action_class[action]
    if synchronic.entries[pair + 1] == synchronic.entries[pair]:  # no episode ended with this action
        return 0.0
    node = np.int64(synchronic.entry[synchronic.entries[pair], 1])
    while synchronic.node[node, 0] >= 0:
        feature = np.int64(synchronic.node[node, 0])
        if feature < len(on):
            is_on = on[feature]
        elif feature < len(on) + len(layout.factor):
            f = feature - len(on)
            is_on = layout.value[f] <= following[layout.factor[f]] <= layout.top[f]
        else:
            is_on = are_adjacent(following, layout.cells, layout.next_adjacencies[feature - len(on) - len(layout.factor)])
        node = np.int64(synchronic.node[node, 1 + np.int64(is_on)])
    return without_noise(synchronic.leaf[node, 0], synchronic.leaf[node, 1], 2, synchronic.noise[0])
