"""Bits of which at most one is on after a step: their rates become the chances of one draw, compiled.

A bit's rate is what its own graph says of it alone. Where one bit at most can be on, those rates are the probabilities of
one draw among the bits and "none"; where exactly one is on, they are scaled to leave nothing for "none".
"""

from __future__ import annotations

from mbagent.models.graphs.compiled import Bools, Floats, Graphs, Ints
from mbagent.models.graphs.units import Layout
from mbagent.models.particles import NEGLIGIBLE
from mbagent_envs._compiled import compiled


@compiled
def widest(layout: Layout) -> int:
    """Room that the distribution of any unit or coupling needs."""
    room = layout.outputs.max()
    for q in range(len(layout.exactly)):
        room = max(room, layout.coupled_first[q + 1] - layout.coupled_first[q] + 1)
    return int(room)


@compiled
def couple(coupling: int, state: Ints, rates: Floats, still: Bools, layout: Layout, graphs: Graphs, out: Floats) -> int:
    """Writes the probability of each bit of a coupling, and of none, to ``out``; returns how many bits there are.

    ``rates`` are all units' distributions; a bit that is ``still`` [U], without graphs, is as sure as it is in ``state``.
    """
    first, last = layout.coupled_first[coupling], layout.coupled_first[coupling + 1]
    n, total = last - first, 0.0
    for k in range(n):
        unit = layout.coupled[first + k]
        out[k] = state[layout.members[layout.first[unit]]] if still[unit] else rates[graphs.start[unit] + 1]
        total += out[k]
    none = 0.0 if layout.exactly[coupling] and total > 1e-9 else max(0.0, 1.0 - total)
    for k in range(n):
        out[k] /= total + none
    out[n] = none / (total + none)
    return int(n)


@compiled
def n_choices(coupling: int, state: Ints, rates: Floats, still: Bools, layout: Layout, graphs: Graphs) -> int:
    """How many bits of a coupling may be on, and one more for none, unless a bit is sure to be on; at least 1."""
    possible, sure = 0, False
    for k in range(layout.coupled_first[coupling], layout.coupled_first[coupling + 1]):
        unit = layout.coupled[k]
        rate = float(state[layout.members[layout.first[unit]]]) if still[unit] else rates[graphs.start[unit] + 1]
        possible += int(rate > 0.0)
        sure |= rate >= 1.0
    return possible + int(not sure)


@compiled
def leave_out_none(chances: Floats, n: int) -> None:
    """Takes "none", the last of ``n`` chances, for an error of the bits' rates where it is negligible beside the likeliest."""
    none, top = chances[n - 1], chances[:n].max()
    if 0.0 < none < NEGLIGIBLE * top:
        chances[n - 1] = 0.0
        for k in range(n - 1):
            chances[k] /= 1.0 - none


@compiled
def settle(state: Ints, coupling: int, chosen: int, layout: Layout) -> None:
    """Switches the chosen bit of a coupling on and all others off; none where ``chosen`` is their number."""
    first, last = layout.coupled_first[coupling], layout.coupled_first[coupling + 1]
    for k in range(last - first):
        state[layout.members[layout.first[layout.coupled[first + k]]]] = 1 if k == chosen else 0


@compiled
def which(state: Ints, coupling: int, layout: Layout) -> int:
    """Which bit of a coupling is on; their number if none is, -1 if several are."""
    first, last = layout.coupled_first[coupling], layout.coupled_first[coupling + 1]
    found = last - first
    for k in range(last - first):
        if state[layout.members[layout.first[layout.coupled[first + k]]]] == 1:
            if found < last - first:
                return -1
            found = k
    return int(found)
