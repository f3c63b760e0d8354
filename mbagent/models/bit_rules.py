"""What a pruned network of bits is compiled to: truth tables where few inputs are left, else lists of connections.

Each outcome bit has a table over the few bits that it still hangs on, of the state and of the outcome bits before it; a draw is a
look-up a bit, and less where it is just the copy of another. A bit that hangs on too many for a table is drawn by what is left of
its networks (``sparse_networks``). Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.arithmetic import Floats, Ints
from mbagent.models.causal_bits import settled_chance, write_outcomes
from mbagent.models.compiled_model import Outcomes, implements, outcomes, work_for
from mbagent.models.particles import MAIN, STRATA, Particles, begin, bit_chances, new_particles, place_of, share_out
from mbagent.models.sparse_networks import Room, SparseNetworks, ask, leans_on_open, room_for, see_action, see_state
from mbagent_envs._compiled import borrowed, compiled, inlined
from mbagent_envs.random_keys import uniform_at

Keys = NDArray[np.uint64]

TOLERANCE = 0.002
"""What taking improbable values for impossible may change in all, in total variation summed over variables."""


class Table(NamedTuple):
    """What one outcome bit hangs on.

    Attributes:
        states: bits of the state, in order.
        others: bits of the outcome, in order.
        chances: P(bit = 1): [1 or A, 2, ..., 2], an axis for the action, and one for each of these bits, the last one first.
    """

    states: tuple[int, ...]
    others: tuple[int, ...]
    chances: Floats

    def simplified(self, chances: Floats) -> Table:
        """With other chances, and without what makes no difference to them."""
        if len(chances) > 1 and (chances == chances[:1]).all():
            chances = chances[:1]
        bits, n_states = [*self.states, *self.others], len(self.states)
        for v in range(len(bits) - 1, -1, -1):
            axis = chances.ndim - 1 - v
            if np.array_equal(chances.take(0, axis), chances.take(1, axis)):
                chances = chances[(slice(None),) * axis + (0,)]
                del bits[v]
                n_states -= v < n_states
        return Table(tuple(bits[:n_states]), tuple(bits[n_states:]), chances)


class BitRules(NamedTuple):
    """Tables and networks.

    Attributes:
        table: chances of all tables, one after another.
        bits: a row for each outcome bit that is more than a copy, in order, int64 [R, 6]: the bit; where its table begins, -1 if
            the networks are asked; how much further that of the next action is; where its parents begin, of the state, of the
            outcome, and where they end.
        parents: of all tables, int64.
        copies: a row for each other bit, int64 [O - R, 4]: the bit; a bit of the state; what follows from its being 0; and 1.
        n_actions: A.
        networks: of the bits without a table; None where all have one.
    """

    table: Floats
    bits: Ints
    parents: Ints
    copies: Ints
    n_actions: int
    networks: SparseNetworks | None


def compile_rules(
    tables: Sequence[Table | None], networks: SparseNetworks | None, n_actions: int, settled: bool = False
) -> BitRules:
    """The rules from a table, or None, for each outcome bit.

    Args:
        tables: chances that are next to 0 or 1 are taken for that.
        networks: tell the bits that have no table.
        n_actions: A.
        settled: whether to leave out values as search does, see ``settled_chance``.
    """
    least, chances, bits, copies, size = TOLERANCE / len(tables), [np.zeros(0)], [], [], 0
    parents: list[int] = []
    for i, table in enumerate(tables):
        if table is None:
            bits.append((i, -1, 0, len(parents), len(parents), len(parents)))
            continue
        sure = np.where(table.chances < least, 0.0, np.where(table.chances > 1.0 - least, 1.0, table.chances))
        one = table.simplified(np.vectorize(settled_chance, otypes=[np.float64])(sure) if settled else sure)
        flat = one.chances.reshape(len(one.chances), -1)
        if len(one.states) <= 1 and not one.others and len(flat) == 1 and np.isin(flat, (0.0, 1.0)).all():
            copies.append((i, *(one.states or (0,)), int(flat[0, 0]), int(flat[0, -1])))
            continue
        begin, middle = len(parents), len(parents) + len(one.states)
        parents += [*one.states, *one.others]
        bits.append((i, size, flat.shape[1] if len(flat) > 1 else 0, begin, middle, len(parents)))
        chances.append(flat.ravel())
        size += flat.size
    rows, fixed = np.array(bits, dtype=np.int64).reshape(-1, 6), np.array(copies, dtype=np.int64).reshape(-1, 4)
    return BitRules(np.concatenate(chances), rows, np.array(parents, dtype=np.int64), fixed, n_actions, networks)


@inlined
def _copy(state: Ints, copies: Ints, values: Ints) -> None:
    """Writes the bits that need no look-up."""
    for v in range(len(copies)):
        values[copies[v, 0]] = copies[v, 3] if state[copies[v, 1]] == 1 else copies[v, 2]


@inlined
def _by_state(r: int, action: int, state: Ints, bits: Ints, parents: Ints) -> tuple[int, int]:
    """(place in its table that action and state lead to, weight of the next parent)."""
    place, weight = bits[r, 1] + bits[r, 2] * action, 1
    for v in range(bits[r, 3], bits[r, 4]):
        place += weight * state[parents[v]]
        weight *= 2
    return place, weight


@compiled
def sample_rules(states: Ints, actions: Ints, keys: Keys, rules: BitRules) -> tuple[Ints, NDArray[np.bool_]]:
    """Draws next states int64 [B, F] and ``terminated`` bool [B]: bit i of row b at number i of key b, as ``samplers``."""
    n_bits, k = states.shape[1], borrowed(rules)
    table, bits, parents, copies, networks, room = k.table, k.bits, k.parents, k.copies, k.networks, room_for(k.networks)
    drawn, ended, none = np.empty_like(states), np.zeros(len(states), dtype=np.bool_), np.zeros((1, 1), dtype=np.int64)
    outcome, chances, conditioned = np.zeros(n_bits + 1, dtype=np.int64), room.chances, room.conditioned
    for b in range(len(states)):
        action, state = actions[b], states[b]
        _copy(state, copies, outcome)
        see_state(networks, room, state)
        see_action(networks, room, state, action)
        for r in range(len(bits)):
            i = bits[r, 0]
            if bits[r, 1] >= 0:
                place, weight = _by_state(r, action, state, bits, parents)
                for v in range(bits[r, 4], bits[r, 5]):
                    place += weight * outcome[parents[v]]
                    weight *= 2
                one = table[place]
            elif conditioned[i]:
                one = ask(networks, room, i, action, 0, state, outcome, none[0], none)
            else:
                one = chances[i]
            if one <= 0.0 or one >= 1.0:
                outcome[i] = int(one >= 1.0)
            else:
                outcome[i] = int(uniform_at(keys[b], i) >= 1.0 - one)
        drawn[b], ended[b] = outcome[:n_bits], outcome[n_bits] == 1
    return drawn, ended


class RulesWork(NamedTuple):
    """Work space.

    Attributes:
        base: the outcome's settled bits, int64 [O]; -1 where open.
        open: the open bits, int64 [O].
        slot: the number of each open bit among them, int64 [O].
        p: particles.
        room: the networks'.
    """

    base: Ints
    open: Ints
    slot: Ints
    p: Particles
    room: Room


@implements(work_for, BitRules)
@compiled
def rules_work(k: BitRules, n_grid: int) -> RulesWork:
    """See compiled_model."""
    n_outputs = len(k.bits) + len(k.copies)
    return RulesWork(
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        new_particles(n_grid, n_outputs, 2),
        room_for(k.networks),
    )


@inlined
def _by_outcome(q: int, place: int, weight: int, v: int, end: int, parents: Ints, base: Ints, slot: Ints, factors: Ints) -> int:
    """Where the outcome's bits lead to from there, in the eyes of particle q; the parents are number v to ``end``."""
    while v < end:
        value = base[parents[v]]
        if value < 0:
            value = factors[q, slot[parents[v]]]
        place += weight * value
        weight *= 2
        v += 1
    return place


@implements(outcomes, BitRules)
@compiled
def rules_outcomes(k: BitRules, work: RulesWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes) -> int:
    """See compiled_model."""
    table, bits, parents, networks, room, base, slot = k.table, k.bits, k.parents, k.networks, work.room, work.base, work.slot
    grid, total, still_open, p, chances, conditioned = (n_grid, key, offset), 0, work.open, work.p, room.chances, room.conditioned
    factors, values = p.factors, np.empty(2, dtype=np.float64)
    see_state(networks, room, state)
    _copy(state, k.copies, base)
    last = len(base) - 1
    for action in range(k.n_actions):
        see_action(networks, room, state, action)
        n_open = 0
        begin(p, n_grid, False, place_of(state))  # which bits are open is not known before
        for r in range(len(bits)):
            i, start, end, chance = bits[r, 0], bits[r, 4], bits[r, 5], 0.5
            place, weight = _by_state(r, action, state, bits, parents)
            shared = not (place < 0 and conditioned[i] and leans_on_open(networks, i, base))
            for v in range(start, end):
                shared = shared and base[parents[v]] >= 0
            if shared:  # the same for all particles
                if place < 0 and conditioned[i]:
                    chance = settled_chance(ask(networks, room, i, action, 0, state, base, slot, factors))
                elif place < 0:
                    chance = settled_chance(chances[i])
                else:
                    chance = table[_by_outcome(0, place, weight, start, end, parents, base, slot, factors)]
                if chance <= 0.0 or chance >= 1.0:
                    base[i] = int(chance >= 1.0)
                    continue
            base[i], slot[i], still_open[n_open] = -1, n_open, i
            if shared:
                bit_chances(chance, values)
                share_out(p, -1, i, n_open, values, 2, i == last, grid)
            n_main, n_strata = p.state[MAIN], p.state[STRATA]
            for j in range(0 if shared else n_main + n_strata):
                q = n_grid + j if j < n_strata else j - n_strata  # strata first
                if place < 0:
                    chance = settled_chance(ask(networks, room, i, action, q, state, base, slot, factors))
                else:
                    chance = table[_by_outcome(q, place, weight, start, end, parents, base, slot, factors)]
                bit_chances(chance, values)
                share_out(p, q, i, n_open, values, 2, i == last, grid)
            n_open += 1
        out.counts[action] = write_outcomes(total, base, still_open[:n_open], p, n_grid, out)
        out.left_out[action] = p.left[0]
        total += out.counts[action]
    return total
