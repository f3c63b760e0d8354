"""Decision graphs for planes: one graph for each channel, learned from all positions at once, good for boards of any size."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import FitReport, Floats
from mbagent.models.graphs.arrays import from_arrays, to_arrays
from mbagent.models.graphs.compiled import Graphs, build, habit_of
from mbagent.models.graphs.evidence import Ints
from mbagent.models.graphs.fitting import Fitted, nothing_late
from mbagent.models.graphs.greedy import find_splits
from mbagent.models.graphs.instantiate import COLUMN, ROW, WHOLE, Coupling, LocalGraphs, instantiate
from mbagent.models.graphs.model import DecisionGraphModel
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import Question, ask, lay_out
from mbagent.models.graphs.windows import ACTION, MEETING, column_kinds, column_values, relative_columns
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.transitions import TransitionBatch, TransitionDataset

MOST_CELLS = 200_000_000
"""Entries of the table of columns that the search reads; of more transitions than that, evenly chosen ones are searched."""

TOGETHER = 12.0
"""Two bits of a set must have been expected together this often before "never" is believed of them."""


class LocalGraphModel(DecisionGraphModel):
    """Decision graphs over each cell's neighbourhood, the same at all positions, and over what meets what anywhere.

    Args:
        space: a stack of planes; all cells of a channel have equally many values.
        n_actions: number of enumerated actions A.
        radius: rows and columns that a neighbourhood reaches in each direction.
        validation: share of episodes held out for the report; the graphs are fitted to all rows in the end.

    Raises:
        ValueError: the space is no stack of planes of that kind.
    """

    def __init__(self, space: FactoredSpace, n_actions: int, radius: int = 1, validation: float = 0.1) -> None:
        """See the class."""
        super().__init__(space.cardinalities, n_actions, validation)
        cards = None if space.planes is None else channel_cardinalities(space)
        if space.planes is None or cards is None:
            raise ValueError(
                f"LocalGraphModel needs planes whose cells have equally many values in each channel, got {space.space}; "
                "use DecisionGraphModel."
            )
        self.board, self.radius = space.planes, radius
        columns = relative_columns(cards, n_actions, radius)
        nothing = [habit_of(k, n_actions, *([np.zeros(0, dtype=np.int64)] * 3)) for k in (*cards, 2, 2)]
        self.local = LocalGraphs(build(_channels(cards, n_actions), (), (), nothing, 1e-9), columns, cards, n_actions, ())
        self._instantiate((), ())

    def _instantiate(self, asked: tuple[Question, ...], found: tuple[Search, ...]) -> None:
        layout, graphs = instantiate(self.local, self.board)
        self.fitted = Fitted(layout, graphs, nothing_late(graphs), graphs, False, asked, found)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began = time.perf_counter()
        train, held_out = data.split(self.validation, seed)
        self._learn(train)
        if progress is not None:
            progress(0.5)
        likelihood, exact = self._likelihood(self.fitted, held_out), self._exact_match(held_out)
        rows = data.rows()
        self._learn(rows)
        if progress is not None:
            progress(1.0)
        figures = {"nodes": float(len(self.local.graphs.column)), "couplings": float(len(self.local.couplings))}
        return self._report(began, (len(rows), len(held_out)), likelihood, exact, figures)

    def _learn(self, rows: TransitionBatch) -> None:
        """Graphs first, each bit for itself; then what is never on together."""
        cards = self.local.cardinalities
        graphs, asked, found = learn_channels(rows, self.board, cards, self.local.columns, self.n_actions)
        self.local = LocalGraphs(graphs, self.local.columns, cards, self.n_actions, ())
        self._instantiate((), ())
        some = rows.select(np.linspace(0, len(rows) - 1, min(len(rows), 4000)).astype(np.int64)) if len(rows) else rows
        couplings = find_couplings(rows, self.board, cards, some, self._ones(some))
        self.local = LocalGraphs(graphs, self.local.columns, cards, self.n_actions, couplings)
        self._instantiate(tuple(asked), tuple(found))

    def _ones(self, rows: TransitionBatch) -> Floats:
        """Probability of each cell's value 1, [N, C, H, W]."""
        start = np.concatenate([[0], np.cumsum(self.cardinalities)])[:-1].astype(np.int64)
        return self.board.to_planes(self.marginals(rows.states, rows.actions)[:, start + 1])

    def for_space(self, space: FactoredSpace) -> LocalGraphModel:
        """The same knowledge for planes of another size; nothing is learned anew.

        Raises:
            ValueError: the channels or their values are others.
        """
        other = LocalGraphModel(space, self.n_actions, self.radius, self.validation)
        if other.local.cardinalities != self.local.cardinalities:
            raise ValueError(
                f"This model knows channels with {self.local.cardinalities} values, but {space.space} has "
                f"{other.local.cardinalities}; only the rows and columns may be others."
            )
        other.local = self.local
        other._instantiate((), ())
        return other

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        couplings = np.asarray(self.local.couplings, dtype=np.int64).reshape(-1, 4)
        return {"couplings": couplings, **{f"local.{name}": array for name, array in to_arrays(self.local.graphs).items()}}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of these planes and actions; nothing is changed then.
        """
        wrong = sorted({"couplings", *(f"local.{name}" for name in Graphs._fields)} ^ set(state))
        if wrong:
            raise ValueError(f"These weights are not those of local decision graphs (first difference: {wrong[0]!r}).")
        cards = self.local.cardinalities
        graphs = from_arrays(
            {name: state[f"local.{name}"] for name in Graphs._fields},
            _channels(cards, self.n_actions),
            len(self.local.columns),
        )
        couplings = tuple(Coupling(int(c), int(k), int(i), bool(e)) for c, k, i, e in np.reshape(state["couplings"], (-1, 4)))
        longest = max(self.board.height, self.board.width)
        if any(c.channel not in range(len(cards)) or c.kind not in (0, 1, 2) or abs(c.line) >= longest for c in couplings):
            raise ValueError("These weights couple cells that these planes do not have; load them into a model of the same kind.")
        self.local = LocalGraphs(graphs, self.local.columns, cards, self.n_actions, couplings)
        self._instantiate((), ())


def channel_cardinalities(space: FactoredSpace) -> tuple[int, ...] | None:
    """Number of values of each channel's cells, or None where they differ within a channel."""
    assert space.planes is not None
    cells = space.planes.to_planes(np.asarray(space.cardinalities)[None])[0]
    alike = (cells == cells[:, :1, :1]).all()
    return tuple(int(k) for k in cells[:, 0, 0]) if alike else None


def _channels(cardinalities: tuple[int, ...], n_actions: int) -> Any:
    """Channels as the factors of a layout; its own columns mean nothing."""
    return lay_out(cardinalities, (), n_actions)


def learn_channels(
    rows: TransitionBatch, board: PlaneLayout, cardinalities: tuple[int, ...], columns: Ints, n_actions: int
) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of all channels and of ``terminated``, over relative columns."""
    n_cells = board.height * board.width
    near = np.flatnonzero((columns[:, 0] != MEETING) | (columns[:, 5:] == 0).all(axis=1))
    far = np.flatnonzero((columns[:, 0] == MEETING) | (columns[:, 0] == ACTION))
    most = max(1, MOST_CELLS // (n_cells * len(near)))
    if len(rows) > most:
        rows = rows.select(np.linspace(0, len(rows) - 1, most).astype(np.int64))
    before, after = board.to_planes(rows.states), board.to_planes(rows.next_states)
    actions = np.repeat(rows.actions, n_cells)
    asked, found, habits = [], [], []
    cells = np.arange(len(actions))
    for channel, cardinality in enumerate(cardinalities):
        now, then = before[:, channel].reshape(-1), after[:, channel].reshape(-1)
        asked += ask(channel, cardinality, actions, now, then, cells)
        habits.append(habit_of(cardinality, n_actions, actions, now, then))
    if asked:
        table = column_values(columns[near], before, rows.actions)
        found += [s.renamed(near) for s in find_splits([q.head for q in asked], table, column_kinds(columns)[near], n_actions)]
    ends, nothing = rows.terminated.astype(np.int64), np.zeros(len(rows), dtype=np.int64)
    over = ask(len(cardinalities), 2, rows.actions, nothing, ends, np.arange(len(rows)))
    if over:
        table = _anywhere(columns[far], before, rows)
        found += [s.renamed(far) for s in find_splits([q.head for q in over], table, column_kinds(columns)[far], n_actions)]
    habits += [habit_of(2, n_actions, rows.actions, nothing, ends), habit_of(2, n_actions, rows.actions, nothing, nothing)]
    still = 0.5 / (len(actions) * len(cardinalities) + 1.0)
    return build(_channels(cardinalities, n_actions), [*asked, *over], found, habits, still), [*asked, *over], found


def _anywhere(columns: Ints, planes: Ints, rows: TransitionBatch) -> NDArray[np.bool_]:
    """Columns that are the same at all positions, bool [N, D]."""
    n_cells = planes.shape[2] * planes.shape[3]
    parts = [column_values(columns[d : d + 1], planes, rows.actions)[::n_cells, 0] for d in range(len(columns))]
    return np.stack(parts, axis=1)


def find_couplings(
    rows: TransitionBatch, board: PlaneLayout, cardinalities: tuple[int, ...], some: TransitionBatch, ones: Floats
) -> tuple[Coupling, ...]:
    """Sets of cells that are coupled: whole channels of which one cell is on, or lines of which two are never on.

    Args:
        rows: all transitions.
        board: where cells lie.
        cardinalities: number of values of each channel's cells.
        some: a few of the transitions.
        ones: each cell's probability to be on after those, [n, C, H, W].
    """
    if len(rows) == 0:
        return ()
    before, after = board.to_planes(rows.states), board.to_planes(rows.next_states)
    found: list[tuple[float, Coupling]] = []
    for channel in (c for c, k in enumerate(cardinalities) if k == 2):
        count = after[:, channel].sum(axis=(1, 2))
        if len(count) and (count == 1).all() and (before[:, channel].sum(axis=(1, 2)) == 1).all():
            found.append((np.inf, Coupling(channel, WHOLE, 0, True)))
            continue
        for kind, axis, length in ((WHOLE, (1, 2), 1), (ROW, (2,), board.height), (COLUMN, (1,), board.width)):
            p = ones[:, channel]
            total, squares = p.sum(axis=axis).reshape(len(p), -1), (p**2).sum(axis=axis).reshape(len(p), -1)
            expected = (total**2 - squares).sum(axis=0) / 2.0 * (len(rows) / max(len(some), 1))
            alone = after[:, channel].sum(axis=axis).reshape(len(rows), -1).max(axis=0, initial=0) <= 1
            for i in np.flatnonzero(alone & (expected > TOGETHER)):
                line = int(i) if i < (length + 1) // 2 else int(i) - length
                found.append((float(expected[i]), Coupling(channel, kind, line, False)))
    found.sort(key=lambda entry: -entry[0])
    return tuple(coupling for _, coupling in found)
