"""Dynamic Bayesian networks of planes: one set of decision graphs for each channel, with parameters tied over all positions.

If the dynamics depend on the position, each cell gets graphs of its own instead; held-out transitions decide between the two.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Self

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn import sampling
from mbagent.models.dbn.arrays import FEATURE, SAVED, Graphs, build, from_arrays, table_of, to_arrays
from mbagent.models.dbn.change_points import last_changes
from mbagent.models.dbn.effects import smoothing_of
from mbagent.models.dbn.features import Layout, Observed, Question, ask, distinct
from mbagent.models.dbn.fitting import UNCERTAIN, Fitted, all_redrawn, fit_graphs, go_together, no_synchronic, uncertain_rows
from mbagent.models.dbn.model import IMPOSSIBLE_LOG_PROB, DecisionGraphModel, depends_on_action, tested_features
from mbagent.models.dbn.planes.features import (
    COLUMN,
    NEXT,
    NEXT_ADJACENCY,
    ROW,
    WHOLE,
    LocalGraphs,
    Mutex,
    Reach,
    feature_name,
    feature_values,
    instantiate,
    relative_features,
    shifted,
    with_mutexes,
)
from mbagent.models.dbn.planes.invariants import (
    NO_INVARIANTS,
    Invariants,
    all_kept,
    find_invariants,
    n_combinations,
    with_invariants,
)
from mbagent.models.dbn.planes.large_data import PlaneTable, channel_layout, refine
from mbagent.models.dbn.score import Search
from mbagent.models.fit_report import FitReport, Variable
from mbagent.models.held_out import PERFECT_LOG_PROB, SOME_ROWS, SOME_TESTS, better, thinned
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.types import Bools, Floats, Ints

EXPECTED_TOGETHER = 12.0
"""Minimum expected number of joint occurrences of two bits of a set for which having none is significant."""

SOME_CELLS = 100_000
"""Number of cells in which errors are tested for correlation."""


def fit_channels(planes: PlaneTable) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs without synchronic arcs for all channels and ``terminated``, their questions and searches."""
    questions: list[Question] = []
    copy_questions: list[Question] = []
    copies: list[Search] = []
    for channel, cardinality in enumerate(planes.cardinalities):
        features = planes.determined_by(channel)
        if features is None:
            questions += ask(channel, cardinality, planes.observed(channel))
        else:
            more, table = planes.copying(channel, features)
            copy_questions, copies = copy_questions + more, copies + planes.split(more, table, features)
    found = planes.split(questions, planes.table, planes.near) if questions else []
    found = refine(planes, questions, found)
    questions, found = questions + copy_questions, found + copies
    if planes.rows.terminated.any():
        more, searches = _ends(planes, planes.far)
        questions, found = questions + more, found + searches
    return planes.build(questions, found), questions, found


def _ends(planes: PlaneTable, numbers: Ints) -> tuple[list[Question], list[Search]]:
    """Questions and searches for ``terminated``, with features that have the same value at all positions."""
    rows, far = planes.rows, planes.far_values(numbers)
    first, pattern = distinct(np.packbits(far, axis=1))
    zeros, ends = np.zeros(len(rows), dtype=np.int64), rows.terminated.astype(np.int64)
    counting = np.arange(min(planes.since[-1], len(rows)), len(rows))
    questions = ask(
        len(planes.cardinalities),
        2,
        Observed(pattern, planes.encoding.action_class[rows.actions], zeros, ends).select(counting),
    )
    return questions, planes.split(questions, far[first], numbers)


def fit_synchronic(planes: PlaneTable, layout: Layout, graphs: Graphs) -> tuple[Graphs, list[Question], list[Search]]:
    """Graphs of channels with synchronic arcs, and of ``terminated`` if it has any; their questions and searches.

    Args:
        planes: the transitions.
        layout: the board's layout.
        graphs: graphs of all cells, without synchronic arcs.
    """
    synchronic, all_questions, found = [], [], []
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
            all_questions += questions
            found += searches
    if planes.rows.terminated.any():
        questions, searches = _ends(planes, np.concatenate([planes.far, planes.next_far]))
        if any(split.feature in planes.next_far for search in searches for split in search.splits):
            synchronic.append(len(planes.cardinalities))
            all_questions, found = all_questions + questions, found + searches
    if not synchronic:
        return no_synchronic(graphs), [], []
    built = planes.build(all_questions, found)
    return replace(built, changing=np.asarray(synchronic, dtype=np.int64)), all_questions, found


def _dependent(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[int, Ints]:
    """For each channel, indices of earlier-drawn ``NEXT`` features whose errors correlate with its own; no entry if none."""
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
    """Whether the next-state cell that a feature tests is drawn before the channel's cell at offset (0, 0)."""
    return bool(feature[1] < channel or (feature[1] == channel and tuple(feature[3:5]) < (0, 0)))


def _errors(planes: PlaneTable, layout: Layout, graphs: Graphs) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    """Prediction errors and their variances, [n, H, W] each, for every uncertain (channel, value), from a sample of n rows."""
    if len(planes.rows) == 0:
        return {}
    n = min(max(100, SOME_CELLS // planes.n_cells), len(planes.rows))
    some = np.linspace(0, len(planes.rows) - 1, n).astype(np.int64)
    rows, cards = planes.rows.select(some), np.empty(layout.n_factors, dtype=np.int64)
    for channel, k in enumerate(planes.cardinalities):
        cards[layout.cells[channel]] = k
    start = np.concatenate([[0], np.cumsum(cards)]).astype(np.int64)
    probs = sampling.marginals(rows.states, rows.actions, layout, graphs, start)
    found = {}
    for channel, k in enumerate(planes.cardinalities):
        ungrouped = layout.mutex_of[layout.cells[channel]] < 0
        for value in range(k) if k > 2 else (1,):
            p = probs[:, start[layout.cells[channel]] + value]
            spread = p * (1.0 - p) * ungrouped
            if spread.sum() > UNCERTAIN:
                found[channel, value] = ((planes.after[some, channel] == value) - p) * ungrouped, spread
    return found


def find_mutexes(
    rows: TransitionBatch, board: PlaneLayout, cardinalities: tuple[int, ...], some: TransitionBatch, ones: Floats
) -> tuple[Mutex, ...]:
    """Mutex groups of cells: channels with exactly one on; channels, or their rows or columns, with at most one on.

    Args:
        rows: all transitions.
        board: positions of the cells.
        cardinalities: number of values of each channel's cells.
        some: a sample of n transitions.
        ones: predicted probability that each cell is on after each sampled transition, [n, C, H, W].
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
            exclusive = after[:, channel].sum(axis=axis, dtype=np.int64).reshape(len(rows), -1).max(axis=0, initial=0) <= 1
            for i in np.flatnonzero(exclusive & (expected > EXPECTED_TOGETHER)):
                line = int(i) if i < (length + 1) // 2 else int(i) - length
                found.append((float(expected[i]), Mutex(channel, kind, line, False)))
    found.sort(key=lambda entry: -entry[0])
    return tuple(mutex for _, mutex in found)


SIMULATED_STEPS = 5
"""Simulated steps in which it is tested which invariants the model would violate."""

LARGEST_RADIUS = 3
"""Largest radius of neighbourhoods that is tried."""


class LocalGraphModel(DecisionGraphModel):
    """Decision graphs over each cell's neighbourhood and adjacency features, with parameters tied over all positions.

    Args:
        space: a stack of planes; all cells of a channel have the same number of values.
        n_actions: number of enumerated actions A.
        reach: extent of neighbourhoods; None to choose it on held-out episodes.
        validation: share of episodes held out for the report and for model selection; the final graphs are fitted to all rows.
        parts: see DecisionGraphModel.

    Raises:
        ValueError: the space is not such a stack of planes.
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
                f"LocalGraphModel needs planes whose cells have the same number of values in each channel, got {space.space}; "
                "use DecisionGraphModel."
            )
        self.board, self.given, self.searched = space.planes, reach, 0
        self.counted = 0
        self._clear(cards, reach or Reach())

    def _clear(self, cards: tuple[int, ...], reach: Reach) -> None:
        """Resets to an unfitted model with the given reach."""
        self.reach = reach
        features = relative_features(cards, self.parts, reach)
        none = np.zeros(0, dtype=np.int64)
        smoothings = [smoothing_of(k, self.encoding.n_action_classes, none, none, none) for k in (*cards, 2, 2)]
        graphs = build(channel_layout(cards, self.encoding), (), (), smoothings, 1e-9)
        self.local = LocalGraphs(graphs, no_synchronic(graphs), features, cards, self.encoding, ())
        self._instantiate((), ())

    def _instantiate(self, questions: tuple[Question, ...], found: tuple[Search, ...]) -> None:
        layout, graphs, synchronic = instantiate(self.local, self.board)
        self.fitted = Fitted(layout, graphs, synchronic, graphs, no_synchronic(graphs), False, questions, found)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began = time.perf_counter()
        rows = data.rows()
        self._clear(self.local.cardinalities, self.given or self._best_reach(*data.split(self.validation, seed)))
        since = self._since(rows, np.zeros(len(rows), dtype=np.bool_))
        train, held_out, train_since = self._split(data, seed, since)
        self._learn(train, since=train_since)
        likelihood, jointly = self._compare_synchronic(held_out)
        if progress is not None:
            progress(0.5)
        exact, (variables, calibration) = self._exact_match(held_out), self._described(held_out)
        self._learn(rows, jointly, since)
        self._enforce_invariants(rows)
        if progress is not None:
            progress(1.0)
        figures = {"nodes": float(len(self.local.graphs.node)), "couplings": float(len(self.local.mutexes))}
        figures |= {"changed": float((since > 0).sum()), "searched": float(self.searched)}
        figures["left out"] = float(len(rows) - self.counted)
        report = self._report((len(rows), len(held_out)), likelihood, exact, figures)
        memory = self._memory(train, held_out)
        report = replace(report, variables=variables, calibration=calibration, memory=memory)
        return replace(report, seconds=time.perf_counter() - began)

    def _variables(self) -> list[Variable]:
        """Channels that have graphs; their parents are relative features."""
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
        """First row from which the present rules of each channel and of ``terminated`` hold, int64 [C + 1]."""
        return last_changes(rows, len(self.local.cardinalities) + 1, self._channel_log_probs)

    def _channel_log_probs(self, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """As ``_factor_log_probs``, but summed over the cells of each channel, [T, C + 1]."""
        each = self._factor_log_probs(train, tests)
        cells = self.board.to_planes(each[:, :-1]).sum(axis=(2, 3))
        return np.concatenate([cells, each[:, -1:]], axis=1)

    def _quickly_fitted(self, rows: TransitionBatch) -> Self:
        """See the base class; also without pairwise splits."""
        other = copy(self)
        other._learn(rows, jointly=False, in_pairs=False)
        return other

    def _best_reach(self, train: TransitionBatch, held_out: TransitionBatch) -> Reach:
        """The smallest reach beyond which held-out likelihood stops improving, judged on a sample of rows."""
        if len(held_out) == 0:
            return Reach()
        some, tests = thinned(train, SOME_ROWS), thinned(held_out, SOME_TESTS)
        best, logs = Reach(), self._reach_log_probs(Reach(), some, tests)
        most = min(LARGEST_RADIUS, max(self.board.height, self.board.width) // 2)
        while best.radius < most and logs.mean() < PERFECT_LOG_PROB:
            further = self._reach_log_probs(Reach(best.radius + 1), some, tests)
            if not better(further, logs):
                break
            best, logs = Reach(best.radius + 1), further
        if logs.mean() < PERFECT_LOG_PROB and better(self._reach_log_probs(best._replace(wrap=True), some, tests), logs):
            best = best._replace(wrap=True)
        return best

    def _reach_log_probs(self, reach: Reach, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """Log-probabilities of ``tests`` after a quick fit to ``train`` with the given reach."""
        other = copy(self)
        other._clear(self.local.cardinalities, reach)
        return other._quick_log_probs(train, tests)

    def _learn(self, rows: TransitionBatch, jointly: bool = True, since: Ints | None = None, in_pairs: bool = True) -> None:
        """Fits the graphs of all channels, then finds mutex groups and, if ``jointly``, synchronic arcs."""
        local = self.local
        planes = PlaneTable(rows, self.board, local.cardinalities, local.features, self.encoding, since, in_pairs)
        self.searched, self.counted = len(planes.rows), len(planes.every_action)
        graphs, questions, found = fit_channels(planes)
        self.local = replace(local, graphs=graphs, synchronic=no_synchronic(graphs), mutexes=(), invariants=NO_INVARIANTS)
        self._instantiate((), ())
        some = thinned(rows, SOME_ROWS)
        mutexes = find_mutexes(rows, self.board, local.cardinalities, some, self._ones(some))
        self.local = replace(self.local, mutexes=mutexes)
        layout = with_mutexes(self.fitted.layout, mutexes)
        self.fitted = replace(self.fitted, layout=layout, asked=tuple(questions), found=tuple(found))
        if not jointly:
            return
        synchronic, more_questions, more_found = fit_synchronic(planes, layout, self.fitted.usual)
        if len(synchronic.changing):
            self.local = replace(self.local, synchronic=synchronic)
            self._instantiate((*questions, *more_questions), (*found, *more_found))

    def _enforce_invariants(self, rows: TransitionBatch) -> None:
        """Enforces those invariants of the observed transitions that the model's samples would otherwise violate."""
        invariants, layout, rng = (
            find_invariants(rows, self.board, self.local.cardinalities),
            self.fitted.layout,
            np.random.default_rng(0),
        )
        each = [*(NO_INVARIANTS._replace(counts=invariants.counts[k : k + 1]) for k in range(len(invariants.counts)))]
        each += [NO_INVARIANTS._replace(observed=invariants.observed)]
        layouts = [with_invariants(layout, invariant) for invariant in each]
        violated, states = np.zeros(len(each), dtype=np.bool_), thinned(rows, SOME_ROWS).states
        for _ in range(0 if invariants.none else SIMULATED_STEPS):
            following, over = self.sample(states, rng.integers(self.n_actions, size=len(states)), rng)
            for i, alone in enumerate(layouts):
                violated[i] |= not (over | all_kept(alone, states, following)).all()
            states = following[~over]
        invariants = Invariants(invariants.counts[violated[:-1]], invariants.observed if violated[-1] else NO_INVARIANTS.observed)
        self.local = replace(self.local, invariants=invariants)
        self.fitted = replace(self.fitted, layout=with_invariants(layout, invariants))

    def _ones(self, rows: TransitionBatch) -> Floats:
        """Probability that each cell's next value is 1, [N, C, H, W]."""
        start = np.concatenate([[0], np.cumsum(self.cardinalities)])[:-1].astype(np.int64)
        return self.board.to_planes(self.marginals(rows.states, rows.actions)[:, start + 1])

    def for_space(self, space: FactoredSpace | spaces.Space[Any]) -> LocalGraphModel:
        """The same model for planes of another size, without refitting.

        Args:
            space: a stack of planes, as a Gymnasium space or a FactoredSpace.

        Raises:
            ValueError: the space is not a stack of planes, or its channels or their numbers of values differ from this model's.
        """
        space = space if isinstance(space, FactoredSpace) else FactoredSpace(space)
        if space.planes is None:
            raise ValueError(f"for_space transfers a model to planes of another size, but got {space.space}.")
        other = LocalGraphModel(space, self.n_actions, self.given, self.validation, self.parts)
        if other.local.cardinalities != self.local.cardinalities:
            raise ValueError(
                f"This model has channels with {self.local.cardinalities} values, but {space.space} has "
                f"{other.local.cardinalities}; only the rows and columns may differ."
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
            raise ValueError("These weights have neighbourhoods with an invalid radius or wrap-around; the file is damaged.")
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
            raise ValueError("These weights have graphs that test values not yet drawn; load them as they were saved.")
        mutexes = tuple(Mutex(int(c), int(k), int(i), bool(e)) for c, k, i, e in table_of(state["couplings"], 4))
        height, width = self.board.height, self.board.width
        if any(
            c.channel not in range(len(cards)) or cards[c.channel] != 2 or c.kind not in (0, 1, 2) or not c.lies_on(height, width)
            for c in mutexes
        ):
            raise ValueError("These weights have mutex groups that these planes do not have; load them into a similar model.")
        invariants = Invariants(table_of(state["counts"], 2), np.array(state["met"], dtype=np.bool_).reshape(-1))
        if any(c not in range(len(cards)) or value not in range(cards[c]) for c, value in invariants.counts) or (
            len(invariants.observed) not in (0, n_combinations(cards))
        ):
            raise ValueError("These weights have invariants that these planes do not have; load them into a similar model.")
        self.local, self.reach = LocalGraphs(graphs, synchronic, features, cards, self.encoding, mutexes, invariants), reach
        self._instantiate((), ())


def channel_cardinalities(space: FactoredSpace) -> tuple[int, ...] | None:
    """Number of values of the cells of each channel; None if it differs within any channel."""
    assert space.planes is not None
    cells = space.planes.to_planes(np.asarray(space.cardinalities)[None])[0]
    alike = (cells == cells[:, :1, :1]).all()
    return tuple(int(k) for k in cells[:, 0, 0]) if alike else None


def _sound(graphs: Graphs, synchronic: Graphs, features: Ints) -> bool:
    """Whether only synchronic graphs test the next state."""
    tested = graphs.node[graphs.node[:, FEATURE] >= 0, FEATURE]
    channels = features[features[:, 0] == NEXT, 1]
    return bool(
        not np.isin(features[tested, 0], (NEXT, NEXT_ADJACENCY)).any() and (synchronic.changing <= channels.max() + 1).all()
    )


MOST_UNTIED_CELLS = 2000
"""Maximum number of cells for which a model without tied parameters is tried; with more, it would need too many rows."""


class PlaneGraphModel(LocalGraphModel):
    """A LocalGraphModel that switches to separate graphs for each cell if these predict held-out transitions clearly better.

    This happens if planes merely encode a position and the dynamics depend on that position.

    Attributes:
        flat: the model without tied parameters if this model uses its graphs; None if this model uses tied graphs.
    """

    flat: DecisionGraphModel | None = None

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began, self.flat = time.perf_counter(), None
        report = super().fit(data, seed=seed, progress=progress)
        train, held_out = self._parts
        del self._parts
        recent = _later_half(train), _later_half(held_out)  # tied graphs may miss a change of rules that depend on the position
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
        """As in the base class; keeps training and held-out rows in the fit, to compare tied and untied models on them."""
        train, held_out, train_since = super()._split(data, seed, since)
        self._parts = train.select(np.arange(train_since.max(), len(train))), held_out  # only rows of the present rules
        return train, held_out, train_since

    def _depends_on_position(self, train: TransitionBatch, held_out: TransitionBatch, loss: float | None) -> bool:
        """Whether a quick fit without tied parameters predicts held-out transitions better than the tied model.

        Args:
            train: training transitions.
            held_out: held-out transitions.
            loss: mean held-out loss of the tied model, in nats; None if no transitions were held out.
        """
        some, tests = thinned(train, SOME_ROWS), thinned(held_out, SOME_TESTS)
        if (
            loss is None
            or loss < -PERFECT_LOG_PROB
            or len(self.cardinalities) > MOST_UNTIED_CELLS
            or min(len(some), len(tests)) < 2
        ):
            return False
        flat = DecisionGraphModel(self.cardinalities, self.n_actions, parts=self.parts)
        flat.fitted = fit_graphs(
            self.cardinalities,
            self.encoding,
            some,
            all_redrawn(np.zeros(len(some), dtype=np.bool_), len(self.cardinalities)),
            False,
            False,
        )
        logs = flat.log_prob(tests.states, tests.actions, tests.next_states, tests.terminated)
        return better(np.maximum(logs, IMPOSSIBLE_LOG_PROB), np.full(len(logs), -loss))

    def for_space(self, space: FactoredSpace | spaces.Space[Any]) -> LocalGraphModel:
        """See LocalGraphModel.

        Raises:
            ValueError: also if the dynamics depend on the position.
        """
        if self.flat is not None:
            raise ValueError(
                "The learned dynamics depend on the position on the planes, so they do not apply to planes of another size."
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
    """Mean held-out loss in nats; infinite without held-out transitions."""
    return float("inf") if report.predictor_loss is None else report.predictor_loss
