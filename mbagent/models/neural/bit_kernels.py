"""Predictor and causal conditioner of binary variables in compiled search, evaluated for all actions of a state.

The first layers' sums over the state are shared by all actions. Bits of which the predictor is certain are determined by its
logits; only the others are conditioned, for each particle (see ``systematic_sampling.py``). Sums have another order than in
``kernels.py``, and the exponential is exact to single precision, so results are equal up to rounding.
Shapes: F bits of a state, O = F + 1 of an outcome (``terminated`` last), C >= O columns, A actions, H hidden nodes of the
predictor, g groups of G hidden nodes in the conditioner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mbagent.models.neural.kernels import RELU, SIGMOID, TANH, DenseWeights, Floats32, GroupWeights, Layout
from mbagent.models.overloads import Outcomes, implements, outcomes, work_for
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
from mbagent.types import Ints
from mbagent_envs.jit import compiled, inlined

BIT_LANES = 16
"""Columns are padded to a multiple of this number, for vector instructions."""

_LOG2E, _BIT_LN2_HIGH, _BIT_LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_ROUND = np.float32(12582912.0)  # 1.5 * 2**23: adding it rounds a small number to an integer
_C5, _C4, _C3 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
_C2, _C1, _C0 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)
_BIT_ONE, _BIT_TWO, _MOST = np.float32(1.0), np.float32(2.0), np.float32(80.0)


class CausalBits(NamedTuple):
    """The networks' weights, [from, to].

    Attributes:
        first: from state bits and actions to hidden nodes, [F + A, H].
        bias: [H].
        last: from hidden nodes to the outcome's bits, [H, C].
        last_bias: [C].
        stay: weights of the residual path, [A, C].
        activation: code of the activation of all hidden nodes; see ``kernels``.
        group_of: group of each outcome bit, -1 if it has none, int64 [O].
        inputs: from state bits and actions to the groups, [F + A, g, G].
        others: from outcome bits to the groups, zero where pruned, [g, O, G].
        group_bias: [g, G].
        readout: [g, G].
        offset: [g].
        correction: whether the predictor's logits are added to the conditioner's.
        certain: a bit whose logit has at least this absolute value is sampled from the predictor.
    """

    first: Floats32
    bias: Floats32
    last: Floats32
    last_bias: Floats32
    stay: Floats32
    activation: int
    group_of: Ints
    inputs: Floats32
    others: Floats32
    group_bias: Floats32
    readout: Floats32
    offset: Floats32
    correction: bool
    certain: float


def pack_bits(dense: DenseWeights, group: GroupWeights, layout: Layout, certain: float) -> CausalBits | None:
    """The kernel of packed networks; None if they are not supported.

    Supported are states of bits, one hidden layer, and actions of a single step.
    """
    if (layout.outputs != 2).any() or len(dense.sizes) != 1 or layout.n_steps != 1:
        return None
    n_outputs = len(layout.outputs)
    more = -n_outputs % BIT_LANES
    p = min(max(certain, 0.5), 1.0)
    return CausalBits(
        first=dense.first,
        bias=np.ascontiguousarray(dense.bias[0]),
        last=np.ascontiguousarray(np.pad(dense.last, ((0, 0), (0, more)))),
        last_bias=np.pad(dense.last_bias, (0, more)),
        stay=np.ascontiguousarray(np.pad(dense.stay, ((0, 0), (0, 1 + more)))),
        activation=dense.activation,
        group_of=group.group_of,
        inputs=np.ascontiguousarray(group.inputs.transpose(1, 0, 2)),
        others=group.others,
        group_bias=group.bias,
        readout=np.ascontiguousarray(group.readout[:, :, 1]),
        offset=np.ascontiguousarray(group.offset[:, 1]),
        correction=group.correction,
        certain=math.log(p / (1.0 - p)) if p < 1.0 else math.inf,
    )


@inlined
def _exp(x: np.float32) -> np.float32:
    """exp(x) for -80 <= x <= 80, written so that loops over it can be vectorised (Moshier's Cephes, expf)."""
    shifted = x * _LOG2E + _ROUND
    whole = shifted - _ROUND
    rest = x - whole * _BIT_LN2_HIGH - whole * _BIT_LN2_LOW
    tail = ((((_C5 * rest + _C4) * rest + _C3) * rest + _C2) * rest + _C1) * rest + _C0
    power = np.int32((np.int32(whole) + 127) << 23)
    return (tail * rest * rest + rest + _BIT_ONE) * power.view(np.float32)


@inlined
def _gate(x: np.float32) -> np.float32:
    """The logistic function. ``np.divide`` does not check for division by 0, a check that would prevent vectorisation."""
    gate: np.float32 = np.divide(_BIT_ONE, _BIT_ONE + _exp(min(max(-x, -_MOST), _MOST)))
    return gate


@inlined
def activate(values: Floats32, code: int) -> None:
    """Applies an activation to all of ``values``, in place."""
    if code == RELU:
        for h in range(len(values)):
            values[h] = max(values[h], np.float32(0.0))
    elif code == TANH:
        for h in range(len(values)):
            values[h] = _BIT_TWO * _gate(_BIT_TWO * values[h]) - _BIT_ONE
    elif code == SIGMOID:
        for h in range(len(values)):
            values[h] = _gate(values[h])
    else:
        for h in range(len(values)):
            values[h] *= _gate(values[h])


@inlined
def predict(
    action: int,
    n_bits: int,
    on: Ints,
    sums: Floats32,
    first: Floats32,
    last: Floats32,
    last_bias: Floats32,
    stay: Floats32,
    code: int,
    hidden: Floats32,
    logits: Floats32,
) -> None:
    """Writes the predictor's logits [C] for an action, given the state's contribution ``sums`` to the first layer."""
    for h in range(len(hidden)):
        hidden[h] = sums[h] + first[n_bits + action, h]
    activate(hidden, code)
    for c in range(len(logits)):
        logits[c] = last_bias[c] - stay[action, c]
    for bit in on:
        logits[bit] += _BIT_TWO * stay[action, bit]
    h = 0
    while h + 4 <= len(hidden):
        v0, v1, v2, v3 = hidden[h], hidden[h + 1], hidden[h + 2], hidden[h + 3]
        for c in range(len(logits)):
            logits[c] += (v0 * last[h, c] + v1 * last[h + 1, c]) + (v2 * last[h + 2, c] + v3 * last[h + 3, c])
        h += 4
    while h < len(hidden):
        for c in range(len(logits)):
            logits[c] += hidden[h] * last[h, c]
        h += 1


@inlined
def known_sum(
    g: int,
    action: int,
    n_bits: int,
    on: Ints,
    shown: Ints,
    inputs: Floats32,
    others: Floats32,
    group_bias: Floats32,
    state_sums: Floats32,
    ready: Ints,
    known: Floats32,
) -> None:
    """Writes a group's input from state, action and settled outcome bits; bits hidden from it have weight 0."""
    if ready[g] == 0:
        for h in range(len(known)):
            state_sums[g, h] = group_bias[g, h]
        for bit in on:
            for h in range(len(known)):
                state_sums[g, h] += inputs[bit, g, h]
        ready[g] = 1
    for h in range(len(known)):
        known[h] = state_sums[g, h] + inputs[n_bits + action, g, h]
    for bit in shown:
        for h in range(len(known)):
            known[h] += others[g, bit, h]


@inlined
def condition(
    q: int,
    w: int,
    g: int,
    logit: float,
    still_open: Ints,
    others: Floats32,
    readout: Floats32,
    offsets: Floats32,
    code: int,
    known: Floats32,
    group: Floats32,
    factors: Ints,
) -> float:
    """The logit of open bit w by its group g, given the earlier open bits of particle q."""
    size = len(known)
    for h in range(size):
        group[h] = known[h]
    for v in range(w):
        if factors[q, v] == 1:
            for h in range(size):
                group[h] += others[g, still_open[v], h]
    activate(group, code)
    s0 = s1 = s2 = s3 = np.float32(0.0)  # four independent sums, for instruction-level parallelism
    for h in range(0, size - 3, 4):
        s0 += group[h] * readout[g, h]
        s1 += group[h + 1] * readout[g, h + 1]
        s2 += group[h + 2] * readout[g, h + 2]
        s3 += group[h + 3] * readout[g, h + 3]
    for h in range(size // 4 * 4, size):
        s0 += group[h] * readout[g, h]
    return logit + np.float64(offsets[g] + ((s0 + s1) + (s2 + s3)))


CERTAIN_LOGIT = math.log(1.0 / NEGLIGIBLE)
"""If a bit's logit has a larger absolute value, its less likely value has negligible probability."""


class BitsWork(NamedTuple):
    """Work space.

    Attributes:
        on: state bits that are 1, int64 [F].
        sums: the state's contribution to the first layer, [H].
        hidden: [H].
        logits: the predictor's, [C].
        state_sums: the state's contribution to each group, [g, G].
        ready: whether it has been computed, int64 [g].
        known: the part of a group's input that all particles share, [G].
        group: its hidden nodes, [G].
        base: the outcome without its open bits, int64 [O].
        open: bits that are not settled, int64 [O].
        shown: settled outcome bits that are 1, int64 [O].
        p: particles.
    """

    on: Ints
    sums: Floats32
    hidden: Floats32
    logits: Floats32
    state_sums: Floats32
    ready: Ints
    known: Floats32
    group: Floats32
    base: Ints
    open: Ints
    shown: Ints
    p: Particles


@implements(work_for, CausalBits)
@compiled
def bits_work(k: CausalBits, n_grid: int) -> BitsWork:
    """See ``models.overloads``."""
    n_outputs, n_hidden = len(k.group_of), len(k.bias)
    n_groups, size = k.group_bias.shape
    return BitsWork(
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_hidden, dtype=np.float32),
        np.empty(n_hidden, dtype=np.float32),
        np.empty(len(k.last_bias), dtype=np.float32),
        np.empty((n_groups, size), dtype=np.float32),
        np.empty(n_groups, dtype=np.int64),
        np.empty(size, dtype=np.float32),
        np.empty(size, dtype=np.float32),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        np.empty(n_outputs, dtype=np.int64),
        new_particles(n_grid, n_outputs, 2),
    )


@inlined
def _chance(logit: float) -> float:
    """Probability of a bit, pruned as by ``systematic_sampling.prune``."""
    if logit > CERTAIN_LOGIT:
        return 1.0
    if logit < -CERTAIN_LOGIT:
        return 0.0
    return 1.0 / (1.0 + math.exp(-logit))


@inlined
def settled_chance(one: float) -> float:
    """Probability ``one`` of a bit, pruned as by ``systematic_sampling.prune``."""
    if one < NEGLIGIBLE * (1.0 - one):
        return 0.0
    if 1.0 - one < NEGLIGIBLE * one:
        return 1.0
    return one


@inlined
def _settle(logits: Floats32, group_of: Ints, certain: float, base: Ints, still_open: Ints, shown: Ints) -> tuple[int, int]:
    """Writes the settled bits to ``base``; returns the number of open bits, and of settled bits that are 1."""
    n_open, n_shown = 0, 0
    for i in range(len(base)):
        distance = abs(np.float64(logits[i]))
        if distance > CERTAIN_LOGIT and (group_of[i] < 0 or distance >= certain):
            base[i] = int(logits[i] > 0.0)
            if logits[i] > 0.0:
                shown[n_shown] = i
                n_shown += 1
        else:
            base[i] = -1
            still_open[n_open] = i
            n_open += 1
    return n_open, n_shown


@inlined
def write_outcomes(total: int, base: Ints, still_open: Ints, p: Particles, n_grid: int, out: Outcomes) -> int:
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


@implements(outcomes, CausalBits)
@compiled
def bits_outcomes(k: CausalBits, work: BitsWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes) -> int:
    """See ``models.overloads``."""
    grid, total, n_on, n_bits, n_actions = (n_grid, key, offset), 0, 0, len(state), len(k.stay)
    first, last, last_bias, stay = k.first, k.last, k.last_bias, k.stay
    group_of, inputs, others, group_bias = k.group_of, k.inputs, k.others, k.group_bias
    readout, offsets, certain = k.readout, k.offset, k.certain
    on, sums, hidden, logits = work.on, work.sums, work.hidden, work.logits
    state_sums, ready, known, group = work.state_sums, work.ready, work.known, work.group
    base, still_open, shown, p = work.base, work.open, work.shown, work.p
    values = np.empty(2, dtype=np.float64)
    for h in range(len(sums)):
        sums[h] = k.bias[h]
    for bit in range(n_bits):
        if state[bit] == 1:
            on[n_on] = bit
            n_on += 1
            for h in range(len(sums)):
                sums[h] += first[bit, h]
    ready[:] = 0
    for action in range(n_actions):
        predict(action, n_bits, on[:n_on], sums, first, last, last_bias, stay, k.activation, hidden, logits)
        n_open, n_shown = _settle(logits, group_of, certain, base, still_open, shown)
        begin(p, n_grid, n_open < 62 and 1 << n_open <= n_grid, place_of(state))
        for w in range(n_open):
            i = still_open[w]
            g, logit = group_of[i], float(logits[i])
            trusted, prior = g < 0 or abs(logit) >= certain, logit if k.correction else 0.0
            if trusted:
                bit_chances(_chance(logit), values)
                share_out(p, -1, i, w, values, 2, i == n_bits, grid)
                continue
            known_sum(g, action, n_bits, on[:n_on], shown[:n_shown], inputs, others, group_bias, state_sums, ready, known)
            n_main, n_strata = p.state[MAIN], p.state[STRATA]
            for j in range(n_main + n_strata):
                slot = n_grid + j if j < n_strata else j - n_strata  # strata first
                logit = condition(slot, w, g, prior, still_open, others, readout, offsets, k.activation, known, group, p.factors)
                bit_chances(_chance(logit), values)
                share_out(p, slot, i, w, values, 2, i == n_bits, grid)
        out.counts[action] = write_outcomes(total, base, still_open[:n_open], p, n_grid, out)
        out.left_out[action] = p.left[0]
        total += out.counts[action]
    return total
