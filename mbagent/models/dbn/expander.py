"""Decision graphs in compiled search: only the variables that a state affects are evaluated (see ``affected_variables.py``).

The outcomes are those of ``successors.successors``, at a cost that grows with the number of affected variables, not of all. The
only variable with synchronic arcs is the end of the episode; features of the next state are evaluated only when its graph tests
them.
Shapes: A actions, U variables, F factors, Q mutex groups, W words of 64 variables, D features.
"""

from __future__ import annotations

import numpy as np

from mbagent.models.dbn.affected_variables import AffectedIndex, affected_variables_of, end_rate, show_state
from mbagent.models.dbn.arrays import distributions, write
from mbagent.models.dbn.features import ActionEncoding
from mbagent.models.dbn.mutex import leave_out_none
from mbagent.models.dbn.planes.invariants import leave_out
from mbagent.models.dbn.sampling import only_possible
from mbagent.models.kernel import Outcomes, work_for
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
from mbagent_envs.structs import Struct

_SURE = 1 << 40
"""Counted for a bit that is certain to be on."""


class GraphWork(Struct):
    """Work space; between two calls, ``on`` holds the features of the all-zero state.

    Attributes:
        on: features, bool [D].
        rates: distributions of the affected variables, [sum of cardinalities].
        joint: distribution of a variable or mutex group.
        different: factors that are not 0, int64 [F].
        words: affected variables as bits, uint64 [W].
        variables: affected variables, int64 [U].
        values: current values of the affected variables, int64 [U].
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


@compiled
def graph_outcomes(
    g: AffectedIndex, work: GraphWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See ``Kernel.outcomes``."""
    layout, on, grid, total = g.layout, work.on, (n_grid, key, offset), 0
    ends, n_state_features = len(g.synchronic.changing) > 0, len(layout.factor)
    place, n_different = place_of(state), show_state(state, layout, work.different, on)
    different = work.different[:n_different]
    for action in range(len(g.always)):
        n = affected_variables_of(action, state, different, g, on, work.words, work.variables)
        touched = work.variables[:n]
        _show_action(layout.encoding, action, n_state_features, True, on)
        distributions(touched, state, action, layout, g.graphs, on, work.values, work.rates)
        for f in range(len(state)):
            work.base[f] = state[f]
        begin(work.p, n_grid, _fits(g, touched, work, n_grid), place)
        n_open, ended = _settle(g, touched, work, grid)
        if ends:
            _end(g, work, action, n_open, grid)
            n_open += 1
        _show_action(layout.encoding, action, n_state_features, False, on)
        n_live = _write(g, work, total, n_open, ended, n_grid, out)
        if len(layout.counts) or len(layout.observed):
            n_live = leave_out(layout, state, total, n_live, out)
        out.counts[action], out.left_out[action] = n_live, work.p.left[0]
        total += n_live
    for factor in different:
        for feature in range(layout.first_feature[factor], layout.first_feature[factor + 1]):
            on[feature] = g.usual_on[feature]
    return total


@compiled
def _end(g: AffectedIndex, work: GraphWork, action: int, n_open: int, grid: Grid) -> None:
    """Draws for each particle whether the episode ends, given its next state so far."""
    p, joint, end = work.p, work.joint, len(g.layout.outputs) - 2
    n_main, n_strata = p.state[MAIN], p.state[STRATA]
    for j in range(n_main + n_strata):
        slot = grid[0] + j if j < n_strata else j - n_strata  # strata first
        _fill(g, work, work.following, n_open, slot)
        joint[1] = end_rate(action, work.following, work.on, g.layout, g.synchronic)
        joint[0] = 1.0 - joint[1]
        share_out(p, slot, end, n_open, joint, 2, True, grid)
    work.opened[n_open, 0], work.opened[n_open, 1] = end, -1


@inlined
def _show_action(encoding: ActionEncoding, action: int, first: int, shown: bool, on: Bools) -> None:
    """Switches an action's features, which begin at ``first``, on or off."""
    for i in range(encoding.first[action], encoding.first[action + 1]):
        on[first + encoding.feature[i]] = shown


@compiled
def _fits(g: AffectedIndex, touched: Ints, work: GraphWork, n_grid: int) -> bool:
    """Whether all outcomes of a row can be listed; ``per_mutex`` is all 0 before and after the call."""
    layout, start, rates, per_mutex = g.layout, g.graphs.start, work.rates, work.per_mutex
    possible, end = 1, len(layout.outputs) - 2 if len(g.synchronic.changing) > 0 else -1
    for variable in touched:
        mutex = layout.mutex_of[variable]
        if mutex >= 0:
            rate = rates[start[variable] + 1]  # as ``mutex.n_choices``
            per_mutex[mutex] += int(rate > 0.0) + (_SURE if rate >= 1.0 else 0)
        elif variable != end:
            possible = min(possible * n_possible(rates, start[variable], layout.outputs[variable]), n_grid + 1)
    for variable in touched:
        mutex = layout.mutex_of[variable]
        if mutex >= 0 and per_mutex[mutex] > 0:
            choices = per_mutex[mutex] % _SURE + int(per_mutex[mutex] < _SURE)
            possible = min(possible * choices, n_grid + 1)
            per_mutex[mutex] = 0
    return possible <= n_grid


@compiled
def _settle(g: AffectedIndex, touched: Ints, work: GraphWork, grid: Grid) -> tuple[int, bool]:
    """Writes certain outcomes to ``base`` and divides the particles over the others; returns (number of others, episode end)."""
    layout, start, rates, joint = g.layout, g.graphs.start, work.rates, work.joint
    end, n_open, ended = len(layout.outputs) - 2, 0, False
    for variable in touched:
        if layout.mutex_of[variable] >= 0:
            work.per_mutex[layout.mutex_of[variable]] += 1
            continue
        if variable == end and len(g.synchronic.changing) > 0:
            continue
        n = layout.outputs[variable]
        best = only_possible(rates, start[variable], n)
        if best < 0:
            for k in range(n):
                joint[k] = rates[start[variable] + k]
            share_out(work.p, -1, variable, n_open, joint, n, variable == end, grid)
            work.opened[n_open, 0], work.opened[n_open, 1] = variable, -1
            n_open += 1
        elif variable == end:
            ended = best == 1
        elif best != work.values[variable]:
            write(work.base, variable, best, layout)
    first = 0
    for q in range(len(work.per_mutex)):
        n = work.per_mutex[q]
        if n == 0:
            continue
        work.per_mutex[q] = 0
        best = _mutex_distribution(g, q, first, touched, work)
        if best >= 0:
            _choose(g, work, work.base, first, n, best)
        else:
            share_out(work.p, -1, len(layout.outputs) + q, n_open, joint, n + 1, False, grid)
            work.opened[n_open, 0], work.opened[n_open, 1] = first, n
            n_open += 1
        first += n
    return n_open, ended


@compiled
def _write(g: AffectedIndex, work: GraphWork, total: int, n_open: int, ended: bool, n_grid: int, out: Outcomes) -> int:
    """Writes the outcomes that the particles represent, from index ``total`` on; returns their number."""
    p = work.p
    weigh(p, n_grid)
    for i in range(n_outcomes(p)):
        slot = slot_of(p, i, n_grid)
        last = _fill(g, work, out.states[total + i], n_open, slot)
        out.terminated[total + i] = ended if last < 0 else p.factors[slot, last] == 1
        out.probabilities[total + i] = p.chances[slot, MASS]
    return n_outcomes(p)


@inlined
def _fill(g: AffectedIndex, work: GraphWork, state: Ints, n_open: int, slot: int) -> int:
    """Writes the next state [F] that a particle represents; returns the index of ``terminated`` in ``opened``, or -1."""
    end, opened, chosen = -1, work.opened, work.p.factors
    for f in range(len(work.base)):
        state[f] = work.base[f]
    for v in range(n_open):
        number, n = opened[v, 0], opened[v, 1]
        if n >= 0:
            _choose(g, work, state, number, n, chosen[slot, v])
        elif number == len(g.layout.outputs) - 2:
            end = v
        else:
            write(state, number, chosen[slot, v], g.layout)
    return int(end)


@inlined
def _mutex_distribution(g: AffectedIndex, mutex: int, first: int, touched: Ints, work: GraphWork) -> int:
    """Lists a mutex group's affected variables from ``mutex_members[first]`` on; returns the only possible one, or -1.

    As ``mutex.mutex_distribution``, into ``joint``; the last probability is that of no bit being on.
    """
    n, total, out = 0, 0.0, work.joint
    for variable in touched:
        if g.layout.mutex_of[variable] == mutex:
            work.mutex_members[first + n] = variable
            out[n] = work.rates[g.graphs.start[variable] + 1]
            total += out[n]
            n += 1
    none = 0.0 if g.layout.exactly[mutex] and total > 1e-9 else max(0.0, 1.0 - total)
    for k in range(n):
        out[k] /= total + none
    out[n] = none / (total + none)
    leave_out_none(out, n + 1)
    return only_possible(out, 0, n + 1)


@inlined
def _choose(g: AffectedIndex, work: GraphWork, state: Ints, first: int, n: int, chosen: int) -> None:
    """Switches one of a mutex group's listed bits on and the others off."""
    for k in range(n):
        state[g.layout.members[g.layout.first[work.mutex_members[first + k]]]] = 1 if k == chosen else 0


class GraphKernel(AffectedIndex):
    """Decision graphs for compiled search, for models without resets and synchronic arcs other than termination's."""

    outcomes = staticmethod(graph_outcomes)


@work_for.register
def graph_work(g: GraphKernel, n_grid: int) -> GraphWork:
    """See ``models.kernel.work_for``."""
    layout = g.layout
    n_variables, n_factors, n_mutexes = len(layout.outputs), layout.n_factors, len(layout.exactly)
    width, most = n_variables + n_mutexes, max(int(layout.outputs.max()), n_variables) + 1
    return GraphWork(
        on=g.usual_on.copy(),
        rates=np.empty(len(g.graphs.base)),
        joint=np.empty(most),
        different=np.empty(n_factors, dtype=np.int64),
        words=np.empty(g.always.shape[1], dtype=np.uint64),
        variables=np.empty(n_variables, dtype=np.int64),
        values=np.empty(n_variables, dtype=np.int64),
        mutex_members=np.empty(n_variables, dtype=np.int64),
        per_mutex=np.zeros(n_mutexes, dtype=np.int64),
        opened=np.empty((width, 2), dtype=np.int64),
        p=new_particles(n_grid, width, most),
        base=np.empty(n_factors, dtype=np.int64),
        following=np.empty(n_factors, dtype=np.int64),
    )
