"""A dynamic Bayesian network whose conditional distributions are decision graphs, learned from transitions."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn.arrays import FEATURE, NODE, OFF, ON, SAVED, Graphs, build, from_arrays, n_features, table_of, to_arrays
from mbagent.models.dbn.change_points import last_changes
from mbagent.models.dbn.effects import (
    EffectModel,
    Operand,
    best_effect_models,
    candidates,
    likely_operands,
    more_folds,
    smoothing_of,
)
from mbagent.models.dbn.features import Layout, action_encoding, is_lone_bit, layout_with_mutexes, make_layout
from mbagent.models.dbn.fitting import ROWS_AT_ONCE, Fitted, Resets, all_redrawn, fit_graphs, flag_resets, no_synchronic
from mbagent.models.dbn.joint_events import Pattern, event_chances, excess, factors_of, find_patterns, settled
from mbagent.models.dbn.mutex import find_groups
from mbagent.models.dbn.successors import GraphPredictions
from mbagent.models.fit_report import FitReport, Variable, VariableReport, describe
from mbagent.models.held_out import PERFECT_LOG_PROB, SOME_ROWS, SOME_TESTS, better, steps_in_a_row, thinned, with_past, within
from mbagent.spaces import FactoredSpace, PlaneLayout
from mbagent.types import Bools, Floats


def tested_features(graphs: Graphs, variable: int) -> set[int]:
    """Features that the graphs of a variable test."""
    if variable not in graphs.changing:
        return set()
    begin, end = graphs.entries[graphs.pairs[variable]], graphs.entries[graphs.pairs[variable + 1]]
    stack, visited = graphs.entry[begin:end, NODE].tolist(), set()
    while stack:
        node = stack.pop()
        if node not in visited:
            visited.add(node)
            if graphs.node[node, FEATURE] >= 0:
                stack += graphs.node[node, [OFF, ON]].tolist()
    return {int(graphs.node[node, FEATURE]) for node in visited} - {-1}


def depends_on_action(graphs: Graphs, variable: int, layout: Layout) -> bool:
    """Whether the graphs of a variable differ between action classes."""
    n, first = int(layout.outputs[variable]), int(graphs.pairs[variable])

    def entries_of(pair: int) -> list[tuple[int, int]]:
        entries: list[tuple[int, int]] = graphs.entry[graphs.entries[first + pair] : graphs.entries[first + pair + 1]].tolist()
        return entries

    return any(
        entries_of(action_class * n + value) != entries_of(value)
        for value in range(n)
        for action_class in range(1, layout.encoding.n_action_classes)
    )


def parent_factors(layout: Layout, features: set[int]) -> set[int]:
    """Factors that the given features test in the current state; other features are ignored."""
    return {int(layout.factor[feature]) for feature in features if feature < len(layout.factor)}


def flat_variables(layout: Layout, graphs: Graphs, synchronic: Graphs) -> list[Variable]:
    """Factors and mutex groups that have graphs, each with its parents except itself."""
    n, after, found = len(layout.factor), len(layout.factor) + layout.encoding.n_features, []
    for variable in graphs.changing[graphs.changing < len(layout.outputs) - 2]:
        factors = tuple(int(f) for f in layout.members[layout.first[variable] : layout.first[variable + 1]])
        name = f"factor {factors[0]}" if len(factors) == 1 else f"factors {factors[0]}, {factors[1]}, …"
        features = tested_features(graphs, int(variable)) | tested_features(synchronic, int(variable))
        parents = [f"factor {f}" for f in sorted(parent_factors(layout, features) - set(factors))]
        if depends_on_action(graphs, int(variable), layout) or any(n <= feature < after for feature in features):
            parents.insert(0, "action")
        later = {int(layout.factor[feature - after]) for feature in features if feature >= after}
        found.append(Variable(name, factors, (*parents, *(f"next factor {f}" for f in sorted(later)))))
    return found


IMPOSSIBLE_LOG_PROB = -200.0
"""Log-probability that counts for an impossible transition when models are compared."""

FEWEST_RESETS = 4
"""Minimum number of candidate resets for which a regime of its own is tried."""

ENOUGH_RESETS, MOST_FOLDS = 5, 10
"""Held-out candidate resets that are enough to decide about the regime; if one split has fewer, further splits follow, up to a
maximum number."""

MOST_VALUES = 200_000_000
"""Maximum number of factor values that a model is fitted to, at about ten bytes each; of more transitions, an evenly spaced
subset is used."""

MOST_EFFECT_COUNTS = 20_000_000
"""Maximum number of contexts times features of a question for which effects other than absolute ones are tried."""

DESCRIBED = 2000
"""Held-out transitions that the figures of single variables are computed from."""

WORTH_TELLING = 0.03
"""Minimum gain from the previous step for it to be reported, as a share of one nat plus the held-out loss."""


class DecisionGraphModel(GraphPredictions):
    """A transition model in which small decision graphs over a few relevant features predict each variable's next value.

    A group of bits of which exactly one is always on is drawn as one variable. Resets (rare transitions that redraw almost
    everything) have their own graphs, and one more graph predicts whether a reset happens. Probabilities are exact, with one
    exception: if a variable never changed, ``log_prob`` and ``marginals`` give it a tiny probability of changing, and samples
    ignore this probability. A fit takes a few seconds, or longer if the data contain very many factor values.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        validation: share of episodes held out, for the report and for choices between variants of the model; the final graphs
            are fitted to all rows.
        parts: number of values of each action component, such as (2, 2, 2) for three switches; each component then has its own
            features, and joint actions are numbered as by ``ActionEnumeration``. None: actions have no components.

    Raises:
        ValueError: the product of ``parts`` is not ``n_actions``.
    """

    def __init__(
        self, cardinalities: tuple[int, ...], n_actions: int, validation: float = 0.1, parts: Sequence[int] | None = None
    ) -> None:
        """See the class."""
        super().__init__(cardinalities, n_actions)
        self.validation, self.parts = validation, (n_actions,) if parts is None else tuple(parts)
        if math.prod(self.parts) != n_actions:
            raise ValueError(f"Action parts with {self.parts} values make {math.prod(self.parts)} actions, not {n_actions}.")
        self.encoding, self._with_resets = action_encoding(self.parts), False
        layout = make_layout(self.cardinalities, (), self.encoding)
        none = np.zeros(0, dtype=np.int64)
        nothing = build(
            layout, (), (), [smoothing_of(int(n), self.encoding.n_action_classes, none, none, none) for n in layout.outputs], 1e-9
        )
        self.fitted = Fitted(layout, nothing, no_synchronic(nothing), nothing, no_synchronic(nothing), False, (), ())

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""
        began, n_observed = time.perf_counter(), len(data)
        data = within(data, MOST_VALUES)
        rows, resets = data.rows(), self._resets(data, seed)
        self._with_resets = bool(resets.any())
        since = self._since(rows, resets)
        train, held_out, train_since = self._split(data, seed, since)
        if progress is not None:
            progress(0.4)
        flagged = flag_resets(train.before, train.after) & self._with_resets
        effects = self._effects(train, flagged, held_out)
        fit = partial(fit_graphs, self.cardinalities, self.encoding, effects=effects)
        self.fitted = fit(train, all_redrawn(flagged, len(self.cardinalities)), since=train_since)
        likelihood, jointly = self._compare_synchronic(held_out)
        fit = partial(fit, jointly=jointly)
        plain = self.fitted if jointly else replace(self.fitted, synchronic=no_synchronic(self.fitted.usual))
        patterns = find_patterns(plain, rows.select(~resets & (np.arange(len(rows)) >= since.max(initial=0))))
        if patterns and not self._fit_events(partial(fit, since=train_since), plain, patterns, train, flagged, held_out):
            patterns = []
        if patterns:
            likelihood = self._likelihood(self.fitted, held_out)
        if progress is not None:
            progress(0.7)
        exact, (variables, calibration) = self._exact_match(held_out), self._described(held_out)
        redrawn = all_redrawn(resets, len(self.cardinalities))
        if patterns:
            events = settled(event_chances(self.fitted, rows, patterns)) & ~resets
            redrawn = self._redrawn(resets, events, patterns)
        self.fitted = fit(rows, redrawn, since=since)
        if progress is not None:
            progress(1.0)
        figures = {"nodes": float(len(self.fitted.usual.node)), "events": float(redrawn.rows.sum())}
        figures |= {"changed": float((since > 0).sum()), "left out": float(n_observed - len(rows))}
        report = self._report((len(rows), len(held_out)), likelihood, exact, figures)
        memory = self._memory(train, held_out)
        report = replace(report, variables=variables, calibration=calibration, memory=memory)
        return replace(report, seconds=time.perf_counter() - began)

    def _fit_events(
        self,
        fit: Callable[[TransitionBatch, Resets], Fitted],
        plain: Fitted,
        patterns: Sequence[Pattern],
        train: TransitionBatch,
        resets: Bools,
        held_out: TransitionBatch,
    ) -> bool:
        """Fits the training rows with joint events; keeps the fit, and returns True, unless it predicts clearly worse."""
        candidate = fit(train, self._redrawn(resets, settled(excess(plain, train, patterns)) & ~resets, patterns))
        if better(self._logs(plain, held_out), self._logs(candidate, held_out)):
            return False
        self.fitted = candidate
        return True

    def _redrawn(self, resets: Bools, events: Bools, patterns: Sequence[Pattern]) -> Resets:
        """Resets and joint events as one ``Resets``; redraws everything if there are any resets, else the patterns' factors."""
        own = factors_of(self.fitted, patterns) | resets.any()
        return Resets(resets | events, own, jointly=len(patterns) > 1 or bool(resets.any()))

    def _since(self, rows: TransitionBatch, resets: Bools) -> NDArray[np.int64]:
        """First row from which the present rules of each factor and of ``terminated`` hold, int64 [F + 1]."""
        usual, without_resets = np.flatnonzero(~resets), copy(self)
        without_resets._with_resets = False
        groups = find_groups(self.cardinalities, rows.states, rows.next_states, ~resets)
        variable = np.arange(len(self.cardinalities) + 1)
        for group in groups:
            variable[list(group)] = group[0]
        variable = np.unique(variable, return_inverse=True)[1]
        grouped = np.isin(np.arange(len(self.cardinalities)), [f for group in groups for f in group])

        def log_predictive(train: TransitionBatch, tests: TransitionBatch) -> Floats:
            logs = without_resets._factor_log_probs(train, tests)
            logs[:, :-1][grouped & (tests.next_states == 0)] = 0.0  # only the bit that is on counts for a group
            return np.stack([logs[:, variable == v].sum(axis=1) for v in range(variable.max() + 1)], axis=1)

        since = last_changes(rows.select(usual), variable.max() + 1, log_predictive)
        return np.where(since > 0, usual[since], 0)[variable]

    def _split(
        self, data: TransitionDataset, seed: int, since: NDArray[np.int64]
    ) -> tuple[TransitionBatch, TransitionBatch, NDArray[np.int64]]:
        """Training rows, held-out rows, and ``since`` as training-row indices; only rows after the last change are held out."""
        rows, mask = data.rows(), data.held_out(self.validation, seed)
        if not since.any():
            return (*data.split(self.validation, seed), since)
        new = np.arange(len(rows)) >= since.max()
        mask &= new
        if mask.sum() < new.sum() / 20:  # few long episodes: a run of steps instead
            mask = new & (np.cumsum(new) > 0.9 * new.sum())
        return rows.select(~mask), rows.select(mask), np.searchsorted(np.flatnonzero(~mask), since)

    def _factor_log_probs(self, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """Log-probabilities [T, F + 1] of the next factors and ``terminated`` in ``tests``, after a quick fit to ``train``."""
        quick = self._quickly_fitted(train)
        probs, start = quick.marginals(tests.states, tests.actions), np.concatenate([[0], np.cumsum(self.cardinalities)])
        chosen = np.take_along_axis(probs, start[:-1] + tests.after, axis=1)
        ends = [
            quick.log_prob(tests.states, tests.actions, tests.next_states, np.full(len(tests), over)) for over in (False, True)
        ]
        ends = [np.maximum(logs, -1e3) for logs in ends]  # an impossible state is no evidence about the end
        over = np.where(tests.terminated, ends[1], ends[0]) - np.logaddexp(*ends)
        return np.concatenate([np.log(chosen.clip(1e-9)), over.clip(-20.0)[:, None]], axis=1)

    def _described(self, held_out: TransitionBatch) -> tuple[tuple[VariableReport, ...], float | None]:
        """Reports of the variables, and the calibration, on some held-out rows."""
        some = thinned(held_out, DESCRIBED)
        return describe(self.cardinalities, self.marginals(some.states, some.actions), some, self._variables())

    def _variables(self) -> list[Variable]:
        """The variables that are described in the report."""
        return flat_variables(self.fitted.layout, self.fitted.usual, self.fitted.synchronic)

    def _memory(self, train: TransitionBatch, held_out: TransitionBatch) -> float | None:
        """Gain in log-likelihood from also knowing the previous step, in nats per transition; see FitReport."""
        known, tests = steps_in_a_row(train, SOME_ROWS), steps_in_a_row(held_out, SOME_TESTS)
        if min(len(known[0]), len(tests[0])) < 2:
            return None
        logs = self._quick_log_probs(known[0], tests[0])
        if logs.mean() > PERFECT_LOG_PROB:
            return 0.0
        space, longer = with_past(*known, self.cardinalities, self.encoding, self._planes())
        _, longer_tests = with_past(*tests, self.cardinalities, self.encoding, self._planes())
        further = self._with_memory(space)._quick_log_probs(longer, longer_tests)
        gain = float((further - logs).mean())
        return gain if better(further, logs) and gain > WORTH_TELLING * (1.0 - logs.mean()) else 0.0

    def _planes(self) -> PlaneLayout | None:
        return None

    def _with_memory(self, space: FactoredSpace) -> DecisionGraphModel:
        return DecisionGraphModel(space.cardinalities, self.n_actions, parts=self.parts)

    def _quick_log_probs(self, train: TransitionBatch, tests: TransitionBatch) -> Floats:
        """Log-probabilities of ``tests`` after a quick fit to ``train``."""
        logs = self._quickly_fitted(train).log_prob(tests.states, tests.actions, tests.next_states, tests.terminated)
        return np.maximum(logs, IMPOSSIBLE_LOG_PROB)

    def _quickly_fitted(self, rows: TransitionBatch) -> Self:
        """A copy of this model that is fitted to other rows, without synchronic arcs."""
        resets = all_redrawn(flag_resets(rows.before, rows.after) & self._with_resets, len(self.cardinalities))
        return self._with(fit_graphs(self.cardinalities, self.encoding, rows, resets, True, False))

    def _with(self, fitted: Fitted) -> Self:
        """A copy of this model with other graphs."""
        other = copy(self)
        other.fitted = fitted
        return other

    def _compare_synchronic(self, held_out: TransitionBatch) -> tuple[float, bool]:
        """Held-out log-likelihood of the better variant, and whether that is the one with synchronic arcs."""
        likelihood = self._likelihood(self.fitted, held_out)
        if len(self.fitted.synchronic.changing) == 0 or len(held_out) == 0:
            return likelihood, len(self.fitted.synchronic.changing) > 0
        without = self._likelihood(replace(self.fitted, synchronic=no_synchronic(self.fitted.usual)), held_out)
        return max(likelihood, without), likelihood > without

    def _report(self, sizes: tuple[int, int], likelihood: float, exact: float, figures: Mapping[str, float]) -> FitReport:
        """The report of a fit with ``sizes`` (training, held-out) rows; if none were held out, it has no held-out scores."""
        held_out = sizes[1] > 0
        splits = [sum(split.feature >= 0 for split in search.splits) for search in self.fitted.found]
        return FitReport(
            n_train=sizes[0],
            n_validation=sizes[1],
            epochs=1,
            seconds=0.0,
            predictor_loss=-likelihood if held_out else None,
            exact_match=exact if held_out else None,
            log={"questions": float(len(splits)), "splits": float(np.mean(splits)) if splits else 0.0, **figures},
        )

    def _resets(self, data: TransitionDataset, seed: int) -> Bools:
        """Which rows are resets, bool [N]; none unless a separate regime for resets improves held-out likelihood."""
        rows = data.rows()
        resets, gain, tested = flag_resets(rows.before, rows.after), 0.0, 0
        for split in range(MOST_FOLDS if resets.sum() >= FEWEST_RESETS else 0):
            train, held_out = data.split(self.validation, seed + split)
            observed = flag_resets(train.before, train.after)
            with_resets, without = (
                self._likelihood(
                    fit_graphs(
                        self.cardinalities, self.encoding, train, all_redrawn(flags, len(self.cardinalities)), False, False
                    ),
                    held_out,
                )
                for flags in (observed, np.zeros_like(observed))
            )
            gain += (with_resets - without) * len(held_out)
            tested += int(flag_resets(held_out.before, held_out.after).sum())
            if tested >= ENOUGH_RESETS:
                break
        return resets & (gain > 0.0)

    def _effects(self, train: TransitionBatch, resets: Bools, held_out: TransitionBatch) -> dict[int, EffectModel]:
        """Effect of each factor with more than two values: the one with the best held-out likelihood."""
        n_contexts, n_features = self.encoding.n_action_classes * max(self.cardinalities, default=0), 2 * sum(self.cardinalities)
        ordinal = [f for f, cardinality in enumerate(self.cardinalities) if cardinality > 2]
        if not ordinal or n_contexts * n_features > MOST_EFFECT_COUNTS or len(held_out) == 0:
            return {}
        folds = [(train, resets, held_out)]
        folds += [(train.select(~out), resets[~out], train.select(out)) for out in more_folds(train, held_out)]

        def log_probs(effect_models: Sequence[EffectModel]) -> Floats:
            named = dict(zip(ordinal, effect_models, strict=True))
            return np.concatenate([self._log_probs_with_effects(named, *fold) for fold in folds])

        def operands() -> Sequence[tuple[Operand, int] | None]:
            return likely_operands(ordinal, candidates(self.cardinalities, self.parts), train.select(~resets))

        return dict(zip(ordinal, best_effect_models(log_probs, len(ordinal), operands), strict=True))

    def _log_probs_with_effects(
        self, effect_models: Mapping[int, EffectModel], train: TransitionBatch, resets: Bools, held_out: TransitionBatch
    ) -> Floats:
        """Log-probability [N, K] of the held-out next values of the K factors, each under its given effect."""
        flagged = all_redrawn(resets, len(self.cardinalities))
        fitted = self._with(fit_graphs(self.cardinalities, self.encoding, train, flagged, False, False, effect_models))
        start = np.concatenate([[0], np.cumsum(self.cardinalities)]).astype(np.int64)
        probs, factors = fitted.marginals(held_out.states, held_out.actions), list(effect_models)
        chosen = np.take_along_axis(probs, start[factors] + held_out.after[:, factors], axis=1)
        logs: Floats = np.log(chosen.clip(1e-9))
        return logs

    def _likelihood(self, fitted: Fitted, rows: TransitionBatch) -> float:
        """Mean log-probability of transitions; see ``_logs``."""
        return float(self._logs(fitted, rows).mean()) if len(rows) else 0.0

    def _logs(self, fitted: Fitted, rows: TransitionBatch) -> Floats:
        """Log-probability of each transition [N]; impossible ones count as ``IMPOSSIBLE_LOG_PROB``."""
        model = self._with(fitted)
        parts = [model.log_prob(p.states, p.actions, p.next_states, p.terminated) for p in rows.parts(ROWS_AT_ONCE)]
        logs: Floats = np.maximum(np.concatenate([np.zeros(0), *parts]), IMPOSSIBLE_LOG_PROB)
        return logs

    def _exact_match(self, rows: TransitionBatch) -> float:
        hits = 0
        for part in rows.parts(ROWS_AT_ONCE):
            states, terminated = self.likeliest(part.states, part.actions)
            hits += int(((states == part.after).all(axis=1) & (terminated == part.terminated)).sum())
        return hits / len(rows) if len(rows) else 1.0

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        fitted = self.fitted
        layout, grouped = fitted.layout, np.flatnonzero(np.diff(fitted.layout.first) > 1)
        groups = [
            (int(variable), int(f))
            for variable in grouped
            for f in layout.members[layout.first[variable] : layout.first[variable + 1]]
        ]
        state: dict[str, NDArray[Any]] = {
            "groups": np.asarray(groups, dtype=np.int64).reshape(-1, 2),
            "couplings": fitted.layout.mutex_of.copy(),
            "has_event": np.asarray(fitted.has_reset),
        }
        named = {"usual": fitted.usual, "late": fitted.synchronic, "event": fitted.reset}
        if len(fitted.reset_synchronic.changing):
            named["late_event"] = fitted.reset_synchronic
        for name, graphs in named.items():
            state.update({f"{name}.{part}": array for part, array in to_arrays(graphs).items()})
        return state

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of these factors and actions; nothing is changed then.
        """
        names = ["usual", "late", "event", *(["late_event"] if any(key.startswith("late_event.") for key in state) else [])]
        known = {"groups", "couplings", "has_event", *(f"{name}.{part}" for name in names for part in SAVED)}
        wrong = sorted(known ^ set(state))
        if wrong:
            raise ValueError(f"These weights are not those of a decision graph model (first difference: {wrong[0]!r}).")
        pairs = table_of(state["groups"], 2)
        groups = [tuple(int(f) for f in pairs[pairs[:, 0] == variable, 1]) for variable in np.unique(pairs[:, 0])]
        members = pairs[:, 1]
        bits = np.flatnonzero(np.asarray(self.cardinalities) == 2)
        if len(np.unique(members)) < len(members) or not np.isin(members, bits).all() or any(len(g) < 2 for g in groups):
            raise ValueError(
                "These weights have groups of bits that this model does not have; load them into a model of the same environment."
            )
        layout = make_layout(self.cardinalities, groups, self.encoding)
        mutexes = np.asarray(state["couplings"], dtype=np.int64).reshape(-1)
        mutex_members = np.flatnonzero(mutexes >= 0)
        if len(mutexes) != len(layout.outputs) or not is_lone_bit(layout)[mutex_members].all():
            raise ValueError(
                "These weights have mutex groups that do not fit this model; load them into a model of the same environment."
            )
        layout = layout_with_mutexes(
            layout, [mutex_members[mutexes[mutex_members] == q] for q in np.unique(mutexes[mutex_members])]
        )
        now, both = n_features(layout), n_features(layout) + len(layout.factor)
        usual, reset, *late = (
            from_arrays({part: state[f"{name}.{part}"] for part in SAVED}, layout, both if name.startswith("late") else now)
            for name in sorted(names, key=lambda name: name.startswith("late"))
        )
        late += [no_synchronic(reset)] * (2 - len(late))
        self.fitted = Fitted(layout, usual, late[0], reset, late[1], bool(np.any(state["has_event"])), (), ())
