"""Compiled sampling of next states from decision graphs, and their probabilities.

Variables with synchronic arcs (graphs in ``synchronic``) are drawn after all others. If such a variable is uncertain without its
arcs, it is drawn given the values drawn so far (the paper's conditioner, section 3.2); otherwise, the arcs are ignored.
``terminated`` always uses its arcs.
Shapes: B batch, F factors, U variables (the last two are ``terminated`` and the reset), Q mutex groups, D features (of which D'
test single factors), M' adjacencies of the next state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mbagent.models.dbn.arrays import (
    Graphs,
    distributions,
    leaf_of,
    n_features,
    ranges,
    show,
    show_next,
    show_next_adjacencies,
    write,
)
from mbagent.models.dbn.features import Layout, variable_values
from mbagent.models.dbn.mutex import mutex_bits, mutex_chances, mutex_distribution, settle, widest
from mbagent.models.systematic_sampling import NEGLIGIBLE
from mbagent.types import Bools, Floats, Ints, Keys
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.structs import Struct


class Work(Struct):
    """Graphs, and work space to evaluate them in one row at a time.

    Attributes:
        layout, graphs, synchronic: see ``fitting.Fitted``.
        on: which features are on, bool [D + D' + M']; features of the next state come last.
        values: current values of all variables, int64 [U].
        rates: next-value distributions of all variables, [sum of cardinalities].
        still: which variables have no graphs, bool [U].
        later: which variables have synchronic arcs, bool [U].
        alone: variables with graphs that are drawn independently: those without mutex group and synchronic arcs, int64.
        every: all variables but the last, the reset, int64 [U - 1].
        joint: room for the distribution of one mutex group or variable.
        following: a next state, int64 [F].
    """

    layout: Layout
    graphs: Graphs
    synchronic: Graphs
    on: Bools
    values: Ints
    rates: Floats
    still: Bools
    later: Bools
    alone: Ints
    every: Ints
    joint: Floats
    following: Ints


def work_space(layout: Layout, graphs: Graphs, synchronic: Graphs) -> Work:
    """Work space for a row."""
    n_variables = len(layout.outputs)
    still, later = np.ones(n_variables, dtype=np.bool_), np.zeros(n_variables, dtype=np.bool_)
    still[graphs.changing], later[synchronic.changing] = False, True
    n_state_features = len(layout.factor) + layout.encoding.n_features + len(layout.adjacencies)
    return Work(
        layout,
        graphs,
        synchronic,
        np.empty(n_state_features + len(layout.factor) + len(layout.next_adjacencies), dtype=np.bool_),
        np.zeros(n_variables, dtype=np.int64),
        np.empty(int(graphs.start[-1])),
        still,
        later,
        np.flatnonzero(~still & ~later & (layout.mutex_of < 0)),
        np.arange(n_variables - 1),
        np.empty(widest(layout)),
        np.empty(layout.n_factors, dtype=np.int64),
    )


@compiled
def evaluate(state: Ints, action: int, variables: Ints, w: Work) -> None:
    """Writes the features of a state [F] and an action to ``w.on``, and the distributions of some variables to ``w.rates``."""
    show(state, action, w.layout, w.on)
    distributions(variables, state, action, w.layout, w.graphs, w.on, w.values, w.rates)


@compiled
def reset_rates(states: Ints, actions: Ints, w: Work) -> Floats:
    """Probability of a reset, [B]."""
    rates, reset = np.empty(len(states), dtype=np.float64), np.array([len(w.layout.outputs) - 1])
    for b in range(len(states)):
        evaluate(states[b], actions[b], reset, w)
        rates[b] = w.rates[w.graphs.start[-1] - 1]
    return rates


@compiled
def _pick(probs: Floats, start: int, n: int, u: float, otherwise: int) -> int:
    """Index drawn by uniform ``u`` from ``n`` probabilities at ``start``; the most probable one if ``u`` is negative."""
    chosen = otherwise if u >= 0.0 else 0
    for k in range(n):
        if u < 0.0:
            if probs[start + k] > probs[start + chosen]:
                chosen = k
            continue
        if probs[start + k] > 0.0:
            chosen = k
            u -= probs[start + k]
            if u < 0.0:
                break
    return chosen


@compiled
def sample(states: Ints, actions: Ints, keys: Keys, greedy: bool, w: Work, following: Ints, terminated: Bools) -> None:
    """Draws next states ``following`` [B, F] and ``terminated`` [B]: variable u of row b by random number u of key b.

    ``following`` must initially be a copy of ``states``. If ``greedy``, each variable gets its most probable value instead of a
    random one.
    """
    layout, synchronic, n_variables = w.layout, w.synchronic, len(w.layout.outputs)
    for b in range(len(states)):
        evaluate(states[b], actions[b], w.graphs.changing, w)
        terminated[b] = False
        for variable in w.alone:
            _draw(variable, -1.0 if greedy else uniform_at(keys[b], variable), w, following[b], terminated, b)
        for q in range(len(layout.exactly)):
            n = mutex_distribution(q, states[b], w.rates, w.still, layout, w.graphs, w.joint)
            u = -1.0 if greedy else uniform_at(keys[b], n_variables + q)
            settle(following[b], q, _pick(w.joint, 0, n + 1, u, n), layout)
        if len(synchronic.changing):
            show_next(following[b], layout, w.on)
        for i in range(len(synchronic.changing)):
            variable = synchronic.changing[i]
            if needs_synchronic(variable, actions[b], w):
                if variable == n_variables - 2:
                    show_next_adjacencies(following[b], layout, w.on)
                distributions(synchronic.changing[i : i + 1], states[b], actions[b], layout, synchronic, w.on, w.values, w.rates)
            _draw(variable, -1.0 if greedy else uniform_at(keys[b], variable), w, following[b], terminated, b)
            _show_variable(variable, following[b], w)


@compiled
def needs_synchronic(variable: int, action: int, w: Work) -> bool:
    """Whether a variable's synchronic arcs are needed for the current state and action, of which ``w`` has the rates.

    Always true for ``terminated``; for other variables, if several next values have non-negligible probability or were observed
    in a leaf reached here.
    """
    n, graphs = w.layout.outputs[variable], w.graphs
    if variable == len(w.layout.outputs) - 2 or settled(w.rates, graphs.start[variable], n) < 0:
        return True
    pair = graphs.pairs[variable] + w.layout.encoding.action_class[action] * n + w.values[variable]
    for e in range(graphs.entries[pair], graphs.entries[pair + 1]):
        if graphs.leaf[leaf_of(graphs.entry[e, 1], graphs, w.on), 1] > 0.0:
            return True
    return False


@compiled
def _show_variable(variable: int, following: Ints, w: Work) -> None:
    """Writes the features of a variable's next value to ``w.on``."""
    layout = w.layout
    n = n_features(layout)
    for member in range(layout.first[variable], layout.first[variable + 1]):
        factor = layout.members[member]
        for feature in range(layout.first_feature[factor], layout.first_feature[factor + 1]):
            w.on[n + feature] = layout.value[feature] <= following[factor] <= layout.top[feature]


@compiled
def _draw(variable: int, u: float, w: Work, following: Ints, terminated: Bools, b: int) -> None:
    """Draws a variable's next value into ``following`` [F]; for ``terminated``, into ``terminated[b]``."""
    chosen = _pick(w.rates, w.graphs.start[variable], w.layout.outputs[variable], u, w.values[variable])
    if variable == len(w.layout.outputs) - 2:
        terminated[b] = chosen == 1
    elif chosen != w.values[variable]:
        write(following, variable, chosen, w.layout)


PROBABILITIES_AT_ONCE = 1 << 22
"""Maximum number of probabilities that are computed at once, 8 bytes each; bounds the memory."""


def in_parts(n_rows: int, n_columns: int) -> Iterator[slice]:
    """Slices of consecutive rows with at most ``PROBABILITIES_AT_ONCE`` entries each."""
    step = max(1, PROBABILITIES_AT_ONCE // max(n_columns, 1))
    return (slice(begin, begin + step) for begin in range(0, n_rows, step))


def log_prob(states: Ints, actions: Ints, following: Ints, terminated: Bools, w: Work) -> Floats:
    """Joint log-probability [B] of next states [B, F] and ``terminated`` [B]."""
    layout, start, result = w.layout, w.graphs.start, np.zeros(len(states))
    alone = np.flatnonzero(layout.mutex_of[:-1] < 0)
    groups = np.flatnonzero(np.diff(layout.first) > 1)
    for rows in in_parts(len(states), int(start[-1])):
        rates, then = conditionals(states[rows], actions[rows], following[rows], w), variable_values(layout, following[rows])
        values = np.concatenate([then, terminated[rows, None]], axis=1).astype(np.int64)
        with np.errstate(divide="ignore"):
            result[rows] = np.log(np.take_along_axis(rates, start[alone] + values[:, alone], axis=1)).sum(axis=1)
            for q in range(len(layout.exactly)):
                joint, bits = mutex_chances(q, states[rows], rates, w.still, layout, w.graphs), mutex_bits(q, layout)
                on = following[rows][:, bits] == 1
                which = np.where(on.any(axis=1), on.argmax(axis=1), len(bits))
                result[rows] += np.where(on.sum(axis=1) < 2, np.log(joint[np.arange(len(joint)), which]), -np.inf)
        now = variable_values(layout, states[rows]) if len(groups) else values
        for group in groups:  # in a group, exactly the bit of its value is on, or it did not change
            bits = layout.members[layout.first[group] : layout.first[group + 1]]
            one_hot = np.arange(len(bits)) == values[:, group, None]
            expected = np.where((values[:, group] == now[:, group])[:, None], states[rows][:, bits], one_hot)
            result[rows][(expected != following[rows][:, bits]).any(axis=1)] = -np.inf
    return result


@compiled
def conditionals(states: Ints, actions: Ints, following: Ints, w: Work) -> Floats:
    """Each variable's distribution, [B, sum of cardinalities], given its synchronic parents in ``following`` [B, F].

    The entries of the last variable, the reset, are left at 0.
    """
    last, synchronic = w.graphs.start[-2], w.synchronic
    result = np.zeros((len(states), w.graphs.start[-1]), dtype=np.float64)
    for b in range(len(states)):
        evaluate(states[b], actions[b], w.every, w)
        if len(synchronic.changing):
            show_next(following[b], w.layout, w.on)
            show_next_adjacencies(following[b], w.layout, w.on)
        for i in range(len(synchronic.changing)):
            if needs_synchronic(synchronic.changing[i], actions[b], w):
                some = synchronic.changing[i : i + 1]
                distributions(some, states[b], actions[b], w.layout, synchronic, w.on, w.values, w.rates)
        for k in range(last):
            result[b, k] = w.rates[k]
    return result


def marginals(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, start: Ints) -> Floats:
    """Distribution of each factor without synchronic arcs, [B, sum of cardinalities]; factor f's begins at ``start[f]``."""
    w, result = work_space(layout, graphs, replace(graphs, changing=graphs.changing[:0])), np.zeros((len(states), int(start[-1])))
    sizes = np.diff(layout.first)
    single, groups = np.flatnonzero(sizes == 1), np.flatnonzero(sizes > 1)
    given = ranges(graphs.start[single], layout.outputs[single])
    target = ranges(start[layout.members[layout.first[single]]], layout.outputs[single])
    for rows in in_parts(len(states), int(graphs.start[-1])):
        rates = conditionals(states[rows], actions[rows], states[rows], w)
        result[rows, target] = rates[:, given]
        for group in groups:
            bits = layout.members[layout.first[group] : layout.first[group + 1]]
            _write_bits(result[rows], start[bits], rates[:, graphs.start[group] : graphs.start[group + 1]])
        for q in range(len(layout.exactly)):
            joint = mutex_chances(q, states[rows], rates, w.still, layout, graphs)
            _write_bits(result[rows], start[mutex_bits(q, layout)], joint[:, :-1])
    return result


def _write_bits(out: Floats, start: Ints, ones: Floats) -> None:
    """Writes the distributions of bits, given their probabilities of 1 [B, n], to ``out`` from ``start`` [n] on."""
    out[:, start], out[:, start + 1] = 1.0 - ones, ones


@compiled
def settled(probs: Floats, start: int, n: int) -> int:
    """Index of the only one of ``n`` values with non-negligible probability; -1 if there are several."""
    best = 0
    for k in range(1, n):
        if probs[start + k] > probs[start + best]:
            best = k
    for k in range(n):
        if k != best and probs[start + k] >= NEGLIGIBLE * probs[start + best]:
            return -1
    return best


@compiled
def only_possible(probs: Floats, start: int, n: int) -> int:
    """Index of the only one of ``n`` values with a probability above 0; -1 if several or none."""
    best = -1
    for k in range(n):
        if probs[start + k] > 0.0:
            if best >= 0:
                return -1
            best = k
    return best


@compiled
def uncertain(states: Ints, actions: Ints, w: Work, variables: Ints) -> Bools:
    """Whether each row needs the synchronic graphs of each given variable, bool [B, len(variables)]."""
    result = np.zeros((len(states), len(variables)), dtype=np.bool_)
    for b in range(len(states)):
        evaluate(states[b], actions[b], variables, w)
        for i in range(len(variables)):
            result[b, i] = needs_synchronic(variables[i], actions[b], w)
    return result
