"""Decision graphs in compiled search: only the variables that a state affects are evaluated (see ``affected_variables.py``).

The outcomes are those of ``successors.successors``, at a cost that grows with the number of affected variables and not with that
of all variables. The only variable with synchronic arcs is the end of the episode; features of the next state are evaluated only
when its graph tests them.
Shapes: A actions, U variables, F factors, Q mutex groups, W words of 64 variables, D features.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbagent.models.dbn.affected_variables import (
    FIRST,
    MEMBERS,
    MUTEX,
    OUTPUTS,
    START,
    AffectedIndex,
    affected_variables_of,
    end_rate,
    rates_of,
    show_state,
)
from mbagent.models.dbn.arrays import are_adjacent
from mbagent.models.dbn.features import ActionEncoding
from mbagent.models.dbn.mutex import leave_out_none
from mbagent.models.dbn.planes.invariants import leave_out
from mbagent.models.dbn.sampling import only_possible
from mbagent.models.overloads import Outcomes, implements, outcomes, work_for
from mbagent.models.systematic_sampling import (
    MAIN,
    MASS,
    STRATA,
    Grid,
    Particles,
    begin,
    n_outcomes,
    n_possible,
    new_particles,
    place_of,
    share_out,
    slot_of,
    weigh,
)
from mbagent.types import Bools, Floats, Ints, Words
from mbagent_envs.jit import compiled, inlined

_SURE = 1 << 40
"""Counted for a bit that is certain to be on."""


class GraphWork(NamedTuple):
    """Work space; between two calls, ``on`` holds the features of the all-zero state.

    Attributes:
        on: features, bool [D].
        rates: distributions of the affected variables, [sum of cardinalities].
        joint: distribution of a variable or mutex group.
        different: factors that are not 0, int64 [F].
        words: affected variables as bits, uint64 [W].
        variables: affected variables, int64 [U].
        values: their current values, int64 [U].
        mutex_members: the affected variables that are in mutex groups, group by group, int64 [U].
        per_mutex: number of affected variables in each mutex group, int64 [Q].
        opened: one row for each uncertain outcome, int64 [U + Q, 2]: (variable, -1), or for a mutex group (index of its first
            variable in ``mutex_members``, number of its variables).
        p: particles.
        base: the next state except for uncertain outcomes, int64 [F].
        following: the next state that a particle represents, int64 [F].
    """

    on: Bools
    rates: Floats
    joint: Floats
    different: Ints
    words: Words
    variables: Ints
    values: Ints
    mutex_members: Ints
    per_mutex: Ints
    opened: Ints
    p: Particles
    base: Ints
    following: Ints


@implements(work_for, AffectedIndex)
@compiled
def graph_work(g: AffectedIndex, n_grid: int) -> GraphWork:
    """See ``overloads.work_for``."""
    n_variables, n_factors, n_mutexes = len(g.variables), len(g.row) - 1, len(g.exactly)
    width = n_variables + n_mutexes
    return GraphWork(
        g.usual_on.copy(),
        np.empty(len(g.base), dtype=np.float64),
        np.empty(max(g.variables[:, OUTPUTS].max(), n_variables) + 1, dtype=np.float64),
        np.empty(n_factors, dtype=np.int64),
        np.empty(g.always.shape[1], dtype=np.uint64),
        np.empty(n_variables, dtype=np.int64),
        np.empty(n_variables, dtype=np.int64),
        np.empty(n_variables, dtype=np.int64),
        np.zeros(n_mutexes, dtype=np.int64),
        np.empty((width, 2), dtype=np.int64),
        new_particles(n_grid, width, max(g.variables[:, OUTPUTS].max(), n_variables) + 1),
        np.empty(n_factors, dtype=np.int64),
        np.empty(n_factors, dtype=np.int64),
    )


@implements(outcomes, AffectedIndex)
@compiled
def graph_outcomes(
    g: AffectedIndex, work: GraphWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See ``overloads.outcomes``."""
    grid, total = (n_grid, key, offset), 0
    cells, adjacencies, usual = g.cells, g.adjacencies, g.usual_on
    shown, features, on = g.shown, g.features, work.on
    variables, members, entries = g.variables, g.members, g.entries
    entry, node, leaf = g.entry, g.node, g.leaf
    stay, unseen, still, noise = g.smoothing, g.base, g.still, g.noise[0]
    exactly, row, touched = g.exactly, g.row, g.touched
    by_adjacency, always, rates = g.by_adjacency, g.always, work.rates
    joint, different, words = work.joint, work.different, work.words
    listed, now, mutex_members = work.variables, work.values, work.mutex_members
    per_mutex, opened, base = work.per_mutex, work.opened, work.base
    p, encoding = work.p, g.encoding
    counts, observed, weights, ends = g.counts, g.observed, g.weights, len(g.end_first) > 0
    n_actions, first_adjacency = len(always), len(features) + encoding.n_features
    place = place_of(state)
    n_different = show_state(state, shown, features, different, on)
    for m in range(len(adjacencies)):
        on[first_adjacency + m] = are_adjacent(state, cells, adjacencies[m])
    for action in range(n_actions):
        n = affected_variables_of(
            action, state, different[:n_different], row, touched, by_adjacency, always, first_adjacency, on, usual, words, listed
        )
        _show_action(encoding, action, len(features), True, on)
        kind = encoding.action_class[action]
        rates_of(
            listed[:n], state, kind, on, variables, members, entries, entry, node, leaf, stay, unseen, still, noise, now, rates
        )
        for f in range(len(state)):
            base[f] = state[f]
        begin(p, n_grid, _fits(listed[:n], variables, rates, per_mutex, ends, n_grid), place)
        n_open, ended = _settle(
            listed[:n], variables, members, exactly, now, rates, joint, mutex_members, per_mutex, opened, p, base, ends, grid
        )
        if ends:
            _end(g, work, kind, n_open, grid)
            n_open += 1
        _show_action(encoding, action, len(features), False, on)
        n_live = _write(total, n_open, ended, base, opened, mutex_members, variables, members, p, n_grid, out)
        if len(counts) or len(observed):
            n_live = leave_out(
                counts, observed, weights, cells, state, out.states, out.terminated, out.probabilities, total, n_live
            )
        out.counts[action], out.left_out[action] = n_live, p.left[0]
        total += n_live
    for i in range(n_different):
        for feature in range(shown[different[i]], shown[different[i] + 1]):
            on[feature] = usual[feature]
    return total


@compiled
def _end(g: AffectedIndex, work: GraphWork, action_class: int, n_open: int, grid: Grid) -> None:
    """Draws for each particle whether the episode ends, given its next state so far."""
    p, joint, following, opened, end = work.p, work.joint, work.following, work.opened, len(g.variables) - 2
    n_main, n_strata = p.state[MAIN], p.state[STRATA]
    for j in range(n_main + n_strata):
        slot = grid[0] + j if j < n_strata else j - n_strata  # strata first
        _fill(following, work.base, opened, n_open, work.mutex_members, g.variables, g.members, p.factors[slot])
        joint[1] = end_rate(
            g.end_first[action_class],
            g.end_node,
            g.end_rate,
            0.0,
            following,
            work.on,
            g.factor,
            g.features,
            g.cells,
            g.next_adjacencies,
        )
        joint[0] = 1.0 - joint[1]
        share_out(p, slot, end, n_open, joint, 2, True, grid)
    opened[n_open, 0], opened[n_open, 1] = end, -1


@inlined
def _show_action(encoding: ActionEncoding, action: int, first: int, shown: bool, on: Bools) -> None:
    """Switches an action's features, which begin at ``first``, on or off."""
    for i in range(encoding.first[action], encoding.first[action + 1]):
        on[first + encoding.feature[i]] = shown


@compiled
def _fits(touched: Ints, variables: Ints, rates: Floats, per_mutex: Ints, end_is_synchronic: bool, n_grid: int) -> bool:
    """Whether all outcomes of a row can be listed; ``per_mutex`` is all 0 before and after the call."""
    possible = 1
    for variable in touched:
        mutex = variables[variable, MUTEX]
        if mutex >= 0:
            rate = rates[variables[variable, START] + 1]  # as ``mutex.n_choices``
            per_mutex[mutex] += int(rate > 0.0) + (_SURE if rate >= 1.0 else 0)
        elif not (end_is_synchronic and variable == len(variables) - 2):
            possible = min(possible * n_possible(rates, variables[variable, START], variables[variable, OUTPUTS]), n_grid + 1)
    for variable in touched:
        mutex = variables[variable, MUTEX]
        if mutex >= 0 and per_mutex[mutex] > 0:
            choices = per_mutex[mutex] % _SURE + int(per_mutex[mutex] < _SURE)
            possible = min(possible * choices, n_grid + 1)
            per_mutex[mutex] = 0
    return possible <= n_grid


@inlined
def _settle(
    touched: Ints,
    variables: Ints,
    members: Ints,
    exactly: Bools,
    values: Ints,
    rates: Floats,
    joint: Floats,
    mutex_members: Ints,
    per_mutex: Ints,
    opened: Ints,
    p: Particles,
    base: Ints,
    end_is_synchronic: bool,
    grid: Grid,
) -> tuple[int, bool]:
    """Writes certain outcomes to ``base`` and divides the particles over the others; returns (number of others, episode end)."""
    n_variables, n_open, ended = len(variables), 0, False
    for i in range(len(touched)):
        variable = touched[i]
        if variables[variable, MUTEX] >= 0:
            per_mutex[variables[variable, MUTEX]] += 1
            continue
        if end_is_synchronic and variable == n_variables - 2:
            continue
        n, start = variables[variable, OUTPUTS], variables[variable, START]
        best = only_possible(rates, start, n)
        if best < 0:
            for k in range(n):
                joint[k] = rates[start + k]
            share_out(p, -1, variable, n_open, joint, n, variable == n_variables - 2, grid)
            opened[n_open, 0], opened[n_open, 1] = variable, -1
            n_open += 1
        elif variable == n_variables - 2:
            ended = best == 1
        elif best != values[i]:
            _put(base, variable, best, variables, members)
    n_open = _settle_mutexes(
        touched, variables, members, exactly, rates, joint, mutex_members, per_mutex, opened, p, base, n_open, grid
    )
    return n_open, ended


@inlined
def _settle_mutexes(
    touched: Ints,
    variables: Ints,
    members: Ints,
    exactly: Bools,
    rates: Floats,
    joint: Floats,
    mutex_members: Ints,
    per_mutex: Ints,
    opened: Ints,
    p: Particles,
    base: Ints,
    n_open: int,
    grid: Grid,
) -> int:
    """As ``_settle``, for mutex groups; returns the number of uncertain outcomes."""
    n_variables, first = len(variables), 0
    for q in range(len(exactly)):
        n = per_mutex[q]
        if n == 0:
            continue
        per_mutex[q] = 0
        best = _mutex_distribution(q, first, touched, variables, exactly[q], rates, mutex_members, joint)
        if best >= 0:
            _choose(base, mutex_members, first, n, best, variables, members)
        else:
            share_out(p, -1, n_variables + q, n_open, joint, n + 1, False, grid)
            opened[n_open, 0], opened[n_open, 1] = first, n
            n_open += 1
        first += n
    return n_open


@inlined
def _write(
    total: int,
    n_open: int,
    ended: bool,
    base: Ints,
    opened: Ints,
    mutex_members: Ints,
    variables: Ints,
    members: Ints,
    p: Particles,
    n_grid: int,
    out: Outcomes,
) -> int:
    """Writes the outcomes that the particles represent, from number ``total`` on; returns their number."""
    states, terminated, probabilities, factors = out.states, out.terminated, out.probabilities, p.factors
    weigh(p, n_grid)
    for i in range(n_outcomes(p)):
        slot = slot_of(p, i, n_grid)
        terminated[total + i] = ended
        last = _fill(states[total + i], base, opened, n_open, mutex_members, variables, members, factors[slot])
        if last >= 0:
            terminated[total + i] = factors[slot, last] == 1
        probabilities[total + i] = p.chances[slot, MASS]
    return n_outcomes(p)


@inlined
def _fill(
    state: Ints, base: Ints, opened: Ints, n_open: int, mutex_members: Ints, variables: Ints, members: Ints, chosen: Ints
) -> int:
    """Writes the next state [F] that a particle represents; returns the index of ``terminated`` in ``opened``, or -1."""
    end, n_variables = -1, len(variables)
    for f in range(len(base)):
        state[f] = base[f]
    for v in range(n_open):
        number, n = opened[v, 0], opened[v, 1]
        if n >= 0:
            _choose(state, mutex_members, number, n, chosen[v], variables, members)
        elif number == n_variables - 2:
            end = v
        else:
            _put(state, number, chosen[v], variables, members)
    return int(end)


@inlined
def _mutex_distribution(
    mutex: int, first: int, touched: Ints, variables: Ints, exactly: bool, rates: Floats, mutex_members: Ints, out: Floats
) -> int:
    """Lists a mutex group's affected variables from ``mutex_members[first]`` on; returns the only possible one, or -1.

    As ``mutex.mutex_distribution``; the last probability is that of no bit being on.
    """
    n, total = 0, 0.0
    for variable in touched:
        if variables[variable, MUTEX] == mutex:
            mutex_members[first + n] = variable
            out[n] = rates[variables[variable, START] + 1]
            total += out[n]
            n += 1
    none = 0.0 if exactly and total > 1e-9 else max(0.0, 1.0 - total)
    for k in range(n):
        out[k] /= total + none
    out[n] = none / (total + none)
    leave_out_none(out, n + 1)
    return only_possible(out, 0, n + 1)


@inlined
def _choose(state: Ints, mutex_members: Ints, first: int, n: int, chosen: int, variables: Ints, members: Ints) -> None:
    """Switches one of a mutex group's listed bits on and the others off."""
    for k in range(n):
        state[members[variables[mutex_members[first + k], FIRST]]] = 1 if k == chosen else 0


@inlined
def _put(state: Ints, variable: int, value: int, variables: Ints, members: Ints) -> None:
    """Sets a variable's value."""
    first, n = variables[variable, FIRST], variables[variable, MEMBERS]
    if n == 1:
        state[members[first]] = value
    for member in range(n if n > 1 else 0):
        state[members[first + member]] = 1 if member == value else 0
