"""Dynamic Bayesian networks of planes: one decision graph for each channel, its parameters tied over all positions.

Where the dynamics differ between positions, each cell has its own graph instead; held-out transitions decide.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.base import FitReport
from mbagent.models.dbn import sampling
from mbagent.models.dbn.arrays import Graphs, build
from mbagent.models.dbn.change_points import last_changes
from mbagent.models.dbn.features import Layout, Observed, Question, ask, distinct
from mbagent.models.dbn.fitting import UNCERTAIN, Fitted, fit_graphs, go_together, no_synchronic, uncertain_rows
from mbagent.models.dbn.grounding import COLUMN, ROW, WHOLE, LocalGraphs, Mutex, instantiate, with_invariants, with_mutexes
from mbagent.models.dbn.invariants import NO_INVARIANTS, Invariants, all_kept, find_invariants, n_combinations
from mbagent.models.dbn.large_data import PlaneTable, channel_layout, refine
from mbagent.models.dbn.model import IMPOSSIBLE_LOG_PROB, DecisionGraphModel, depends_on_action, tested_features
from mbagent.models.dbn.plane_features import (
    NEXT,
    NEXT_ADJACENCY,
    Reach,
    feature_name,
    feature_values,
    relative_features,
    shifted,
)
from mbagent.models.dbn.serialization import SAVED, from_arrays, table_of, to_arrays
from mbagent.models.dbn.smoothing import smoothing_of
from mbagent.models.dbn.splits import Search
from mbagent.models.fit_report import Variable
from mbagent.models.held_out import FORETOLD, SOME_ROWS, SOME_TESTS, better, thinned
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.types import Bools, Floats, Ints

EXPECTED_TOGETHER = 12.0
"""Two bits of a set must have been expected together this often before "never" is believed of them."""

SOME_CELLS = 100_000
"""Cells that are looked at for errors that go together."""


def fit_channels(planes: PlaneTable) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of all channels, each cell for itself, and of ``terminated``."""
    asked: list[Question] = []
    copied_asked: list[Question] = []
    copied: list[Search] = []
    for channel, cardinality in enumerate(planes.cardinalities):
        features = planes.determined_by(channel)
        if features is None:
            asked += ask(channel, cardinality, planes.observed(channel))
        else:
            questions, table = planes.copying(channel, features)
            copied_asked, copied = copied_asked + questions, copied + planes.split(questions, table, features)
    found = planes.split(asked, planes.table, planes.near) if asked else []
    found = refine(planes, asked, found)
    asked, found = asked + copied_asked, found + copied
    if planes.rows.terminated.any():
        over, searches = _ends(planes, planes.far)
        asked, found = asked + over, found + searches
    return planes.build(asked, found), asked, found


def _ends(planes: PlaneTable, numbers: Ints) -> tuple[list[Question], list[Search]]:
    """Whether episodes end, by columns that are the same at all positions."""
    rows, far = planes.rows, planes.far_values(numbers)
    first, pattern = distinct(np.packbits(far, axis=1))
    nothing, ends = np.zeros(len(rows), dtype=np.int64), rows.terminated.astype(np.int64)
    counting = np.arange(min(planes.since[-1], len(rows)), len(rows))
    asked = ask(
        len(planes.cardinalities),
        2,
        Observed(pattern, planes.encoding.action_class[rows.actions], nothing, ends).select(counting),
    )
    return asked, planes.split(asked, far[first], numbers)


def fit_synchronic(planes: PlaneTable, layout: Layout, graphs: Graphs) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of the channels whose cells hang on what others become, given those; and of ``terminated``.

    Args:
        planes: the transitions.
        layout: of the board.
        graphs: of all cells, each for itself.
    """
    synchronic, asked, found = [], [], []
    for channel, numbers in _dependent(planes, layout, graphs).items():
        variables = layout.cells[channel].ravel()
        needed = uncertain_rows(planes.rows, layout, graphs, variables)
        counting = planes.cells_since(channel)
        kept = np.flatnonzero((needed & (layout.mutex_of[variables] < 0)).ravel()[counting])
        some, which = planes.observed(channel).select(kept), counting[kept]
        following = feature_values(planes.features[numbers], planes.before, planes.rows.actions, planes.after)[which]
        first, pattern = distinct(following, some.pattern)
        questions = ask(channel, planes.cardinalities[channel], replace(some, pattern=pattern))
        table = np.concatenate([planes.table[some.pattern[first]], following[first]], axis=1)
        searches = planes.split(questions, table, np.concatenate([planes.near, numbers])) if questions else []
        if any(split.feature in numbers for search in searches for split in search.splits):
            synchronic.append(channel)
            asked += questions
            found += searches
    if planes.rows.terminated.any():
        over, searches = _ends(planes, np.concatenate([planes.far, planes.next_far]))
        if any(split.feature in planes.next_far for search in searches for split in search.splits):
            synchronic.append(len(planes.cardinalities))
            asked, found = asked + over, found + searches
    if not synchronic:
        return no_synchronic(graphs), [], []
    return planes.build(asked, found)._replace(changing=np.asarray(synchronic, dtype=np.int64)), asked, found


def _dependent(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[int, Ints]:
    """For each channel, numbers of the columns of the kind NEXT whose errors go with those of its cells."""
    errors = _errors(planes, layout, graphs)
    found: dict[int, Ints] = {}
    for channel in sorted({c for c, _ in errors}):
        own = [errors[key] for key in errors if key[0] == channel]
        earlier = [d for d in np.flatnonzero(planes.features[:, 0] == NEXT) if _is_earlier(planes.features[d], channel)]
        kept = []
        for d in earlier:
            _, other, value, below, right, _, _ = (int(part) for part in planes.features[d])
            if (other, value) in errors:
                error, spread = (shifted(part, below, right) for part in errors[other, value])
                if any(go_together(e, error, v, spread, len(earlier)) for e, v in own):
                    kept.append(int(d))
        if kept:
            found[channel] = np.asarray(kept, dtype=np.int64)
    return found


def _is_earlier(feature: Ints, channel: int) -> bool:
    """Whether a cell of the next state is drawn before those of the channel at the same place."""
    return bool(feature[1] < channel or (feature[1] == channel and tuple(feature[3:5]) < (0, 0)))


def _errors(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    """Errors and their variances, [n, H, W] each, of every (channel, value) that is uncertain, in some rows."""
    if len(planes.rows) == 0:
        return {}
    n = min(max(100, SOME_CELLS // planes.n_cells), len(planes.rows))
    some = np.linspace(0, len(planes.rows) - 1, n).astype(np.int64)
    rows, cards = planes.rows.select(some), np.empty(layout.n_factors, dtype=np.int64)
    for channel, k in enumerate(planes.cardinalities):
        cards[layout.cells[channel]] = k
    start = np.concatenate([[0], np.cumsum(cards)]).astype(np.int64)
    probs = np.empty((n, int(start[-1])))
    sampling.marginals(rows.states, rows.actions, layout, graphs, start, probs)
    found = {}
    for channel, k in enumerate(planes.cardinalities):
        alone = layout.mutex_of[layout.cells[channel]] < 0
        for value in range(k) if k > 2 else (1,):
            p = probs[:, start[layout.cells[channel]] + value]
            spread = p * (1.0 - p) * alone
            if spread.sum() > UNCERTAIN:
                found[channel, value] = ((planes.after[some, channel] == value) - p) * alone, spread
    return found


def find_mutexes(
    rows: TransitionBatch, board: PlaneLayout, cardinalities: tuple[int, ...], some: TransitionBatch, ones: Floats
) -> tuple[Mutex, ...]:
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
    before, after = board.to_planes(rows.before), board.to_planes(rows.after)
    found: list[tuple[float, Mutex]] = []
    for channel in (c for c, k in enumerate(cardinalities) if k == 2):
        count = after[:, channel].sum(axis=(1, 2))
        if len(count) and (count == 1).all() and (before[:, channel].sum(axis=(1, 2)) == 1).all():
            found.append((np.inf, Mutex(channel, WHOLE, 0, True)))
            continue
        for kind, axis, length in ((WHOLE, (1, 2), 1), (ROW, (2,), board.height), (COLUMN, (1,), board.width)):
            p = ones[:, channel]
            total, squares = p.sum(axis=axis).reshape(len(p), -1), (p**2).sum(axis=axis).reshape(len(p), -1)
            expected = (total**2 - squares).sum(axis=0) / 2.0 * (len(rows) / max(len(some), 1))
            alone = after[:, channel].sum(axis=axis, dtype=np.int64).reshape(len(rows), -1).max(axis=0, initial=0) <= 1
            for i in np.flatnonzero(alone & (expected > EXPECTED_TOGETHER)):
                line = int(i) if i < (length + 1) // 2 else int(i) - length
                found.append((float(expected[i]), Mutex(channel, kind, line, False)))
    found.sort(key=lambda entry: -entry[0])
    return tuple(mutex for _, mutex in found)


SIMULATED_STEPS = 5
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
        features = relative_features(cards, self.parts, reach)
        none = np.zeros(0, dtype=np.int64)
        nothing = [smoothing_of(k, self.encoding.n_action_classes, none, none, none) for k in (*cards, 2, 2)]
        graphs = build(channel_layout(cards, self.encoding), (), (), nothing, 1e-9)
        self.local = LocalGraphs(graphs, no_synchronic(graphs), features, cards, self.encoding, ())
        self._instantiate((), ())

    def _instantiate(self, asked: tuple[Question, ...], found: tuple[Search, ...]) -> None:
        layout, graphs, synchronic = instantiate(self.local, self.board)
        self.fitted = Fitted(layout, graphs, synchronic, graphs, False, asked, found)

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
        self._enforce_invariants(rows)
        if progress is not None:
            progress(1.0)
        figures = {"nodes": float(len(self.local.graphs.feature)), "couplings": float(len(self.local.mutexes))}
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
            features = tested_features(self.local.graphs, channel) | tested_features(self.local.synchronic, channel)
            names = dict.fromkeys(feature_name(self.local.features[d]) for d in sorted(features))
            layout = channel_layout(self.local.cardinalities, self.encoding)
            if depends_on_action(self.local.graphs, channel, layout):
                names = {"action": None, **{name: None for name in names if not name.startswith("action ")}}
            found.append(Variable(f"channel {channel}", factors, tuple(names)))
        return found

    def _planes(self) -> PlaneLayout | None:
        return self.board

    def _with_memory(self, space: FactoredSpace) -> DecisionGraphModel:
        return LocalGraphModel(space, self.n_actions, self.reach, parts=self.parts)

    def _since(self, rows: TransitionBatch, resets: Bools) -> Ints:
        """First row that tells of each channel, and of ``terminated``, as it is now."""
        return last_changes(rows, len(self.local.cardinalities) + 1, self._channel_log_probs)

    def _channel_log_probs(self, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """As for factors, summed over each channel, [T, C + 1]."""
        each = self._factor_log_probs(train, tests)
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
        return self._quick_log_probs(train, tests)

    def _learn(self, rows: TransitionBatch, jointly: bool = True, since: Ints | None = None, in_pairs: bool = True) -> None:
        """Graphs first, each cell for itself; then what is never on together, and what hangs on what others become."""
        local = self.local
        planes = PlaneTable(rows, self.board, local.cardinalities, local.features, self.encoding, since, in_pairs)
        self.searched, self.counted = len(planes.rows), len(planes.every_action)
        graphs, asked, found = fit_channels(planes)
        self.local = replace(local, graphs=graphs, synchronic=no_synchronic(graphs), mutexes=(), invariants=NO_INVARIANTS)
        self._instantiate((), ())
        some = thinned(rows, SOME_ROWS)
        mutexes = find_mutexes(rows, self.board, local.cardinalities, some, self._ones(some))
        self.local = replace(self.local, mutexes=mutexes)
        layout = with_mutexes(self.fitted.layout, mutexes)
        self.fitted = replace(self.fitted, layout=layout, asked=tuple(asked), found=tuple(found))
        if not jointly:
            return
        synchronic, more_asked, more_found = fit_synchronic(planes, layout, self.fitted.usual)
        if len(synchronic.changing):
            self.local = replace(self.local, synchronic=synchronic)
            self._instantiate((*asked, *more_asked), (*found, *more_found))

    def _enforce_invariants(self, rows: TransitionBatch) -> None:
        """Keeps to laws of the transitions that imagined play would break."""
        invariants, layout, rng = (
            find_invariants(rows, self.board, self.local.cardinalities),
            self.fitted.layout,
            np.random.default_rng(0),
        )
        each = [*(NO_INVARIANTS._replace(counts=invariants.counts[k : k + 1]) for k in range(len(invariants.counts)))]
        each += [NO_INVARIANTS._replace(observed=invariants.observed)]
        broken, states = np.zeros(len(each), dtype=np.bool_), thinned(rows, SOME_ROWS).states
        for _ in range(0 if invariants.none else SIMULATED_STEPS):
            following, over = self.sample(states, rng.integers(self.n_actions, size=len(states)), rng)
            for i, invariant in enumerate(each):
                broken[i] |= not (over | all_kept(*invariant, layout.weights, layout.cells, states, following)).all()
            states = following[~over]
        invariants = Invariants(invariants.counts[broken[:-1]], invariants.observed if broken[-1] else NO_INVARIANTS.observed)
        self.local = replace(self.local, invariants=invariants)
        self.fitted = replace(self.fitted, layout=with_invariants(layout, invariants))

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
        mutexes = np.asarray(self.local.mutexes, dtype=np.int64).reshape(-1, 4)
        state: dict[str, NDArray[Any]] = {"reach": np.asarray(self.reach, dtype=np.int64), "couplings": mutexes}
        state |= {"counts": self.local.invariants.counts, "met": self.local.invariants.observed}
        for name, graphs in (("local", self.local.graphs), ("late", self.local.synchronic)):
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
        features = relative_features(cards, self.parts, reach)
        graphs, synchronic = (
            from_arrays(
                {part: state[f"{name}.{part}"] for part in SAVED},
                channel_layout(cards, self.encoding),
                len(features),
            )
            for name in ("local", "late")
        )
        if not _sound(graphs, synchronic, features):
            raise ValueError("These weights ask for a next state that is not known yet; load them as they were saved.")
        mutexes = tuple(Mutex(int(c), int(k), int(i), bool(e)) for c, k, i, e in table_of(state["couplings"], 4))
        height, width = self.board.height, self.board.width
        if any(
            c.channel not in range(len(cards)) or cards[c.channel] != 2 or c.kind not in (0, 1, 2) or not c.lies_on(height, width)
            for c in mutexes
        ):
            raise ValueError("These weights couple cells that these planes do not have; load them into a model of the same kind.")
        invariants = Invariants(table_of(state["counts"], 2), np.array(state["met"], dtype=np.bool_).reshape(-1))
        if any(c not in range(len(cards)) or value not in range(cards[c]) for c, value in invariants.counts) or (
            len(invariants.observed) not in (0, n_combinations(cards))
        ):
            raise ValueError("These weights count values that these planes do not have; load them into a model of the same kind.")
        self.local, self.reach = LocalGraphs(graphs, synchronic, features, cards, self.encoding, mutexes, invariants), reach
        self._instantiate((), ())


def channel_cardinalities(space: FactoredSpace) -> tuple[int, ...] | None:
    """Number of values of each channel's cells, or None where they differ within a channel."""
    assert space.planes is not None
    cells = space.planes.to_planes(np.asarray(space.cardinalities)[None])[0]
    alike = (cells == cells[:, :1, :1]).all()
    return tuple(int(k) for k in cells[:, 0, 0]) if alike else None


def _sound(graphs: Graphs, synchronic: Graphs, features: Ints) -> bool:
    """Whether only late graphs ask for the next state."""
    asked = graphs.feature[graphs.feature >= 0]
    channels = features[features[:, 0] == NEXT, 1]
    return bool(
        not np.isin(features[asked, 0], (NEXT, NEXT_ADJACENCY)).any() and (synchronic.changing <= channels.max() + 1).all()
    )


MOST_UNTIED_CELLS = 2000
"""Cells of planes of which each is looked at for itself; with more, no rows would be enough."""


class PlaneGraphModel(LocalGraphModel):
    """A LocalGraphModel that learns each cell for itself where that foretells held-out transitions clearly better.

    So it is where planes only write down a place, and what an action does there is another thing at each.

    Attributes:
        flat: the model of each cell for itself, whose graphs are this one's then; else None.
    """

    flat: DecisionGraphModel | None = None

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began, self.flat = time.perf_counter(), None
        report = super().fit(data, seed=seed, progress=progress)
        train, held_out = self._parts
        del self._parts
        recent = _later_half(train), _later_half(held_out)  # what hung on the place may have changed unseen by one rule for all
        if any(self._depends_on_position(*parts, report.predictor_loss) for parts in ((train, held_out), recent)):
            flat = DecisionGraphModel(self.cardinalities, self.n_actions, self.validation, self.parts)
            other = flat.fit(data, seed=seed)
            if _loss(other) < _loss(report):
                report = other
                self._take(flat)
        return replace(report, seconds=time.perf_counter() - began)

    def _take(self, flat: DecisionGraphModel) -> None:
        self.flat, self.fitted = flat, flat.fitted

    def _split(self, data: TransitionDataset, seed: int, since: Ints) -> tuple[TransitionBatch, TransitionBatch, Ints]:
        """As always; the parts are kept until the fit ends, so that either model is judged by the same transitions."""
        train, held_out, train_since = super()._split(data, seed, since)
        self._parts = train.select(np.arange(train_since.max(), len(train))), held_out  # as the rules are now
        return train, held_out, train_since

    def _depends_on_position(self, train: TransitionBatch, held_out: TransitionBatch, loss: float | None) -> bool:
        """Whether a quick look at each cell for itself foretells held-out transitions better than what was learned of all.

        Args:
            train: transitions to learn from.
            held_out: those held out.
            loss: what held-out transitions cost the model of all positions, nats each; None where none was held out.
        """
        some, tests = thinned(train, SOME_ROWS), thinned(held_out, SOME_TESTS)
        if loss is None or loss < -FORETOLD or len(self.cardinalities) > MOST_UNTIED_CELLS or min(len(some), len(tests)) < 2:
            return False
        flat = DecisionGraphModel(self.cardinalities, self.n_actions, parts=self.parts)
        flat.fitted = fit_graphs(self.cardinalities, self.encoding, some, np.zeros(len(some), dtype=np.bool_), False, False)
        logs = flat.log_prob(tests.states, tests.actions, tests.next_states, tests.terminated)
        return better(np.maximum(logs, IMPOSSIBLE_LOG_PROB), np.full(len(logs), -loss))

    def for_space(self, space: FactoredSpace | spaces.Space[Any]) -> LocalGraphModel:
        """See LocalGraphModel.

        Raises:
            ValueError: also where rules hang on the place.
        """
        if self.flat is not None:
            raise ValueError(
                "What this model learned hangs on the place on the planes, so planes of another size are unknown to it."
            )
        return super().for_space(space)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        return super().state_dict() if self.flat is None else self.flat.state_dict()

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of these planes and actions; nothing is changed then.
        """
        if "groups" not in state:
            super().load_state_dict(state)
            self.flat = None
            return
        flat = DecisionGraphModel(self.cardinalities, self.n_actions, self.validation, self.parts)
        flat.load_state_dict(state)
        self._take(flat)


def _later_half(rows: TransitionBatch) -> TransitionBatch:
    return rows.select(slice(len(rows) // 2, None))


def _loss(report: FitReport) -> float:
    """What held-out transitions cost, nats each; of none, infinitely much."""
    return float("inf") if report.predictor_loss is None else report.predictor_loss
