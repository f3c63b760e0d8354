"""Bits of which exactly one is on: a position, a phase, a target. Together they are one variable (paper section 2.1).

Such bits cannot be predicted one by one: a player drawn by thirty-six separate coins is in two places or in none. As
the values of one unit they are drawn jointly, and what the values have in common is learned once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Bools
from mbagent.transitions import Factors

EXPECTED = 8.0
"""Two bits must have been expected together this often before "never" is believed: else it may be chance, one in 3,000."""

MOST_ROWS = 50_000
"""Rows that candidates are looked for in; what is found is checked on all."""


def find_groups(
    cardinalities: Sequence[int], states: Factors, next_states: Factors, usual: Bools | None = None
) -> tuple[tuple[int, ...], ...]:
    """Groups of bits of which exactly one is on in every state met.

    Bits that were never on together, and that are often swapped (one goes out in the step in which the other comes
    on), are gathered greedily, the most swapped first.

    Args:
        cardinalities: number of values of each factor, length F.
        states: int [N, F].
        next_states: int [N, F].
        usual: bool [N], transitions to look for swaps in (rare events, which redraw all, swap anything); None: all.

    Returns:
        Factors of each group, ascending, three or more.
    """
    bits = np.flatnonzero(np.asarray(cardinalities) == 2)
    if len(bits) < 3 or len(states) == 0:
        return ()
    some = np.linspace(0, len(states) - 1, min(len(states), MOST_ROWS)).astype(np.int64)
    before, after = states[some][:, bits] == 1, next_states[some][:, bits] == 1
    kept = slice(None) if usual is None else usual[some]
    came, went = (after & ~before)[kept].astype(np.float32), (before & ~after)[kept].astype(np.float32)
    swaps = went.T @ came
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
    """Sets of bits of which no two were ever on together after a step though they should have been, were each for itself.

    Args:
        together: how often two bits were on together, int64 [n, n].
        expected: how often they should have been by their own probabilities, [n, n].
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
    """The clique around the strongest swap, in the order found; nothing where there is no swap left."""
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
