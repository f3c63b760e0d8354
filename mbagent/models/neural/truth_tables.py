"""Truth tables of pruned networks of bits.

Each outcome bit has a table over the few state bits and earlier outcome bits on which it still depends; a sample is one look-up.
The parents of a bit are the inputs connected to it by some path whose effect exceeds a tolerance; all other inputs are fixed to
their modes, and the resulting error is measured on transitions. If any bit has too many parents for a table, no tables are
built.
Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), A actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbagent.models.kernel import Outcomes, work_for
from mbagent.models.neural.networks import ACTIVATIONS, Affine, Conditioner, DensePredictor
from mbagent.models.neural.training import Examples
from mbagent.models.systematic_sampling import (
    MAIN,
    MASS,
    NEGLIGIBLE,
    STRATA,
    Particles,
    begin,
    bit_chances,
    n_outcomes,
    new_particles,
    place_of,
    share_out,
    slot_of,
    weigh,
)
from mbagent.types import Floats, Ints, Keys
from mbagent_envs.jit import compiled, inlined
from mbagent_envs.random_keys import uniform_at
from mbagent_envs.structs import Struct

MOST_PARENTS = 12
"""Largest number of parents of a table, which then has two to this power entries for each action."""

CONSTANT_TOLERANCE = 0.002
"""Largest allowed error of fixing bits to their modes, in total variation summed over variables."""

PARENT = 2
"""Marks a parent; 0 and 1 are values to which other bits are fixed."""

TABLE_ROWS = 8192
"""Largest number of transitions on which differences are measured."""

Marks = NDArray[np.int8]


class Pair(NamedTuple):
    """The two networks, and the probability ``certain`` from which the predictor is trusted."""

    predictor: DensePredictor
    conditioner: Conditioner | None
    certain: float


def _predicted(pair: Pair, inputs: Tensor, outputs: slice) -> Tensor:
    """The predictor's logits of some outcome bits, from columns [N, n_inputs]."""
    predictor, values = pair.predictor, inputs
    for layer in predictor.layers:
        values = ACTIVATIONS[predictor.activation](layer(values))
    logits = values @ predictor.out.weight[outputs].T + predictor.out.bias[outputs]
    if predictor.stay is not None:
        n = predictor.codec.n_state_columns
        signed = (2.0 * inputs[:, :n] - 1.0) * (inputs[:, n:] @ predictor.stay)
        logits = logits + torch.cat((signed, signed.new_zeros(len(signed), 1)), dim=1)[:, outputs]
    return logits


def chances(pair: Pair, columns: Tensor, i: int) -> Tensor:
    """P(bit i = 1) [N] by the rule of ``sampling.sample_causal``; columns: state, action, outcome, [N, n_inputs + O]."""
    n_inputs, conditioner = pair.predictor.codec.n_inputs, pair.conditioner
    logit = _predicted(pair, columns[:, :n_inputs], slice(i, i + 1))[:, 0]
    chance = torch.sigmoid(logit.double())
    if conditioner is None or not bool(conditioner.grouped[i]):
        return chance
    g, size = int(conditioner.grouped[:i].sum()), conditioner.group_size
    groups, rows = conditioner.groups, slice(g * size, (g + 1) * size)
    weight = groups.weight[rows] if groups.mask is None else groups.weight[rows] * groups.mask[rows]
    hidden = ACTIVATIONS[conditioner.activation](columns @ weight.T + groups.bias[rows])
    own = (hidden @ conditioner.readout[g] + conditioner.offset[g])[:, 0]
    conditioned = torch.sigmoid((own + logit if conditioner.correction else own).double())
    return torch.where(torch.maximum(chance, 1.0 - chance) >= pair.certain, chance, conditioned)


def _paths(layers: list[Tensor]) -> NDArray[np.bool_]:
    """Mask [outputs, inputs] of the inputs with a path to each output, through layers of weights [to, from]."""
    reach = (layers[0] != 0.0).double()
    for weight in layers[1:]:
        reach = ((weight != 0.0).double() @ reach > 0.0).double()
    found: NDArray[np.bool_] = reach.numpy() > 0.0
    return found


def paths(pair: Pair) -> NDArray[np.bool_]:
    """Mask of the columns of state, action and outcome with a path to each outcome bit, bool [O, n_inputs + O]."""
    predictor, conditioner, codec = pair.predictor, pair.conditioner, pair.predictor.codec
    n_outputs, n_inputs = len(codec.outputs), codec.n_inputs
    reach = np.zeros((n_outputs, n_inputs + n_outputs), dtype=np.bool_)
    layers = [layer.weight.detach() for layer in (*predictor.layers, predictor.out) if isinstance(layer, Affine)]
    reach[:, :n_inputs] = _paths(layers)
    if predictor.stay is not None:
        left = predictor.stay.detach().numpy() != 0.0
        bits = np.arange(codec.n_state_columns)
        reach[bits, bits] |= left.any(axis=0)
        reach[bits, codec.n_state_columns : n_inputs] |= left.T
    if conditioner is not None and len(conditioner.members):
        weight = conditioner.groups.weight.detach()
        weight = weight if conditioner.groups.mask is None else weight * conditioner.groups.mask
        read = (conditioner.readout.detach() != 0.0).any(dim=2).double()
        grouped = (weight != 0.0).double().view(len(read), conditioner.group_size, -1)
        reach[conditioner.members.numpy()] |= torch.einsum("gh,ghc->gc", read, grouped).numpy() > 0.0
    return reach


@torch.no_grad()
def find_parents(pair: Pair, rows: Examples) -> Marks:
    """Parents of each outcome bit among state and outcome bits: int8 [O, F + O], PARENT or the non-parent's fixed value."""
    codec, rows = pair.predictor.codec, rows.spread(TABLE_ROWS)
    columns = torch.cat((codec.inputs(rows.states, rows.actions), codec.targets(rows.outcomes)), dim=1)
    usual, reach, n_bits = (columns.mean(dim=0) > 0.5).float(), paths(pair), codec.n_state_columns
    bits = np.concatenate([np.arange(n_bits), np.arange(codec.n_inputs, columns.shape[1])])
    marks = np.tile(usual.numpy().astype(np.int8)[bits], (len(reach), 1))
    sample = Sample(columns, usual, rows.weights.double() / rows.weights.sum())
    for i in range(len(reach)):
        places = np.flatnonzero(reach[i, bits])
        marks[i, places[sample.needed(pair, i, bits[places], CONSTANT_TOLERANCE / len(reach))]] = PARENT
    return marks


class Sample(NamedTuple):
    """Transitions on which differences are measured.

    Attributes:
        columns: columns of state, action and outcome, [N, n_inputs + O].
        usual: mode of each column, [n_inputs + O].
        weights: weights of the transitions, double [N], sum 1.
    """

    columns: Tensor
    usual: Tensor
    weights: Tensor

    def needed(self, pair: Pair, i: int, columns: NDArray[np.int64], tolerance: float) -> NDArray[np.int64]:
        """Indices of the parents of outcome bit i: fixing all other columns to their modes changes at most ``tolerance``."""
        known = chances(pair, self.columns, i)
        alone = np.array([self._changed(pair, i, known, columns[place : place + 1]) for place in range(len(columns))])
        order, few, many = np.argsort(alone, kind="stable"), 0, int((alone <= tolerance).sum())
        while few < many:  # bisection for the largest number of columns that can be fixed
            middle = (few + many + 1) // 2
            if self._changed(pair, i, known, columns[order[:middle]]) <= tolerance:
                few = middle
            else:
                many = middle - 1
        return order[few:]

    def _changed(self, pair: Pair, i: int, known: Tensor, columns: NDArray[np.int64]) -> float:
        """Mean absolute change of the probability of bit i if these columns are fixed to their modes."""
        differs = torch.nonzero((self.columns[:, columns] != self.usual[columns]).any(dim=1))[:, 0]
        if not len(differs):
            return 0.0
        changed = self.columns[differs]
        changed[:, columns] = self.usual[columns]
        return float(torch.dot((chances(pair, changed, i) - known[differs]).abs(), self.weights[differs]))


def tabulable(marks: Marks) -> bool:
    """Whether all outcome bits have few enough parents for a table."""
    return bool(((marks == PARENT).sum(axis=1) <= MOST_PARENTS).all())


@torch.no_grad()
def tabulate(pair: Pair, marks: Marks) -> list[Table]:
    """Tables of all outcome bits over their parents in ``marks``."""
    codec, reach = pair.predictor.codec, paths(pair)
    acts = [bool(row[codec.n_state_columns : codec.n_inputs].any()) for row in reach]
    return [_table(pair, marks[i], acts[i], i) for i in range(len(marks))]


def _table(pair: Pair, marks: Marks, acts: bool, i: int) -> Table:
    """P(bit i = 1) for each combination of its parents' values, and for each action if ``acts``."""
    codec, mine = pair.predictor.codec, np.flatnonzero(marks == PARENT)
    n_bits, n_actions, size = codec.n_state_columns, codec.n_actions, 1 << len(mine)
    fixed = torch.from_numpy(np.where(marks == PARENT, 0, marks).astype(np.float32))
    columns = torch.zeros(size * n_actions if acts else size, codec.n_inputs + len(codec.outputs))
    columns[:, :n_bits], columns[:, codec.n_inputs :] = fixed[:n_bits], fixed[n_bits:]
    number = torch.arange(len(columns))
    for power, j in enumerate(mine):
        columns[:, j if j < n_bits else j + n_actions] = (number % size >> power & 1).float()
    columns[number, n_bits + number // size] = 1.0
    table: NDArray[np.float64] = chances(pair, columns, i).numpy().reshape(-1, *(2,) * len(mine))
    return Table(tuple(mine[mine < n_bits].tolist()), tuple((mine[mine >= n_bits] - n_bits).tolist()), table)


IMPROBABLE_TOLERANCE = 0.002
"""Largest allowed error of treating improbable values as impossible, in total variation summed over variables."""


class Table(NamedTuple):
    """The truth table of one outcome bit.

    Attributes:
        states: parents among the bits of the state, in order.
        others: parents among the bits of the outcome, in order.
        chances: P(bit = 1), [1 or A, 2, ..., 2]: an axis for the action, then one for each of these bits, in reverse.
    """

    states: tuple[int, ...]
    others: tuple[int, ...]
    chances: Floats

    def simplified(self, chances: Floats) -> Table:
        """The table with ``chances`` as its probabilities, without the parents that do not affect them."""
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


def compile_rules(tables: Sequence[Table], n_actions: int, settled: bool = False) -> BitRules:
    """Combines the tables, one per outcome bit, into rules.

    Args:
        tables: the tables; probabilities close to 0 or 1 are rounded.
        n_actions: A.
        settled: whether to omit negligible values as search does, see ``settled_chance``.
    """
    least, chances, bits, copies, size = IMPROBABLE_TOLERANCE / len(tables), [np.zeros(0)], [], [], 0
    parents: list[int] = []
    for i, table in enumerate(tables):
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
    return BitRules(np.concatenate(chances), rows, np.array(parents, dtype=np.int64), fixed, n_actions)


@inlined
def _copy(state: Ints, copies: Ints, values: Ints) -> None:
    """Writes the bits that are copies."""
    for v in range(len(copies)):
        values[copies[v, 0]] = copies[v, 3] if state[copies[v, 1]] == 1 else copies[v, 2]


@inlined
def _by_state(r: int, action: int, state: Ints, bits: Ints, parents: Ints) -> tuple[int, int]:
    """For row r of ``bits``: the part of the table index due to action and state, and the stride of the next parent."""
    place, weight = bits[r, 1] + bits[r, 2] * action, 1
    for v in range(bits[r, 3], bits[r, 4]):
        place += weight * state[parents[v]]
        weight *= 2
    return place, weight


@inlined
def settled_chance(one: float) -> float:
    """A bit's probability ``one``, pruned as in ``systematic_sampling.prune``."""
    if one < NEGLIGIBLE * (1.0 - one):
        return 0.0
    if 1.0 - one < NEGLIGIBLE * one:
        return 1.0
    return one


@compiled
def sample_rules(states: Ints, actions: Ints, keys: Keys, rules: BitRules) -> tuple[Ints, NDArray[np.bool_]]:
    """Samples next states int64 [B, F], ``terminated`` bool [B]: bit i of row b uses key b's ith number, as in ``sampling``."""
    n_bits, table, bits, parents, copies = states.shape[1], rules.table, rules.bits, rules.parents, rules.copies
    drawn, ended = np.empty_like(states), np.zeros(len(states), dtype=np.bool_)
    outcome = np.zeros(n_bits + 1, dtype=np.int64)
    for b in range(len(states)):
        action, state = actions[b], states[b]
        _copy(state, copies, outcome)
        for r in range(len(bits)):
            i = bits[r, 0]
            place, weight = _by_state(r, action, state, bits, parents)
            for v in range(bits[r, 4], bits[r, 5]):
                place += weight * outcome[parents[v]]
                weight *= 2
            one = table[place]
            if one <= 0.0 or one >= 1.0:
                outcome[i] = int(one >= 1.0)
            else:
                outcome[i] = int(uniform_at(keys[b], i) >= 1.0 - one)
        drawn[b], ended[b] = outcome[:n_bits], outcome[n_bits] == 1
    return drawn, ended


class RulesWork(Struct):
    """Work space.

    Attributes:
        base: the outcome's settled bits, int64 [O]; -1 if open.
        open: the open bits, int64 [O].
        slot: index of each open bit among the open bits, int64 [O].
        p: particles.
    """

    base: Ints
    open: Ints
    slot: Ints
    p: Particles


@inlined
def _by_outcome(q: int, place: int, weight: int, v: int, end: int, parents: Ints, work: RulesWork) -> int:
    """Adds the values of parents ``v:end`` in particle q to index ``place``; the first has stride ``weight``."""
    while v < end:
        value = work.base[parents[v]]
        if value < 0:
            value = work.p.factors[q, work.slot[parents[v]]]
        place += weight * value
        weight *= 2
        v += 1
    return place


@inlined
def _write_outcomes(total: int, base: Ints, still_open: Ints, p: Particles, n_grid: int, out: Outcomes) -> int:
    """Writes the outcomes of an action with their probabilities, from index ``total``; returns their number."""
    weigh(p, n_grid)
    for i in range(n_outcomes(p)):
        slot = slot_of(p, i, n_grid)
        for w in range(len(still_open)):
            base[still_open[w]] = p.factors[slot, w]
        for f in range(len(base) - 1):
            out.states[total + i, f] = base[f]
        out.terminated[total + i] = base[len(base) - 1] == 1
        out.probabilities[total + i] = p.chances[slot, MASS]
    return n_outcomes(p)


@compiled
def rules_outcomes(k: BitRules, work: RulesWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes) -> int:
    """See ``models.kernel``."""
    table, bits, parents, base, slot = k.table, k.bits, k.parents, work.base, work.slot
    grid, total, still_open, p = (n_grid, key, offset), 0, work.open, work.p
    values = np.empty(2, dtype=np.float64)
    _copy(state, k.copies, base)
    last = len(base) - 1
    for action in range(k.n_actions):
        n_open = 0
        begin(p, n_grid, False, place_of(state))  # the open bits are not known in advance
        for r in range(len(bits)):
            i, start, end = bits[r, 0], bits[r, 4], bits[r, 5]
            place, weight = _by_state(r, action, state, bits, parents)
            shared = True
            for v in range(start, end):
                shared = shared and base[parents[v]] >= 0
            if shared:  # the same for all particles
                chance = table[_by_outcome(0, place, weight, start, end, parents, work)]
                if chance <= 0.0 or chance >= 1.0:
                    base[i] = int(chance >= 1.0)
                    continue
                bit_chances(chance, values)
            base[i], slot[i], still_open[n_open] = -1, n_open, i
            if shared:
                share_out(p, -1, i, n_open, values, 2, i == last, grid)
            n_main, n_strata = p.state[MAIN], p.state[STRATA]
            for j in range(0 if shared else n_main + n_strata):
                q = n_grid + j if j < n_strata else j - n_strata  # strata first
                bit_chances(table[_by_outcome(q, place, weight, start, end, parents, work)], values)
                share_out(p, q, i, n_open, values, 2, i == last, grid)
            n_open += 1
        out.counts[action] = _write_outcomes(total, base, still_open[:n_open], p, n_grid, out)
        out.left_out[action] = p.left[0]
        total += out.counts[action]
    return total


class BitRules(Struct):
    """Tables of all outcome bits.

    Attributes:
        table: probabilities of all tables, concatenated.
        bits: a row for each outcome bit that is not a copy, in order, int64 [R, 6]: the bit; the start of its table; the offset
            of the next action's table; the start of its parents in the state, their start in the outcome, and their end.
        parents: parents of all tables, int64.
        copies: a row for each other bit, int64 [O - R, 4]: the bit; a state bit; the bit's value if that is 0; and if 1.
        n_actions: A.
    """

    table: Floats
    bits: Ints
    parents: Ints
    copies: Ints
    n_actions: int

    outcomes = staticmethod(rules_outcomes)


@work_for.register
def rules_work(k: BitRules, n_grid: int) -> RulesWork:
    """See ``models.kernel``."""
    n_outputs = len(k.bits) + len(k.copies)
    return RulesWork(
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        new_particles(n_grid, n_outputs, 2),
    )
