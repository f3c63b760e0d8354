"""Variables that depend on each other beyond what the present says: asked again, given what earlier ones became.

The paper's conditioner (section 3.2) resamples every variable given all others. Here only those are asked again whose
errors go together with another's, and, like the causal mask, output i sees y_<i alone, so that probabilities stay exact.
Whether an episode ended is asked last of all: it mostly hangs on where the step led.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, ndtr

from mbagent.models.graphs import draws
from mbagent.models.graphs.compiled import Graphs
from mbagent.models.graphs.units import Layout, shown
from mbagent.transitions import TransitionBatch

Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Floats: TypeAlias = NDArray[np.float64]

UNCERTAIN = 2.0
"""Variance summed over all rows from which a column counts as uncertain."""

MANY = 8.0
"""Products of two columns' variances summed over all rows from which the sum of their errors' products is about normal."""

APART = 6.0
"""Standard errors that two columns' errors must go together by, beyond what the largest of so many reaches by chance."""

MOST_ENTRIES = 4_000_000
"""Entries of the table of errors; of more rows, evenly chosen ones are looked at."""


AT_ONCE = 2000
"""Rows that are handed to the compiled kernels at once, which read wide integers."""


def uncertain_rows(rows: TransitionBatch, layout: Layout, graphs: Graphs, units: Ints) -> Bools:
    """In which rows some units need their late graphs, bool [N, len(units)]."""
    found = [draws.uncertain(part.states, part.actions, layout, graphs, units) for part in rows.parts(AT_ONCE)]
    return np.concatenate([np.zeros((0, len(units)), dtype=np.bool_), *found])


class Asked(NamedTuple):
    """What a unit is asked again with.

    Attributes:
        unit: its number.
        columns: columns of the next state, numbered as those of the state.
    """

    unit: int
    columns: Ints


def probabilities(layout: Layout, graphs: Graphs, rows: TransitionBatch) -> Floats:
    """Probability of each state column after each row, each for itself, [N, D']."""
    sizes = np.full(layout.n_factors, 2, dtype=np.int64)
    np.maximum.at(sizes, layout.factor, layout.top + 1)
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    probs = np.empty((len(rows), int(start[-1])))
    draws.marginals(rows.states, rows.actions, layout, graphs, start, probs)
    total = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(probs, axis=1)], axis=1)
    result: Floats = total[:, start[layout.factor] + layout.top + 1] - total[:, start[layout.factor] + layout.value]
    return result.clip(0.0, 1.0)


def go_together(error: Floats, other: Floats, spread: Floats, other_spread: Floats, n_tried: int) -> bool:
    """Whether two columns' errors [...] go together, given their variances [...], one of ``n_tried`` such questions."""
    one, two, three, four = (part.reshape(-1, 1) for part in (error, other, spread, other_spread))
    return bool(_telling(one, two, three, four, n_tried)[0, 0])


def _telling(error: Floats, other: Floats, spread: Floats, other_spread: Floats, n_tried: int) -> Bools:
    """Which columns' errors go together, bool [D, E], from errors and variances [N, D] and [N, E].

    Of many by the sum of products of errors; of rare values by how often both came unexpectedly in the same row, which by
    chance has a Poisson distribution.
    """
    limit = APART + np.sqrt(2.0 * np.log(max(n_tried, 2)))
    products, variances = error.T @ other, spread.T @ other_spread
    result: Bools = (variances > MANY) & (np.abs(products) > limit * np.sqrt(variances))
    few = variances <= MANY
    if few.any():
        both = _unexpected(error).T @ _unexpected(other)
        expected = _least(spread).T @ _least(other_spread)
        result |= few & (both > 0.0) & (gammainc(np.maximum(both, 1.0), expected) < ndtr(-limit))  # P(Poisson >= both)
    return result


def _unexpected(error: Floats) -> Floats:
    """1 where what came was the less probable, else 0."""
    result: Floats = (np.abs(error) > 0.5).astype(np.float64)
    return result


def _least(spread: Floats) -> Floats:
    """Probability of the less probable of two values, of the variance."""
    result: Floats = 0.5 - np.sqrt(np.maximum(0.25 - spread, 0.0))
    return result


def find_dependent(layout: Layout, graphs: Graphs, rows: TransitionBatch, usual: Ints) -> list[Asked]:
    """Units to be asked again, in order, with what; ``terminated`` last, with all that changes.

    Args:
        layout: the units, with their couplings.
        graphs: of each for itself.
        rows: N transitions.
        usual: those that are no rare events, int64 [R].
    """
    n_columns, last = len(layout.factor), len(layout.outputs) - 2
    unit_of = np.empty(layout.n_factors, dtype=np.int64)
    unit_of[layout.members] = np.repeat(np.arange(len(layout.outputs)), np.diff(layout.first))
    owner = unit_of[layout.factor]
    most = max(1000, MOST_ENTRIES // max(n_columns, 1))
    some = rows.select(usual[np.linspace(0, len(usual) - 1, min(len(usual), most)).astype(np.int64)])
    found = [Asked(unit, columns) for unit, columns in _dependent(layout, graphs, some, owner).items()]
    if last in graphs.changing:
        found.append(Asked(last, np.flatnonzero(np.isin(owner, graphs.changing))))
    return found


def _dependent(layout: Layout, graphs: Graphs, rows: TransitionBatch, owner: Ints) -> Mapping[int, Ints]:
    """Columns of earlier units whose errors go with those of a unit, by unit in ascending order."""
    if len(rows) == 0 or len(owner) == 0:
        return {}
    probs = probabilities(layout, graphs, rows)
    spread = probs * (1.0 - probs)
    uncertain = np.flatnonzero(spread.sum(axis=0) > UNCERTAIN)
    error = shown(layout, rows.after, uncertain) - probs[:, uncertain]
    telling = np.zeros((len(uncertain), len(uncertain)), dtype=np.bool_)
    for action in np.unique(rows.actions):  # what goes together under one action may go apart under another
        e, v = error[rows.actions == action], spread[rows.actions == action][:, uncertain]
        telling |= _telling(e, e, v, v, len(uncertain))
    unit, coupling = owner[uncertain], layout.coupling_of[owner[uncertain]]
    earlier = unit[:, None] < unit
    together = (coupling[:, None] == coupling) & (coupling >= 0)
    goes = earlier & ~together & (coupling < 0) & telling
    return {
        int(u): uncertain[goes[:, unit == u].any(axis=1)] for u in np.unique(unit[goes.any(axis=0)]) if goes[:, unit == u].any()
    }
