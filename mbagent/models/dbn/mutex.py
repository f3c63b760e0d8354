"""Mutually exclusive bits: groups in which exactly one bit, or at most one, is on (Helmert 2009).

Groups with exactly one bit on, such as a one-hot encoded position, are found from data and become one variable (paper section
2.1), so that their bits are drawn jointly. In groups with at most one bit on, each bit keeps its own graph and rate; a single
draw selects one of the bits or "none", with the rates as probabilities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.data import Factors
from mbagent.models.dbn.arrays import Graphs
from mbagent.models.dbn.features import Layout
from mbagent.models.systematic_sampling import NEGLIGIBLE
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.jit import compiled

EXPECTED = 8.0
"""Minimum expected number of joint occurrences of two bits for which having none is significant (by chance, one in 3,000)."""

MOST_CANDIDATE_ROWS = 50_000
"""Maximum number of rows in the search for candidate groups, which are checked on all rows."""


def find_groups(
    cardinalities: Sequence[int], states: Factors, next_states: Factors, usual: Bools | None = None
) -> tuple[tuple[int, ...], ...]:
    """Groups of bits of which exactly one is on in every observed state.

    Groups are grown greedily, most frequent swaps first, from bits that were never on together and often swap (in one step, one
    is switched off and the other on).

    Args:
        cardinalities: number of values of each factor, length F.
        states: int [N, F].
        next_states: int [N, F].
        usual: bool [N], transitions in which swaps are counted (not resets, which redraw everything and may swap any bits);
            None: all.

    Returns:
        Factors of each group: at least three, in ascending order.
    """
    bits = np.flatnonzero(np.asarray(cardinalities) == 2)
    if len(bits) < 3 or len(states) == 0:
        return ()
    some = np.linspace(0, len(states) - 1, min(len(states), MOST_CANDIDATE_ROWS)).astype(np.int64)
    before, after = states[some][:, bits] == 1, next_states[some][:, bits] == 1
    kept = slice(None) if usual is None else usual[some]
    switched_on, switched_off = (after & ~before)[kept].astype(np.float32), (before & ~after)[kept].astype(np.float32)
    swaps = switched_off.T @ switched_on
    swaps += swaps.T
    on = np.concatenate([before, after]).astype(np.float32)
    exclusive = on.T @ on == 0
    np.fill_diagonal(exclusive, False)
    groups: list[tuple[int, ...]] = []
    free = np.ones(len(bits), dtype=np.bool_)
    while True:
        found = _grow(np.where(exclusive & free[:, None] & free, swaps, 0.0), exclusive, free)
        if len(found) < 2:
            return tuple(sorted(groups))
        group = np.sort(bits[found])
        if len(group) > 2 and (states[:, group].sum(axis=1) == 1).all() and (next_states[:, group].sum(axis=1) == 1).all():
            groups.append(tuple(int(f) for f in group))
            free[found] = False
        else:
            free[found[0]] = False


def find_cliques(together: NDArray[np.int64], expected: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Sets of bits of which no two were ever on together after a step, although independent bits sometimes would have been.

    Args:
        together: how often each pair of bits was on together, int64 [n, n].
        expected: how often each pair would be on together if independent, [n, n].
    """
    never = (together == 0) & (expected > EXPECTED)
    np.fill_diagonal(never, False)
    strength, cliques = np.where(never, expected, 0.0), []
    while strength.any():
        found = np.sort(_grow(strength, never, never.any(axis=0)))
        cliques.append(found)
        never[found] = never[:, found] = False
        strength[found] = strength[:, found] = 0.0
    return cliques


def _grow(swaps: NDArray[np.floating[Any]], exclusive: Bools, free: Bools) -> NDArray[np.int64]:
    """Bits of the clique grown from the strongest pair, in the order added; empty if no pair is left."""
    first, second = np.unravel_index(int(swaps.argmax()), swaps.shape)
    if swaps[first, second] == 0:
        return np.zeros(0, dtype=np.int64)
    group = [int(first), int(second)]
    candidates = exclusive[first] & exclusive[second] & free
    strength = swaps[first] + swaps[second]
    while candidates.any():
        best = int(np.where(candidates, strength, -1.0).argmax())
        if strength[best] <= 0:
            break
        group.append(best)
        candidates &= exclusive[best]
        strength = strength + swaps[best]
    return np.asarray(group, dtype=np.int64)


def widest(layout: Layout) -> int:
    """Size of the largest distribution of a variable or mutex group."""
    return int(max(layout.outputs.max(), np.diff(layout.mutex_first).max(initial=0) + 1))


@compiled
def mutex_distribution(mutex: int, state: Ints, rates: Floats, still: Bools, layout: Layout, graphs: Graphs, out: Floats) -> int:
    """Writes to ``out`` the probability that each bit of a mutex group is on, then that none is; returns the number of bits.

    ``rates`` are the distributions of all variables; ``still`` [U] marks those without graphs, whose bits keep their value in
    ``state``.
    """
    first, last = layout.mutex_first[mutex], layout.mutex_first[mutex + 1]
    n, total = last - first, 0.0
    for k in range(n):
        variable = layout.mutex_members[first + k]
        out[k] = state[layout.members[layout.first[variable]]] if still[variable] else rates[graphs.start[variable] + 1]
        total += out[k]
    none = 0.0 if layout.exactly[mutex] and total > 1e-9 else max(0.0, 1.0 - total)
    for k in range(n):
        out[k] /= total + none
    out[n] = none / (total + none)
    return int(n)


@compiled
def n_choices(mutex: int, state: Ints, rates: Floats, still: Bools, layout: Layout, graphs: Graphs) -> int:
    """Upper bound on the number of possible outcomes of a mutex group, at least 1.

    Counts one outcome for each bit that may be on, and one for "no bit is on" unless some bit is certain to be on.
    """
    possible, sure = 0, False
    for k in range(layout.mutex_first[mutex], layout.mutex_first[mutex + 1]):
        variable = layout.mutex_members[k]
        rate = float(state[layout.members[layout.first[variable]]]) if still[variable] else rates[graphs.start[variable] + 1]
        possible += int(rate > 0.0)
        sure |= rate >= 1.0
    return possible + int(not sure)


@compiled
def leave_out_none(chances: Floats, n: int) -> None:
    """Sets "none", the last of ``n`` probabilities, to 0 if negligible relative to the largest (then an error of the rates)."""
    none, top = chances[n - 1], 0.0
    for k in range(n):
        top = max(top, chances[k])
    if 0.0 < none < NEGLIGIBLE * top:
        chances[n - 1] = 0.0
        for k in range(n - 1):
            chances[k] /= 1.0 - none


@compiled
def settle(state: Ints, mutex: int, chosen: int, layout: Layout) -> None:
    """Switches the chosen bit of a mutex group on and all others off; all off if ``chosen`` is the number of bits."""
    first, last = layout.mutex_first[mutex], layout.mutex_first[mutex + 1]
    for k in range(last - first):
        state[layout.members[layout.first[layout.mutex_members[first + k]]]] = 1 if k == chosen else 0


def mutex_bits(mutex: int, layout: Layout) -> Ints:
    """Factors of a mutex group's bits, int64."""
    variables = layout.mutex_members[layout.mutex_first[mutex] : layout.mutex_first[mutex + 1]]
    result: Ints = layout.members[layout.first[variables]]
    return result


def mutex_chances(mutex: int, states: Ints, rates: Floats, still: Bools, layout: Layout, graphs: Graphs) -> Floats:
    """As ``mutex_distribution``, of states [B, F] with ``rates`` [B, sum of cardinalities]: [B, number of bits + 1]."""
    variables = layout.mutex_members[layout.mutex_first[mutex] : layout.mutex_first[mutex + 1]]
    chances = np.where(still[variables], states[:, mutex_bits(mutex, layout)], rates[:, graphs.start[variables] + 1])
    total = np.zeros(len(states))
    for column in chances.T:
        total += column
    none = np.where(layout.exactly[mutex] & (total > 1e-9), 0.0, np.maximum(0.0, 1.0 - total))
    result: Floats = np.concatenate([chances, none[:, None]], axis=1) / (total + none)[:, None]
    return result
