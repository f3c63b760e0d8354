"""Truth tables of bits: a pruned network compiled to what is left, for sampling and inside compiled search.

Each outcome bit has a table over the few bits that it still hangs on: of the state, and of the outcome bits before it. A draw is
a look-up a bit. Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.arithmetic import Floats, Ints
from mbagent.models.causal_bits import settled_chance, split_bit, write_outcomes
from mbagent.models.compiled_model import Outcomes, implements, outcomes, work_for
from mbagent.models.particles import Particles, new_particles
from mbagent_envs._compiled import compiled, inlined
from mbagent_envs.random_keys import uniform_at

Keys = NDArray[np.uint64]


class BitTables(NamedTuple):
    """Tables of P(bit = 1), one after another.

    Attributes:
        table: all of them.
        begin: where that of each outcome bit begins, int64 [O].
        stride: how much further that of the next action is; 0 where the action does not matter, int64 [O].
        n_states: how many of its parents are bits of the state, int64 [O].
        parents: of all outcome bits, those of the state first, int64.
        first: where the parents of each begin, int64 [O + 1].
        n_actions: A.
    """

    table: Floats
    begin: Ints
    stride: Ints
    n_states: Ints
    parents: Ints
    first: Ints
    n_actions: int


@compiled
def sample_tables(states: Ints, actions: Ints, keys: Keys, k: BitTables) -> Ints:
    """Draws int64 [B, O]: bit i of row b at number i of key b, as ``samplers.sample_causal``."""
    n_outputs = len(k.begin)
    table, begin, stride, n_states, parents, first = k.table, k.begin, k.stride, k.n_states, k.parents, k.first
    factors = np.empty((len(states), n_outputs), dtype=np.int64)
    for b in range(len(states)):
        action = actions[b]
        for i in range(n_outputs):
            place, weight, middle = begin[i] + stride[i] * action, 1, first[i] + n_states[i]
            for v in range(first[i], middle):
                place += weight * states[b, parents[v]]
                weight *= 2
            for v in range(middle, first[i + 1]):
                place += weight * factors[b, parents[v]]
                weight *= 2
            one = table[place]
            if one <= 0.0 or one >= 1.0:
                factors[b, i] = int(one >= 1.0)
            else:
                factors[b, i] = int(uniform_at(keys[b], i) >= 1.0 - one)
    return factors


class TablesWork(NamedTuple):
    """Work space.

    Attributes:
        base: the outcome's settled bits, int64 [O]; -1 where open.
        open: the open bits, int64 [O].
        slot: the number of each open bit among them, int64 [O].
        p: particles.
    """

    base: Ints
    open: Ints
    slot: Ints
    p: Particles


@implements(work_for, BitTables)
@compiled
def tables_work(k: BitTables, n_grid: int) -> TablesWork:
    """See compiled_model."""
    n_outputs = len(k.begin)
    return TablesWork(
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        new_particles(n_grid, n_outputs),
    )


@inlined
def _seen(i: int, q: int, start: int, weight: int, k: BitTables, base: Ints, slot: Ints, factors: Ints) -> float:
    """The chance of bit i in the eyes of particle q, from the place that the state's bits lead to."""
    place = start
    for v in range(k.first[i] + k.n_states[i], k.first[i + 1]):
        j = k.parents[v]
        value = base[j]
        if value < 0:
            value = factors[q, slot[j]]
        place += weight * value
        weight *= 2
    return settled_chance(k.table[place])


@implements(outcomes, BitTables)
@compiled
def tables_outcomes(
    k: BitTables, work: TablesWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See compiled_model."""
    grid, total, base, still_open, slot, p = (n_grid, key, offset), 0, work.base, work.open, work.slot, work.p
    first_point, points, low, high, mass, factors = p.first, p.points, p.low, p.high, p.mass, p.factors
    for action in range(k.n_actions):
        first_point[0], points[0], low[0], high[0], mass[0], n_live, n_open = 0, n_grid, 0.0, 1.0, 1.0, 1, 0
        for i in range(len(base)):
            place, weight, shared = k.begin[i] + k.stride[i] * action, 1, True
            for v in range(k.first[i], k.first[i] + k.n_states[i]):
                place += weight * state[k.parents[v]]
                weight *= 2
            for v in range(k.first[i] + k.n_states[i], k.first[i + 1]):
                shared = shared and base[k.parents[v]] >= 0
            if shared:  # the same for all particles
                chance = _seen(i, 0, place, weight, k, base, slot, factors)
                if chance <= 0.0 or chance >= 1.0:
                    base[i] = int(chance >= 1.0)
                    continue
            base[i], slot[i], still_open[n_open] = -1, n_open, i
            for q in range(n_live):
                chance = _seen(i, q, place, weight, k, base, slot, factors)
                n_live = split_bit(q, n_live, i, n_open, chance, grid, first_point, points, low, high, mass, factors)
            n_open += 1
        write_outcomes(total, n_live, base, still_open[:n_open], p, n_grid, out)
        out.counts[action] = n_live
        total += n_live
    return total
