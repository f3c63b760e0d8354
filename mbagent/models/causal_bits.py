"""Predictor and causal conditioner of a world of bits inside compiled search: the draws of ``systematic.causal_successors``.

The predictor's sure bits are told by their logits alone; only the others are conditioned, particle after particle (see
``particles.py``; shapes as in ``bit_networks.py``). The outcomes are the same but for rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mbagent.models.arithmetic import Floats32, Ints
from mbagent.models.bit_networks import CausalBits, condition, known_sum, predict
from mbagent.models.compiled_model import Outcomes, implements, outcomes, work_for
from mbagent.models.particles import (
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
from mbagent_envs._compiled import compiled, inlined

SETTLED = math.log(1.0 / NEGLIGIBLE)
"""A bit whose logit is further from 0 has only one value worth drawing."""


class BitsWork(NamedTuple):
    """Work space.

    Attributes:
        on: state bits that are 1, int64 [F].
        sums: what the state gives to the first layer, [H].
        hidden: [H].
        logits: the predictor's, [C].
        state_sums: what the state gives to each group, [g, G].
        ready: whether it is there, int64 [g].
        known: what a group gets whatever the particle, [G].
        group: its hidden nodes, [G].
        base: the outcome but for its open bits, int64 [O].
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
    """See compiled_model."""
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
    """Probability of a bit, pruned as ``particles.prune`` does."""
    if logit > SETTLED:
        return 1.0
    if logit < -SETTLED:
        return 0.0
    return 1.0 / (1.0 + math.exp(-logit))


@inlined
def settled_chance(one: float) -> float:
    """Probability ``one`` of a bit, pruned as ``particles.prune`` does."""
    if one < NEGLIGIBLE * (1.0 - one):
        return 0.0
    if 1.0 - one < NEGLIGIBLE * one:
        return 1.0
    return one


@inlined
def _settle(logits: Floats32, group_of: Ints, certain: float, base: Ints, still_open: Ints, shown: Ints) -> tuple[int, int]:
    """Writes the settled bits to ``base``; returns how many are open, and how many of the settled ones are 1."""
    n_open, n_shown = 0, 0
    for i in range(len(base)):
        distance = abs(np.float64(logits[i]))
        if distance > SETTLED and (group_of[i] < 0 or distance >= certain):
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
    """Writes the outcomes of an action from number ``total`` on, with their probabilities; returns their number."""
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
    """See compiled_model."""
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
