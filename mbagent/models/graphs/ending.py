"""Whether an episode ends, where that hangs on what comes: the one thing that lean graphs draw late.

Its graph asks for columns of the state, and of the next state; those of the next state are looked at only when asked for.
Shapes: W ways of actions, D columns of the state, D' of them single factors, M meetings in the next state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.graphs.compiled import Bools, Floats, Graphs, Ints, meets, without_noise
from mbagent.models.graphs.units import Layout
from mbagent.models.particles import NEGLIGIBLE
from mbagent_envs._compiled import inlined


def ends_late_only(layout: Layout, late: Graphs) -> bool:
    """Whether nothing is drawn late but the end."""
    return bool((late.changing == len(layout.outputs) - 2).all())


def end_graph(layout: Layout, late: Graphs) -> tuple[Ints, NDArray[np.int32], Floats]:
    """The graph of the end: first node of each way, -1 where it never came, [W]; nodes (column, off, on) and their rates.

    Nothing where the end is not drawn late.
    """
    if len(late.changing) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.int32), np.zeros(0)
    first = np.full(layout.acts.n_ways, -1, dtype=np.int64)
    for way in range(layout.acts.n_ways):
        pair = late.pairs[len(layout.outputs) - 2] + 2 * way
        if late.entries[pair + 1] > late.entries[pair]:
            first[way] = late.nodes[late.entries[pair]]
    rates = [without_noise(rate, spread, 2, NEGLIGIBLE) for rate, spread in zip(late.rate, late.spread, strict=True)]
    return first, np.stack([late.column, late.off, late.on], axis=1).astype(np.int32), np.asarray(rates, dtype=np.float64)


@inlined
def end_rate(
    node: int,
    nodes: NDArray[np.int32],
    rate: Floats,
    otherwise: float,
    following: Ints,
    on: Bools,
    factor: Ints,
    columns: Ints,
    cells: Ints,
    next_meetings: Ints,
) -> float:
    """Probability that the episode ends with this next state [F]; ``on`` are the columns of the state before, [D]."""
    if node < 0:
        return otherwise
    while nodes[node, 0] >= 0:
        column = nodes[node, 0]
        if column < len(on):
            asked = on[column]
        elif column < len(on) + len(factor):
            c = column - len(on)
            asked = columns[c, 0] <= following[factor[c]] <= columns[c, 1]
        else:
            asked = meets(following, cells, next_meetings[column - len(on) - len(factor)])
        node = nodes[node, 2] if asked else nodes[node, 1]
    return float(rate[node])
