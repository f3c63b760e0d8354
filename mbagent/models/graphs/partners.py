"""What a factor's value is summed with: the action's number, that of a part of the action, or another factor's value.

Stock plus order minus demand; two products with an order each; stock plus what arrives today, which was ordered before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.acts import act_columns
from mbagent.models.graphs.habits import Habit
from mbagent.models.graphs.units import Layout
from mbagent.models.memory import thinned
from mbagent.transitions import TransitionBatch

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]

SURE = 5.0
"""Standard errors by which the slope of a partner must differ from zero."""

MOST_LOOKED_AT = 5000
"""Rows that are looked at."""

MOST_CANDIDATES = 200
"""Ordered factors and parts of actions; where there are more, no partners are looked for."""

MOST_ENTRIES = 50_000
"""Nodes that a sum with a partner may take: its values times the factor's, times how many steps from the sum that ends."""


@dataclass(frozen=True)
class Partner:
    """A factor, the action, or a part of it.

    Attributes:
        cardinality: number of its values.
        factor: number of the factor, or -1.
        stride: of the action's part: it is ``action // stride % cardinality``.
        column: number of the part's first column among those of actions.
        whole: whether it is the action, which is one thing.
    """

    cardinality: int
    factor: int = -1
    stride: int = 1
    column: int = 0
    whole: bool = False

    def of(self, rows: TransitionBatch) -> Ints:
        """Its value in each row, int64 [N]."""
        found = rows.before[:, self.factor] if self.factor >= 0 else rows.actions // self.stride % self.cardinality
        return np.asarray(found, dtype=np.int64)

    def columns(self, layout: Layout) -> Ints:
        """The column that is on where it has each value, int64 [cardinality]."""
        if self.factor >= 0:
            own = (layout.factor == self.factor) & (layout.value == layout.top)
            return np.flatnonzero(own)[np.argsort(layout.value[own])]
        return len(layout.factor) + self.column + np.arange(self.cardinality)


def candidates(cardinalities: Sequence[int], parts: Sequence[int]) -> list[Partner]:
    """All factors with an order, and all parts of the action that have one; what is on or off has none."""
    factors = [Partner(n, factor=f) for f, n in enumerate(cardinalities) if n > 2]
    columns = enumerate(act_columns(parts))
    return factors + [Partner(n, -1, stride, i, len(parts) == 1) for i, (stride, n, value) in columns if n > 2 and value == 0]


def likely_partners(factors: Sequence[int], among: Sequence[Partner], rows: TransitionBatch) -> list[tuple[Partner, int] | None]:
    """For each factor the partner that its change most surely rises (1) or falls (-1) with; None if with none.

    All other candidates are held constant: least squares, with t statistics.

    Args:
        factors: numbers of factors that are among the candidates themselves.
        among: the candidates.
        rows: N transitions.
    """
    some = thinned(rows, MOST_LOOKED_AT)
    if len(among) > MOST_CANDIDATES or len(some) < 2 * len(among) + 10:
        return [None] * len(factors)
    x = np.stack([partner.of(some) for partner in among], axis=1).astype(np.float64)
    x -= x.mean(axis=0)
    change = some.after[:, factors].astype(np.float64) - some.before[:, factors]
    change -= change.mean(axis=0)
    inverse = np.linalg.pinv(x.T @ x)
    slopes = inverse @ (x.T @ change)
    left = ((change - x @ slopes) ** 2).sum(axis=0) / (len(some) - len(among) - 1)
    t = slopes / np.sqrt(np.outer(np.diag(inverse), left) + 1e-12)
    found: list[tuple[Partner, int] | None] = []
    for i, factor in enumerate(factors):
        own = [partner.factor == factor for partner in among]
        t[own, i] = 0.0
        best = int(np.abs(t[:, i]).argmax())
        likely = (among[best], int(np.sign(t[best, i]))) if abs(t[best, i]) > SURE else None
        found.append(likely if likely and _entries(*likely, among[own.index(True)], some) <= MOST_ENTRIES else None)
    return found


def _entries(partner: Partner, sign: int, factor: Partner, rows: TransitionBatch) -> int:
    """Number of nodes that a factor's sum with its partner takes, at most; with the action none."""
    far = rows.after[:, factor.factor].astype(np.int64) - factor.of(rows) - sign * partner.of(rows)
    return factor.cardinality * partner.cardinality * (len(np.unique(far)) + 2) * (not partner.whole)


def chained(entries: Ints, columns: Ints, add: Callable[[int, int, int], int], zero: int) -> Ints:
    """One node for each (present value, value) that leads on by the partner's value.

    Args:
        entries: (partner's value, present value, value, node), int64 [N, 4].
        columns: the partner's.
        add: adds a node (column, off, on) and returns its number.
        zero: node for the partner's values of which there is no entry.

    Returns:
        (present value, value, node) of each, int64 [M, 3].
    """
    found: dict[tuple[int, int], int] = {}
    for partner, now, value, node in entries.tolist():
        found[now, value] = add(int(columns[partner]), found.get((now, value), zero), node)
    return np.asarray([(now, value, node) for (now, value), node in found.items()], dtype=np.int64).reshape(-1, 3)


def for_all_ways(habit: Habit, n_partner: int, n_ways: int) -> Habit:
    """A habit by pairs (partner's value, value), as one by pairs (way, value)."""
    stays, novelty = (np.tile(array.reshape(n_partner, -1).max(axis=0), n_ways) for array in (habit.stays, habit.novelty))
    return replace(habit, stays=stays, novelty=novelty)
