"""Sampling from decision graphs, compiled: next states and probabilities.

Variables with synchronic arcs (graphs in ``synchronic``) are drawn after all others, given the values drawn so far (the paper's
conditioner, section 3.2), but only in rows where they are uncertain without these arcs; ``terminated`` always uses its arcs.
Shapes: B batch, F factors, U variables (the last two are ``terminated`` and the reset), Q mutex groups, D features, D' of them
of single factors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mbagent.models.dbn.arrays import Graphs, distributions, n_features, read, show, show_next, show_next_adjacencies, write
from mbagent.models.dbn.features import Layout
from mbagent.models.dbn.mutex import mutex_distribution, settle, which, widest
from mbagent.models.systematic_sampling import NEGLIGIBLE
from mbagent.types import Bools, Floats, Ints, Keys
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import uniform_at


class Work(NamedTuple):
    """Work space for one row at a time.

    Attributes:
        on: features, bool [D + D' + M'], those of the next state last.
        values: current values of all variables, int64 [U].
        rates: distributions of all variables, [sum of cardinalities].
        still: which variables have no graphs, bool [U].
        later: which variables have synchronic arcs, bool [U].
        shown: where each factor's features begin among the state's, int64 [F + 1].
        joint: the distribution of a mutex group or variable.
    """

    on: Bools
    values: Ints
    rates: Floats
    still: Bools
    later: Bools
    shown: Ints
    joint: Floats


@compiled
def work_space(layout: Layout, graphs: Graphs, synchronic: Graphs) -> Work:
    """Work space for a row."""
    still, later = np.ones(len(layout.outputs), dtype=np.bool_), np.zeros(len(layout.outputs), dtype=np.bool_)
    still[graphs.changing], later[synchronic.changing] = False, True
    return Work(
        np.empty(n_features(layout) + len(layout.factor) + len(layout.next_adjacencies), dtype=np.bool_),
        np.zeros(len(layout.outputs), dtype=np.int64),
        np.empty(graphs.start[-1], dtype=np.float64),
        still,
        later,
        np.searchsorted(layout.factor, np.arange(layout.n_factors + 1)),
        np.empty(widest(layout), dtype=np.float64),
    )


@compiled
def alone(layout: Layout, graphs: Graphs, later: Bools) -> Ints:
    """Variables with graphs that are drawn independently: those without mutex group and synchronic arcs."""
    chosen = np.zeros(len(layout.outputs), dtype=np.bool_)
    for variable in graphs.changing:
        chosen[variable] = layout.mutex_of[variable] < 0 and not later[variable]
    return np.flatnonzero(chosen)


@compiled
def reset_rates(states: Ints, actions: Ints, layout: Layout, graphs: Graphs) -> Floats:
    """Probability of a reset, [B]."""
    w, rates = work_space(layout, graphs, graphs), np.empty(len(states), dtype=np.float64)
    reset = np.array([len(layout.outputs) - 1])
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(reset, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        rates[b] = w.rates[graphs.start[-1] - 1]
    return rates


@compiled
def _pick(probs: Floats, start: int, n: int, u: float, otherwise: int) -> int:
    """Index drawn from ``n`` probabilities of ``probs``, or the most probable one if ``u`` is negative."""
    if u < 0.0:
        return int(np.argmax(probs[start : start + n]))
    chosen = otherwise
    for k in range(n):
        if probs[start + k] > 0.0:
            chosen = k
            u -= probs[start + k]
            if u < 0.0:
                break
    return chosen


@compiled
def sample(
    states: Ints,
    actions: Ints,
    keys: Keys,
    greedy: bool,
    layout: Layout,
    graphs: Graphs,
    synchronic: Graphs,
    following: Ints,
    terminated: Bools,
) -> None:
    """Draws next states into ``following`` [B, F] and ``terminated`` [B], variable u of row b with random number u of key b.

    ``following`` must be a copy of ``states``; with ``greedy``, each variable gets its most probable value instead.
    """
    w, n_variables = work_space(layout, graphs, synchronic), len(layout.outputs)
    early = alone(layout, graphs, w.later)
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(graphs.changing, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        terminated[b] = False
        for variable in early:
            u = -1.0 if greedy else uniform_at(keys[b], variable)
            _draw(variable, u, w, layout, graphs, following[b], terminated, b)
        for q in range(len(layout.exactly)):
            n = mutex_distribution(q, states[b], w.rates, w.still, layout, graphs, w.joint)
            u = -1.0 if greedy else uniform_at(keys[b], n_variables + q)
            settle(following[b], q, _pick(w.joint, 0, n + 1, u, n), layout)
        if len(synchronic.changing):
            show_next(following[b], layout, w.on)
        for i in range(len(synchronic.changing)):
            variable = synchronic.changing[i]
            if needs_synchronic(variable, actions[b], w, layout, graphs):
                if variable == n_variables - 2:
                    show_next_adjacencies(following[b], layout, w.on)
                distributions(synchronic.changing[i : i + 1], states[b], actions[b], layout, synchronic, w.on, w.values, w.rates)
            u = -1.0 if greedy else uniform_at(keys[b], variable)
            _draw(variable, u, w, layout, synchronic, following[b], terminated, b)
            _show_variable(variable, following[b], w, layout)


@compiled
def needs_synchronic(variable: int, action: int, w: Work, layout: Layout, graphs: Graphs) -> bool:
    """Whether a variable's synchronic arcs are needed for the current state and action.

    For ``terminated`` always; for another variable, if several next values were observed or have non-negligible probability.

    Args:
        variable: its number.
        action: the action.
        w: features, current values and rates, as written by ``distributions``.
        layout: the variables.
        graphs: without synchronic arcs.
    """
    n = layout.outputs[variable]
    if variable == len(layout.outputs) - 2 or settled(w.rates, graphs.start[variable], n) < 0:
        return True
    pair = graphs.pairs[variable] + layout.encoding.action_class[action] * n + w.values[variable]
    for entry in range(graphs.entries[pair], graphs.entries[pair + 1]):
        node = graphs.nodes[entry]
        while graphs.feature[node] >= 0:
            node = graphs.on[node] if w.on[graphs.feature[node]] else graphs.off[node]
        if graphs.spread[node] > 0.0:
            return True
    return False


@compiled
def _show_variable(variable: int, following: Ints, w: Work, layout: Layout) -> None:
    """Writes the features of a variable's next value to ``w.on``."""
    n = n_features(layout)
    for member in range(layout.first[variable], layout.first[variable + 1]):
        factor = layout.members[member]
        for feature in range(w.shown[factor], w.shown[factor + 1]):
            w.on[n + feature] = layout.value[feature] <= following[factor] <= layout.top[feature]


@compiled
def _draw(variable: int, u: float, w: Work, layout: Layout, graphs: Graphs, following: Ints, terminated: Bools, b: int) -> None:
    """Draws a variable's value into a next state [F], or into ``terminated[b]``."""
    chosen = _pick(w.rates, graphs.start[variable], layout.outputs[variable], u, w.values[variable])
    if variable == len(layout.outputs) - 2:
        terminated[b] = chosen == 1
    elif chosen != w.values[variable]:
        write(following, variable, chosen, layout)


@compiled
def log_prob(
    states: Ints, actions: Ints, following: Ints, terminated: Bools, layout: Layout, graphs: Graphs, synchronic: Graphs
) -> Floats:
    """Log-probability [B] of next states [B, F] and ends [B]."""
    w, n_variables, result = work_space(layout, graphs, synchronic), len(layout.outputs), np.zeros(len(states), dtype=np.float64)
    other, variables = np.empty(states.shape[1], dtype=np.int64), np.arange(n_variables - 1)
    for b in range(len(states)):
        _given(states[b], actions[b], following[b], variables, layout, graphs, synchronic, w)
        other[:] = states[b]
        for variable in variables:
            if layout.mutex_of[variable] >= 0:
                continue
            then = int(terminated[b]) if variable == n_variables - 2 else read(following[b], int(variable), layout)
            p = w.rates[graphs.start[variable] + then]
            result[b] += math.log(p) if p > 0.0 else -math.inf
            if variable < n_variables - 2 and then != w.values[variable]:
                write(other, int(variable), then, layout)
        for q in range(len(layout.exactly)):
            mutex_distribution(q, states[b], w.rates, w.still, layout, graphs, w.joint)
            then = which(following[b], q, layout)
            result[b] += math.log(w.joint[then]) if then >= 0 and w.joint[then] > 0.0 else -math.inf
            settle(other, q, then, layout)
        if not (other == following[b]).all():  # a group with no bit on, or with several
            result[b] = -math.inf
    return result


@compiled
def conditionals(states: Ints, actions: Ints, following: Ints, layout: Layout, graphs: Graphs, synchronic: Graphs) -> Floats:
    """Distribution of each variable, given the next values [B, F] of those that it depends on, [B, sum of cardinalities].

    That of the last variable, the reset, is left out.
    """
    w, variables = work_space(layout, graphs, synchronic), np.arange(len(layout.outputs) - 1)
    result = np.zeros((len(states), graphs.start[-1]), dtype=np.float64)
    for b in range(len(states)):
        _given(states[b], actions[b], following[b], variables, layout, graphs, synchronic, w)
        result[b, : graphs.start[-2]] = w.rates[: graphs.start[-2]]
    return result


@compiled
def _given(
    state: Ints, action: int, following: Ints, variables: Ints, layout: Layout, graphs: Graphs, synchronic: Graphs, w: Work
) -> None:
    """Writes the distributions of some variables, given the next state, to ``w.rates``."""
    show(state, action, layout, w.on)
    distributions(variables, state, action, layout, graphs, w.on, w.values, w.rates)
    if len(synchronic.changing):
        show_next(following, layout, w.on)
        show_next_adjacencies(following, layout, w.on)
    for i in range(len(synchronic.changing)):
        if needs_synchronic(synchronic.changing[i], action, w, layout, graphs):
            distributions(synchronic.changing[i : i + 1], state, action, layout, synchronic, w.on, w.values, w.rates)


@compiled
def marginals(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, start: Ints, out: Floats) -> None:
    """Writes each factor's distribution to ``out`` [B, sum of cardinalities]; factor f's begins at ``start[f]``."""
    w, variables = work_space(layout, graphs, graphs), np.arange(len(layout.outputs) - 2)
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(variables, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        for variable in variables:
            first, last = layout.first[variable], layout.first[variable + 1]
            for k in range(layout.outputs[variable]):
                p = w.rates[graphs.start[variable] + k]
                if last - first == 1:
                    out[b, start[layout.members[first]] + k] = p
                else:
                    _write_bit(out[b], start[layout.members[first + k]], p)
        for q in range(len(layout.exactly)):
            n = mutex_distribution(q, states[b], w.rates, w.still, layout, graphs, w.joint)
            for k in range(n):
                factor = layout.members[layout.first[layout.mutex_members[layout.mutex_first[q] + k]]]
                _write_bit(out[b], start[factor], w.joint[k])


@compiled
def _write_bit(out: Floats, start: int, p: float) -> None:
    out[start], out[start + 1] = 1.0 - p, p


@compiled
def settled(probs: Floats, start: int, n: int) -> int:
    """The only one of ``n`` values whose probability is not negligible, or -1."""
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
    """The only one of ``n`` values with a probability above 0, or -1."""
    best = -1
    for k in range(n):
        if probs[start + k] > 0.0:
            if best >= 0:
                return -1
            best = k
    return best


@compiled
def uncertain(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, variables: Ints) -> Bools:
    """In which rows the given variables need their synchronic graphs, bool [B, len(variables)]."""
    w, result = work_space(layout, graphs, graphs), np.zeros((len(states), len(variables)), dtype=np.bool_)
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(variables, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        for i in range(len(variables)):
            result[b, i] = needs_synchronic(variables[i], actions[b], w, layout, graphs)
    return result
