"""What a pruned network of bits is compiled to: truth tables where few inputs are left, else lists of connections.

Each outcome bit has a table over the few bits that it still hangs on, of the state and of the outcome bits before it; a draw is a
look-up a bit. A bit that hangs on too many for a table is drawn by what is left of its networks (``sparse_networks``).
Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions, H hidden nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.arithmetic import Floats, Floats32, Ints
from mbagent.models.bit_networks import activate
from mbagent.models.causal_bits import settled_chance, split_bit, write_outcomes
from mbagent.models.compiled_model import Outcomes, implements, outcomes, work_for
from mbagent.models.particles import Particles, new_particles
from mbagent.models.sparse_networks import SparseNetworks, add_input, conditioned, leans_on_open, predict_bits
from mbagent_envs._compiled import borrowed, compiled, inlined
from mbagent_envs.random_keys import uniform_at

Keys = NDArray[np.uint64]

TOLERANCE = 0.002
"""What taking improbable values for impossible may change in all, in total variation summed over variables."""

SURE_LOGIT = math.log(1e6)
"""A logit further from 0 is sure."""


class BitTables(NamedTuple):
    """Tables of P(bit = 1), one after another.

    Attributes:
        table: all of them.
        begin: where that of each outcome bit begins, int64 [O].
        stride: how much further that of the next action is; 0 where the action does not matter, int64 [O].
        n_states: how many of its parents are bits of the state, int64 [O].
        parents: of all outcome bits, those of the state first, int64; none where a bit has no table.
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


class Copies(NamedTuple):
    """Bits that follow from one bit of the state, or from nothing, without any luck.

    Attributes:
        bit: which outcome bits, int64.
        parent: the state bit of each.
        low: what it becomes if that is 0.
        high: what it becomes if that is 1.
        rest: the outcome bits that are none of these, in order.
    """

    bit: Ints
    parent: Ints
    low: Ints
    high: Ints
    rest: Ints


class BitRules(NamedTuple):
    """What is left, in three parts; twice, since search leaves unlikely values out.

    Attributes:
        tables: of the bits that the networks are not asked for.
        copies: of them, those that need no look-up.
        networks: of all other bits.
        settled: the tables as search sees them, by ``settled_chance``.
        settled_copies: of those.
    """

    tables: BitTables
    copies: Copies
    networks: SparseNetworks
    settled: BitTables
    settled_copies: Copies


def compile_rules(tables: BitTables, networks: SparseNetworks) -> BitRules:
    """The rules, with chances that are next to 0 or 1 taken for that."""
    least = TOLERANCE / len(tables.begin)
    sure = np.where(tables.table < least, 0.0, np.where(tables.table > 1.0 - least, 1.0, tables.table))
    settled = np.array([settled_chance(chance) for chance in sure])
    first, second = tables._replace(table=sure), tables._replace(table=settled)
    return BitRules(first, _copies(first, networks.asked), networks, second, _copies(second, networks.asked))


def _copies(k: BitTables, asked: NDArray[np.bool_]) -> Copies:
    """The bits of the tables that need no look-up."""
    found, rest = [], []
    for i in range(len(k.begin)):
        n_parents = int(k.first[i + 1] - k.first[i])
        entries = k.table[k.begin[i] : k.begin[i] + (1 << n_parents)]
        if asked[i] or k.stride[i] or n_parents > 1 or n_parents > k.n_states[i] or ((entries > 0.0) & (entries < 1.0)).any():
            rest.append(i)
        else:
            found.append((i, int(k.parents[k.first[i]]) if n_parents else 0, int(entries[0]), int(entries[-1])))
    columns = np.array(found, dtype=np.int64).reshape(-1, 4).T.copy()
    return Copies(columns[0], columns[1], columns[2], columns[3], np.array(rest, dtype=np.int64))


@inlined
def _chance(logit: float) -> float:
    """The logistic function, in double precision; 0 or 1 where it is next to that."""
    if abs(logit) > SURE_LOGIT:
        return 1.0 if logit > 0.0 else 0.0
    return 1.0 / (1.0 + math.exp(-logit))


@inlined
def _copy(state: Ints, c: Copies, values: Ints) -> None:
    """Writes the bits that need no look-up."""
    bit, parent, low, high, _ = c
    for v in range(len(bit)):
        values[bit[v]] = high[v] if state[parent[v]] == 1 else low[v]


@inlined
def _sums(state: Ints, sums: Floats32, k: SparseNetworks) -> None:
    """What a state gives to the hidden nodes."""
    bias, links = k.bias, k.inputs
    for h in range(len(sums)):
        sums[h] = bias[h]
    for bit in range(len(state)):
        if state[bit] == 1:
            add_input(bit, sums, links)


@inlined
def _hidden(n_bits: int, action: int, sums: Floats32, hidden: Floats32, k: SparseNetworks) -> None:
    """The hidden nodes' values, given what the state gives to them."""
    for h in range(len(sums)):
        hidden[h] = sums[h]
    add_input(n_bits + action, hidden, k.inputs)
    activate(hidden, k.activation)


@compiled
def sample_rules(states: Ints, actions: Ints, keys: Keys, k: BitRules) -> tuple[Ints, NDArray[np.bool_]]:
    """Draws next states int64 [B, F] and ``terminated`` bool [B]: bit i of row b at number i of key b, as ``samplers``."""
    tables, networks, copies = borrowed(k.tables), borrowed(k.networks), borrowed(k.copies)
    table, begin, stride, n_states, parents, first = tables[:6]
    n_bits, n_hidden, asked, grouped = states.shape[1], len(networks.bias), networks.asked, networks.groups.grouped
    any_asked, rest, certain = asked.any(), copies.rest, networks.certain
    drawn, ended, none = np.empty_like(states), np.zeros(len(states), dtype=np.bool_), np.zeros((1, 1), dtype=np.int64)
    hidden, nodes = np.empty(n_hidden, dtype=np.float32), np.empty(len(networks.groups.readout), dtype=np.float32)
    logits, factors = np.zeros(len(begin)), np.zeros(len(begin), dtype=np.int64)
    for b in range(len(states)):
        action = actions[b]
        _copy(states[b], copies, factors)
        if any_asked:
            _sums(states[b], hidden, networks)
            _hidden(n_bits, action, hidden, hidden, networks)
            predict_bits(states[b], action, hidden, rest, logits, networks)
        for i in rest:
            if asked[i]:
                logit = logits[i]
                if grouped[i] and abs(logit) < certain:
                    logit = conditioned(i, logit, action, 0, states[b], factors, none[0], none, nodes, networks)
                one = _chance(logit)
            else:
                place, weight, middle = begin[i] + stride[i] * action, 1, first[i] + n_states[i]
                for v in range(first[i], middle):
                    place += weight * states[b, parents[v]]
                    weight *= 2
                for v in range(middle, first[i + 1]):
                    place += weight * factors[parents[v]]
                    weight *= 2
                one = table[place]
            if one <= 0.0 or one >= 1.0:
                factors[i] = int(one >= 1.0)
            else:
                factors[i] = int(uniform_at(keys[b], i) >= 1.0 - one)
        drawn[b], ended[b] = factors[:n_bits], factors[n_bits] == 1
    return drawn, ended


class RulesWork(NamedTuple):
    """Work space.

    Attributes:
        base: the outcome's settled bits, int64 [O]; -1 where open.
        open: the open bits, int64 [O].
        slot: the number of each open bit among them, int64 [O].
        sums: what the state gives to the hidden nodes, [H].
        hidden: their values, [H].
        logits: the predictor's, [O].
        nodes: values of a group's nodes.
        p: particles.
    """

    base: Ints
    open: Ints
    slot: Ints
    sums: Floats32
    hidden: Floats32
    logits: Floats
    nodes: Floats32
    p: Particles


@implements(work_for, BitRules)
@compiled
def rules_work(k: BitRules, n_grid: int) -> RulesWork:
    """See compiled_model."""
    n_outputs, n_hidden = len(k.tables.begin), len(k.networks.bias)
    return RulesWork(
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_hidden, dtype=np.float32),
        np.empty(n_hidden, dtype=np.float32),
        np.empty(n_outputs, dtype=np.float64),
        np.empty(len(k.networks.groups.readout), dtype=np.float32),
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
    chance: float = k.table[place]
    return chance


@inlined
def _told(
    i: int, prior: float, group: bool, action: int, q: int, state: Ints, place: int, weight: int, k: BitRules, work: RulesWork
) -> float:
    """The chance of bit i in the eyes of particle q, by its table or its networks."""
    if not k.networks.asked[i]:
        return _seen(i, q, place, weight, k.settled, work.base, work.slot, work.p.factors)
    logit = prior
    if group:
        logit = conditioned(i, prior, action, q, state, work.base, work.slot, work.p.factors, work.nodes, k.networks)
    return settled_chance(_chance(logit))


@implements(outcomes, BitRules)
@compiled
def rules_outcomes(k: BitRules, work: RulesWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes) -> int:
    """See compiled_model."""
    tables, networks = k.settled, k.networks
    grid, total, base, still_open, slot, p = (n_grid, key, offset), 0, work.base, work.open, work.slot, work.p
    first_point, points, low, high, mass, factors = p.first, p.points, p.low, p.high, p.mass, p.factors
    any_asked, rest = networks.asked.any(), k.settled_copies.rest
    if any_asked:
        _sums(state, work.sums, networks)
    _copy(state, k.settled_copies, base)
    for action in range(tables.n_actions):
        if any_asked:
            _hidden(len(state), action, work.sums, work.hidden, networks)
            predict_bits(state, action, work.hidden, rest, work.logits, networks)
        first_point[0], points[0], low[0], high[0], mass[0], n_live, n_open = 0, n_grid, 0.0, 1.0, 1.0, 1, 0
        for i in rest:
            asked, place, weight, prior, group = networks.asked[i], 0, 1, 0.0, False
            if asked:
                prior = work.logits[i]
                group = networks.groups.grouped[i] and abs(prior) < networks.certain
                shared = not (group and leans_on_open(i, base, networks))
            else:
                place, shared = tables.begin[i] + tables.stride[i] * action, True
                for v in range(tables.first[i], tables.first[i] + tables.n_states[i]):
                    place += weight * state[tables.parents[v]]
                    weight *= 2
                for v in range(tables.first[i] + tables.n_states[i], tables.first[i + 1]):
                    shared = shared and base[tables.parents[v]] >= 0
            chance = 0.5
            if shared:  # the same for all particles
                chance = _told(i, prior, group, action, 0, state, place, weight, k, work)
                if chance <= 0.0 or chance >= 1.0:
                    base[i] = int(chance >= 1.0)
                    continue
            base[i], slot[i], still_open[n_open] = -1, n_open, i
            for q in range(n_live):
                if not shared:
                    chance = _told(i, prior, group, action, q, state, place, weight, k, work)
                n_live = split_bit(q, n_live, i, n_open, chance, grid, first_point, points, low, high, mass, factors)
            n_open += 1
        write_outcomes(total, n_live, base, still_open[:n_open], p, n_grid, out)
        out.counts[action] = n_live
        total += n_live
    return total
