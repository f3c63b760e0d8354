"""Decision graphs for planes: one graph for each channel, learned from all positions at once, good for boards of any size."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.models.base import Bools, FitReport, Floats
from mbagent.models.fit_report import Variable
from mbagent.models.graphs.arrays import SAVED, from_arrays, table_of, to_arrays
from mbagent.models.graphs.channels import find_couplings, learn_channels, learn_late
from mbagent.models.graphs.compiled import Graphs, build
from mbagent.models.graphs.evidence import Ints
from mbagent.models.graphs.fitting import Fitted, nothing_late
from mbagent.models.graphs.habits import habit_of
from mbagent.models.graphs.instantiate import Coupling, LocalGraphs, instantiate, with_couplings, with_laws
from mbagent.models.graphs.laws import LAWLESS, Laws, all_kept, find_laws, n_combinations
from mbagent.models.graphs.looks import PlaneTable, channel_layout
from mbagent.models.graphs.model import DecisionGraphModel
from mbagent.models.graphs.parents import asked_columns, hangs_on_action
from mbagent.models.graphs.recency import still_true_since
from mbagent.models.graphs.search import Search
from mbagent.models.graphs.units import Question
from mbagent.models.graphs.windows import NEXT, NEXT_MEETING, Reach, named_column, relative_columns
from mbagent.models.memory import FORETOLD, SOME_ROWS, SOME_TESTS, better, thinned
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.transitions import TransitionBatch, TransitionDataset

IMAGINED_STEPS = 5
"""Steps of imagined play that show which laws would be broken."""

LARGEST_RADIUS = 3
"""Neighbourhoods are tried up to this radius."""


class LocalGraphModel(DecisionGraphModel):
    """Decision graphs over each cell's neighbourhood, the same at all positions, and over what meets what anywhere.

    Args:
        space: a stack of planes; all cells of a channel have equally many values.
        n_actions: number of enumerated actions A.
        reach: how far a neighbourhood reaches; None to find out from held-out episodes.
        validation: share of episodes held out for the report; the graphs are fitted to all rows in the end.
        parts: see DecisionGraphModel.

    Raises:
        ValueError: the space is no stack of planes of that kind.
    """

    def __init__(
        self,
        space: FactoredSpace,
        n_actions: int,
        reach: Reach | None = None,
        validation: float = 0.1,
        parts: Sequence[int] | None = None,
    ) -> None:
        """See the class."""
        super().__init__(space.cardinalities, n_actions, validation, parts)
        cards = None if space.planes is None else channel_cardinalities(space)
        if space.planes is None or cards is None:
            raise ValueError(
                f"LocalGraphModel needs planes whose cells have equally many values in each channel, got {space.space}; "
                "use DecisionGraphModel."
            )
        self.board, self.given, self.searched = space.planes, reach, 0
        self.counted = 0
        self._forget(cards, reach or Reach())

    def _forget(self, cards: tuple[int, ...], reach: Reach) -> None:
        """Knows nothing, but how far neighbourhoods reach."""
        self.reach = reach
        columns = relative_columns(cards, self.parts, reach)
        none = np.zeros(0, dtype=np.int64)
        nothing = [habit_of(k, self.acts.n_ways, none, none, none) for k in (*cards, 2, 2)]
        graphs = build(channel_layout(cards, self.acts), (), (), nothing, 1e-9)
        self.local = LocalGraphs(graphs, nothing_late(graphs), columns, cards, self.acts, ())
        self._instantiate((), ())

    def _instantiate(self, asked: tuple[Question, ...], found: tuple[Search, ...]) -> None:
        layout, graphs, late = instantiate(self.local, self.board)
        self.fitted = Fitted(layout, graphs, late, graphs, False, asked, found)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began = time.perf_counter()
        rows = data.rows()
        self._forget(self.local.cardinalities, self.given or self._best_reach(*data.split(self.validation, seed)))
        since = self._since(rows, np.zeros(len(rows), dtype=np.bool_))
        train, held_out, train_since = self._split(data, seed, since)
        self._learn(train, since=train_since)
        likelihood, jointly = self._jointly(held_out)
        if progress is not None:
            progress(0.5)
        exact, (variables, calibration) = self._exact_match(held_out), self._described(held_out)
        self._learn(rows, jointly, since)
        self._keep_laws(rows)
        if progress is not None:
            progress(1.0)
        figures = {"nodes": float(len(self.local.graphs.column)), "couplings": float(len(self.local.couplings))}
        figures |= {"changed": float((since > 0).sum()), "searched": float(self.searched)}
        figures["left out"] = float(len(rows) - self.counted)
        report = self._report((len(rows), len(held_out)), likelihood, exact, figures)
        memory = self._memory(train, held_out)
        report = replace(report, variables=variables, calibration=calibration, memory=memory)
        return replace(report, seconds=time.perf_counter() - began)

    def _variables(self) -> list[Variable]:
        """Channels; their parents are relative columns."""
        channels = [int(c) for c in self.local.graphs.changing if c < len(self.local.cardinalities)]
        found = []
        for channel in channels:
            factors = tuple(int(f) for f in self.fitted.layout.cells[channel].ravel())
            columns = asked_columns(self.local.graphs, channel) | asked_columns(self.local.late, channel)
            names = dict.fromkeys(named_column(self.local.columns[d]) for d in sorted(columns))
            layout = channel_layout(self.local.cardinalities, self.acts)
            if hangs_on_action(self.local.graphs, channel, layout):
                names = {"action": None, **{name: None for name in names if not name.startswith("action ")}}
            found.append(Variable(f"channel {channel}", factors, tuple(names)))
        return found

    def _planes(self) -> PlaneLayout | None:
        return self.board

    def _with_memory(self, space: FactoredSpace) -> DecisionGraphModel:
        return LocalGraphModel(space, self.n_actions, self.reach, parts=self.parts)

    def _since(self, rows: TransitionBatch, events: Bools) -> Ints:
        """First row that tells of each channel, and of ``terminated``, as it is now."""
        return still_true_since(rows, len(self.local.cardinalities) + 1, self._channels_foretold)

    def _channels_foretold(self, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """As for factors, summed over each channel, [T, C + 1]."""
        each = self._factors_foretold(train, tests)
        cells = self.board.to_planes(each[:, :-1]).sum(axis=(2, 3))
        return np.concatenate([cells, each[:, -1:]], axis=1)

    def _look(self, rows: TransitionBatch) -> None:
        """Learns quickly."""
        self._learn(rows, jointly=False, in_pairs=False)

    def _kept(self) -> Any:
        return self.local, self.fitted, self.reach

    def _restore(self, kept: Any) -> None:
        self.local, self.fitted, self.reach = kept

    def _best_reach(self, train: TransitionBatch, held_out: TransitionBatch) -> Reach:
        """The least reach under which held-out transitions are foretold no worse than under larger ones; from some rows."""
        if len(held_out) == 0:
            return Reach()
        some, tests = thinned(train, SOME_ROWS), thinned(held_out, SOME_TESTS)
        best, logs = Reach(), self._reaching(Reach(), some, tests)
        most = min(LARGEST_RADIUS, max(self.board.height, self.board.width) // 2)
        while best.radius < most and logs.mean() < FORETOLD:
            further = self._reaching(Reach(best.radius + 1), some, tests)
            if not better(further, logs):
                break
            best, logs = Reach(best.radius + 1), further
        if logs.mean() < FORETOLD and better(self._reaching(best._replace(wrap=True), some, tests), logs):
            best = best._replace(wrap=True)
        return best

    def _reaching(self, reach: Reach, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """Log-probabilities of transitions after learning from others."""
        self._forget(self.local.cardinalities, reach)
        return self._foretold(train, tests)

    def _learn(self, rows: TransitionBatch, jointly: bool = True, since: Ints | None = None, in_pairs: bool = True) -> None:
        """Graphs first, each cell for itself; then what is never on together, and what hangs on what others become."""
        local = self.local
        planes = PlaneTable(rows, self.board, local.cardinalities, local.columns, self.acts, since, in_pairs)
        self.searched, self.counted = len(planes.rows), len(planes.every_action)
        graphs, asked, found = learn_channels(planes)
        self.local = replace(local, graphs=graphs, late=nothing_late(graphs), couplings=(), laws=LAWLESS)
        self._instantiate((), ())
        some = thinned(rows, SOME_ROWS)
        couplings = find_couplings(rows, self.board, local.cardinalities, some, self._ones(some))
        self.local = replace(self.local, couplings=couplings)
        layout = with_couplings(self.fitted.layout, couplings)
        self.fitted = replace(self.fitted, layout=layout, asked=tuple(asked), found=tuple(found))
        if not jointly:
            return
        late, more_asked, more_found = learn_late(planes, layout, self.fitted.usual)
        if len(late.changing):
            self.local = replace(self.local, late=late)
            self._instantiate((*asked, *more_asked), (*found, *more_found))

    def _keep_laws(self, rows: TransitionBatch) -> None:
        """Keeps to laws of the transitions that imagined play would break."""
        laws, layout, rng = find_laws(rows, self.board, self.local.cardinalities), self.fitted.layout, np.random.default_rng(0)
        each = [*(LAWLESS._replace(counts=laws.counts[k : k + 1]) for k in range(len(laws.counts)))]
        each += [LAWLESS._replace(met=laws.met)]
        broken, states = np.zeros(len(each), dtype=np.bool_), thinned(rows, SOME_ROWS).states
        for _ in range(0 if laws.none else IMAGINED_STEPS):
            following, over = self.sample(states, rng.integers(self.n_actions, size=len(states)), rng)
            for i, law in enumerate(each):
                broken[i] |= not (over | all_kept(*law, layout.weights, layout.cells, states, following)).all()
            states = following[~over]
        laws = Laws(laws.counts[broken[:-1]], laws.met if broken[-1] else LAWLESS.met)
        self.local = replace(self.local, laws=laws)
        self.fitted = replace(self.fitted, layout=with_laws(layout, laws))

    def _ones(self, rows: TransitionBatch) -> Floats:
        """Probability of each cell's value 1, [N, C, H, W]."""
        start = np.concatenate([[0], np.cumsum(self.cardinalities)])[:-1].astype(np.int64)
        return self.board.to_planes(self.marginals(rows.states, rows.actions)[:, start + 1])

    def for_space(self, space: FactoredSpace | spaces.Space[Any]) -> LocalGraphModel:
        """The same knowledge for planes of another size; nothing is learned anew.

        Args:
            space: a stack of planes, as a Gymnasium space or factored.

        Raises:
            ValueError: it is no stack of planes, or the channels or their values are others.
        """
        space = space if isinstance(space, FactoredSpace) else FactoredSpace(space)
        if space.planes is None:
            raise ValueError(f"for_space carries knowledge of planes over to planes of another size, but got {space.space}.")
        other = LocalGraphModel(space, self.n_actions, self.given, self.validation, self.parts)
        if other.local.cardinalities != self.local.cardinalities:
            raise ValueError(
                f"This model knows channels with {self.local.cardinalities} values, but {space.space} has "
                f"{other.local.cardinalities}; only the rows and columns may be others."
            )
        other.local, other.reach = self.local, self.reach
        other._instantiate((), ())
        return other

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        couplings = np.asarray(self.local.couplings, dtype=np.int64).reshape(-1, 4)
        state: dict[str, NDArray[Any]] = {"reach": np.asarray(self.reach, dtype=np.int64), "couplings": couplings}
        state |= self.local.laws._asdict()
        for name, graphs in (("local", self.local.graphs), ("late", self.local.late)):
            state.update({f"{name}.{part}": array for part, array in to_arrays(graphs).items()})
        return state

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of these planes and actions; nothing is changed then.
        """
        graph_parts = {f"{name}.{part}" for name in ("local", "late") for part in SAVED}
        wrong = sorted(({"reach", "couplings", "counts", "met"} | graph_parts) ^ set(state))
        if wrong:
            raise ValueError(f"These weights are not those of local decision graphs (first difference: {wrong[0]!r}).")
        cards, parts = self.local.cardinalities, np.asarray(state["reach"]).reshape(-1)
        if len(parts) != 2 or parts[0] not in range(1, LARGEST_RADIUS + 1) or parts[1] not in (0, 1):
            raise ValueError("These weights are of neighbourhoods that reach as far as none can; the file is damaged.")
        reach = Reach(int(parts[0]), bool(parts[1]))
        columns = relative_columns(cards, self.parts, reach)
        graphs, late = (
            from_arrays(
                {part: state[f"{name}.{part}"] for part in SAVED},
                channel_layout(cards, self.acts),
                len(columns),
            )
            for name in ("local", "late")
        )
        if not _sound(graphs, late, columns):
            raise ValueError("These weights ask for a next state that is not known yet; load them as they were saved.")
        couplings = tuple(Coupling(int(c), int(k), int(i), bool(e)) for c, k, i, e in table_of(state["couplings"], 4))
        height, width = self.board.height, self.board.width
        if any(
            c.channel not in range(len(cards)) or cards[c.channel] != 2 or c.kind not in (0, 1, 2) or not c.lies_on(height, width)
            for c in couplings
        ):
            raise ValueError("These weights couple cells that these planes do not have; load them into a model of the same kind.")
        laws = Laws(table_of(state["counts"], 2), np.array(state["met"], dtype=np.bool_).reshape(-1))
        if any(c not in range(len(cards)) or value not in range(cards[c]) for c, value in laws.counts) or (
            len(laws.met) not in (0, n_combinations(cards))
        ):
            raise ValueError("These weights count values that these planes do not have; load them into a model of the same kind.")
        self.local, self.reach = LocalGraphs(graphs, late, columns, cards, self.acts, couplings, laws), reach
        self._instantiate((), ())


def channel_cardinalities(space: FactoredSpace) -> tuple[int, ...] | None:
    """Number of values of each channel's cells, or None where they differ within a channel."""
    assert space.planes is not None
    cells = space.planes.to_planes(np.asarray(space.cardinalities)[None])[0]
    alike = (cells == cells[:, :1, :1]).all()
    return tuple(int(k) for k in cells[:, 0, 0]) if alike else None


def _sound(graphs: Graphs, late: Graphs, columns: Ints) -> bool:
    """Whether only late graphs ask for the next state."""
    asked = graphs.column[graphs.column >= 0]
    channels = columns[columns[:, 0] == NEXT, 1]
    return bool(not np.isin(columns[asked, 0], (NEXT, NEXT_MEETING)).any() and (late.changing <= channels.max() + 1).all())
