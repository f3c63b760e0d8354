"""Fitting decision graphs to transitions: variables, resets, targets, splits, and synchronic arcs.

A variable may depend on the next values of others (synchronic arcs, the paper's conditioner of section 3.2). Only variables whose
errors are correlated with those of an earlier one get such arcs, and, as with a causal mask, variable i depends only on y_<i, so
that probabilities stay exact. Termination comes last, since it mostly depends on the next state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from mbagent.data import Factors, TransitionBatch
from mbagent.models.dbn import sampling
from mbagent.models.dbn.arrays import FEATURE, Graphs, build
from mbagent.models.dbn.effects import ABSOLUTE_EFFECT, EffectModel, for_all_actions, questions_for_effect, smoothing_for_effect
from mbagent.models.dbn.features import (
    ActionEncoding,
    Layout,
    Observed,
    Question,
    distinct,
    feature_kinds,
    feature_table,
    is_lone_bit,
    layout_with_mutexes,
    make_layout,
    shown,
    variable_values,
)
from mbagent.models.dbn.mutex import find_cliques, find_groups
from mbagent.models.dbn.score import Search
from mbagent.models.dbn.split_search import find_splits
from mbagent.models.systematic_sampling import NEGLIGIBLE
from mbagent.types import Bools, Floats, Ints

USUAL = 0.95
"""Share of transitions that always count as usual."""


def flag_resets(states: Factors, next_states: Factors) -> Bools:
    """Which transitions are candidates for resets, bool [N].

    They change factors that never change in usual transitions, which change at most twice as many factors as the quantile
    ``USUAL``.

    Args:
        states: int [N, F].
        next_states: int [N, F].
    """
    changed = states != next_states
    count = changed.sum(axis=1)
    usual = count <= 2 * max(1.0, float(np.quantile(count, USUAL))) if len(count) else np.ones(0, dtype=np.bool_)
    constant = ~changed[usual].any(axis=0)
    resets: Bools = changed[:, constant].any(axis=1)
    return resets


class Resets(NamedTuple):
    """Rare transitions with graphs of their own: resets, which redraw almost everything, and joint events.

    Attributes:
        rows: which transitions these are, bool [N].
        redrawn: which factors, and last ``terminated``, have their own graphs in these rows, bool [F + 1]; others keep the usual
            ones.
        jointly: whether to search for synchronic arcs between the redrawn variables.
    """

    rows: Bools
    redrawn: Bools
    jointly: bool = False


def all_redrawn(rows: Bools, n_factors: int) -> Resets:
    """Resets [N] that redraw everything."""
    return Resets(rows, np.ones(n_factors + 1, dtype=np.bool_))


UNCERTAIN = 2.0
"""Variance summed over all rows from which a feature counts as uncertain."""

MANY = 8.0
"""Sum of the products of two features' variances from which the sum of the products of their errors is about normal."""

APART = 6.0
"""Standard errors by which two features' errors must be correlated, beyond the expected maximum of all pairs by chance."""

MOST_ERRORS = 4_000_000
"""Maximum number of entries of the table of errors; of more rows, an evenly spaced subset is used."""


ROWS_AT_ONCE = 2000
"""Rows that are converted to wide integers at once, for the compiled kernels."""


def uncertain_rows(rows: TransitionBatch, layout: Layout, graphs: Graphs, variables: Ints) -> Bools:
    """In which rows the given variables need their synchronic graphs, bool [N, len(variables)]."""
    work = sampling.work_space(layout, graphs, graphs)
    found = [sampling.uncertain(part.states, part.actions, work, variables) for part in rows.parts(ROWS_AT_ONCE)]
    return np.concatenate([np.zeros((0, len(variables)), dtype=np.bool_), *found])


class Asked(NamedTuple):
    """A variable with synchronic arcs, and the features of the next state that it may depend on.

    Attributes:
        variable: its number.
        features: features of the next state, numbered as those of the current state.
    """

    variable: int
    features: Ints


def probabilities(layout: Layout, graphs: Graphs, rows: TransitionBatch) -> Floats:
    """Marginal probability of each feature of the next state for each row, [N, D']."""
    start = np.concatenate([[0], np.cumsum(_cardinalities(layout))]).astype(np.int64)
    probs = sampling.marginals(rows.states, rows.actions, layout, graphs, start)
    total = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(probs, axis=1)], axis=1)
    result: Floats = total[:, start[layout.factor] + layout.top + 1] - total[:, start[layout.factor] + layout.value]
    return result.clip(0.0, 1.0)


def go_together(error: Floats, other: Floats, spread: Floats, other_spread: Floats, n_tried: int) -> bool:
    """Whether two features' errors [...] with variances [...] are correlated, as one of ``n_tried`` tests."""
    one, two, three, four = (part.reshape(-1, 1) for part in (error, other, spread, other_spread))
    return bool(_correlated(one, two, three, four, n_tried)[0, 0])


def _correlated(error: Floats, other: Floats, spread: Floats, other_spread: Floats, n_tried: int) -> Bools:
    """Which features' errors are correlated, bool [D, E], from errors and variances [N, D] and [N, E].

    The test statistic is the sum of the products of errors; for rare values, it is the number of rows in which both had their
    less probable value, which is Poisson distributed if they are independent.
    """
    limit = APART + np.sqrt(2.0 * np.log(max(n_tried, 2)))
    products, variances = error.T @ other, spread.T @ other_spread
    result: Bools = (variances > MANY) & (np.abs(products) > limit * np.sqrt(variances))
    few = variances <= MANY
    if few.any():
        both = _unexpected(error).T @ _unexpected(other)
        expected = _minority(spread).T @ _minority(other_spread)
        as_many = scipy.special.gammainc(np.maximum(both, 1.0), expected)  # P(Poisson >= both)
        result |= few & (both > 0.0) & (as_many < scipy.special.ndtr(-limit))
    return result


def _unexpected(error: Floats) -> Floats:
    """1 where the less probable value was observed, else 0."""
    result: Floats = (np.abs(error) > 0.5).astype(np.float64)
    return result


def _minority(spread: Floats) -> Floats:
    """Probability of the less probable of two values, from the variance."""
    result: Floats = 0.5 - np.sqrt(np.maximum(0.25 - spread, 0.0))
    return result


def feature_owners(layout: Layout) -> Ints:
    """Variable of each feature, int64 [D']."""
    variable_of = np.empty(layout.n_factors, dtype=np.int64)
    variable_of[layout.members] = np.repeat(np.arange(len(layout.outputs)), np.diff(layout.first))
    owner: Ints = variable_of[layout.factor]
    return owner


def find_dependent(layout: Layout, graphs: Graphs, rows: TransitionBatch, usual: Ints) -> list[Asked]:
    """Variables that may need synchronic arcs, in their order; ``terminated`` last, with the features of all changing variables.

    Args:
        layout: the variables, with their mutex groups.
        graphs: without synchronic arcs.
        rows: N transitions.
        usual: indices of the non-reset rows, int64 [R].
    """
    n_features, last, owner = len(layout.factor), len(layout.outputs) - 2, feature_owners(layout)
    most = max(1000, MOST_ERRORS // max(n_features, 1))
    some = rows.select(usual[np.linspace(0, len(usual) - 1, min(len(usual), most)).astype(np.int64)])
    found = [Asked(variable, features) for variable, features in _dependent(layout, graphs, some, owner).items()]
    if last in graphs.changing:
        found.append(Asked(last, np.flatnonzero(np.isin(owner, graphs.changing))))
    return found


def _dependent(layout: Layout, graphs: Graphs, rows: TransitionBatch, owner: Ints) -> Mapping[int, Ints]:
    """Features of earlier variables whose errors are correlated with those of a variable, by variable in ascending order."""
    if len(rows) == 0 or len(owner) == 0:
        return {}
    probs = probabilities(layout, graphs, rows)
    spread = probs * (1.0 - probs)
    uncertain = np.flatnonzero(spread.sum(axis=0) > UNCERTAIN)
    error = shown(layout, rows.after, uncertain) - probs[:, uncertain]
    correlated = np.zeros((len(uncertain), len(uncertain)), dtype=np.bool_)
    for action in np.unique(rows.actions):  # correlations may have opposite signs under different actions
        e, v = error[rows.actions == action], spread[rows.actions == action][:, uncertain]
        correlated |= _correlated(e, e, v, v, len(uncertain))
    variable, mutex = owner[uncertain], layout.mutex_of[owner[uncertain]]
    earlier = variable[:, None] < variable
    together = (mutex[:, None] == mutex) & (mutex >= 0)
    arcs = earlier & ~together & (mutex < 0) & correlated
    return {
        int(u): uncertain[arcs[:, variable == u].any(axis=1)]
        for u in np.unique(variable[arcs.any(axis=0)])
        if arcs[:, variable == u].any()
    }


NO_EFFECTS: Mapping[int, EffectModel] = MappingProxyType({})
"""All factors have absolute effects."""

MUTEX_ROWS = 4000
"""Rows from which it is estimated how often bits would be on together if they were independent."""


@dataclass(frozen=True)
class Fitted:
    """Fitted graphs.

    Attributes:
        layout: the variables.
        usual: graphs of all variables without synchronic arcs, and of whether a reset happens.
        synchronic: graphs of the variables that are drawn after the others, given those variables' next values, in order.
        reset: graphs of the next state in a reset; as ``usual`` if there are no resets.
        reset_synchronic: as ``synchronic``, in a reset.
        has_reset: whether there are resets.
        asked, found: questions and finished searches of ``usual`` and ``synchronic``.
    """

    layout: Layout
    usual: Graphs
    synchronic: Graphs
    reset: Graphs
    reset_synchronic: Graphs
    has_reset: bool
    asked: Sequence[Question]
    found: Sequence[Search]


def for_planning(fitted: Fitted) -> Fitted:
    """The graphs for planning, where negligible values are possible outcomes only if they were observed."""
    names = ("usual", "synchronic", "reset", "reset_synchronic")
    return replace(fitted, **{name: replace(getattr(fitted, name), noise=np.full(1, NEGLIGIBLE)) for name in names})


class _Table:
    """Transitions as values of variables, with a table of their features.

    Args:
        layout: the variables.
        rows: N transitions.
        resets: which of them are resets, bool [N].
        effects: effects of factors; absolute if missing.
        since: first row that counts for each factor and for ``terminated``, int64 [F + 1]; None for all.
    """

    def __init__(
        self, layout: Layout, rows: TransitionBatch, resets: Bools, effects: Mapping[int, EffectModel], since: Ints | None
    ) -> None:
        """See the class."""
        self.layout, self.rows = layout, rows
        self.since = np.zeros(len(layout.outputs), dtype=np.int64)
        if since is not None:
            members = [layout.members[begin:end] for begin, end in zip(layout.first, layout.first[1:], strict=False)]
            self.since[:-2] = [since[factors].max() for factors in members[:-2]]
            self.since[-2] = since[-1]
        lone = np.flatnonzero(np.diff(layout.first) == 1)
        self.effects = {
            int(variable): effects.get(int(layout.members[layout.first[variable]]), ABSOLUTE_EFFECT) for variable in lone
        }
        flags = np.stack([rows.terminated, resets], axis=1).astype(np.uint8)
        self.now = np.concatenate([variable_values(layout, rows.before), np.zeros_like(flags)], axis=1)
        self.then = np.concatenate([variable_values(layout, rows.after), flags], axis=1)
        first, self.pattern = distinct(rows.before, rows.actions)
        self.first, self.features = first, feature_table(layout, rows.before[first], rows.actions[first])

    def ask(self, variable: int, which: Ints) -> list[Question]:
        """The questions about a variable, from some rows."""
        return self.questions(variable, self.observed(variable).select(self.counting(variable, which)))

    def counting(self, variable: int, which: Ints) -> Ints:
        """Those of some rows that count for a variable."""
        result: Ints = which[which >= self.since[variable]]
        return result

    def questions(self, variable: int, observed: Observed) -> list[Question]:
        """The questions about a variable, from rows with any patterns."""
        effect, operand = self.effects.get(variable, ABSOLUTE_EFFECT)
        n_action_classes = self.layout.encoding.n_action_classes if operand is None else operand.cardinality
        found = questions_for_effect(effect, variable, int(self.layout.outputs[variable]), n_action_classes, observed)
        return found if operand is None else [replace(one, operand=operand.features(self.layout)) for one in found]

    def observed(self, variable: int) -> Observed:
        """A variable's values in all rows, with the action class or the operand's value."""
        now, then = (values[:, variable].astype(np.int64) for values in (self.now, self.then))
        operand = self.effects.get(variable, ABSOLUTE_EFFECT).operand
        action_classes = self.layout.encoding.action_class[self.rows.actions] if operand is None else operand.of(self.rows)
        return Observed(self.pattern, action_classes, now, then)

    def kinds(self, observed: Ints) -> Ints:
        """Kind of each feature, from some rows."""
        changing = (self.rows.before[observed] != self.rows.after[observed]).any(axis=0)
        return feature_kinds(self.layout, self.rows.before[observed], changing)

    def build(self, questions: Sequence[Question], found: Sequence[Search], observed: Sequence[Ints], still: float) -> Graphs:
        """The graphs; smoothing of each variable is estimated from its observed rows."""
        smoothings, n_action_classes = [], self.layout.encoding.n_action_classes
        for variable, cardinality in enumerate(self.layout.outputs):
            some = self.observed(variable).select(self.counting(variable, observed[variable]))
            effect, operand = self.effects.get(variable, ABSOLUTE_EFFECT)
            smoothing = smoothing_for_effect(
                effect, int(cardinality), n_action_classes if operand is None else operand.cardinality, some
            )
            smoothings.append(smoothing if operand is None else for_all_actions(smoothing, operand.cardinality, n_action_classes))
        return build(self.layout, questions, found, smoothings, still)


def no_synchronic(graphs: Graphs) -> Graphs:
    """Graphs of no variable, for models without synchronic arcs."""
    node = graphs.node.copy()
    node[:, FEATURE] = -1
    return replace(graphs, changing=np.zeros(0, dtype=np.int64), node=node)


class Part(NamedTuple):
    """Graphs with the questions that they answer and the finished searches.

    Attributes:
        graphs: the graphs.
        asked, found: questions and searches, in the same order.
    """

    graphs: Graphs
    asked: Sequence[Question] = ()
    found: Sequence[Search] = ()

    def of(self, variables: Bools) -> tuple[list[Question], list[Search]]:
        """Questions and searches of some variables, given as mask [U]."""
        chosen = [
            (question, search) for question, search in zip(self.asked, self.found, strict=True) if variables[question.variable]
        ]
        return [question for question, _ in chosen], [search for _, search in chosen]


def fit_graphs(
    cardinalities: Sequence[int],
    encoding: ActionEncoding,
    rows: TransitionBatch,
    resets: Resets,
    in_pairs: bool = True,
    jointly: bool = True,
    effects: Mapping[int, EffectModel] = NO_EFFECTS,
    since: Ints | None = None,
) -> Fitted:
    """Fits the graphs of all variables, of resets, and of synchronic arcs.

    Args:
        cardinalities: number of values of each factor.
        encoding: the actions.
        rows: N transitions.
        resets: which of them are resets.
        in_pairs: whether to search for pairwise splits, which takes most of the time.
        jointly: whether to search for synchronic arcs.
        effects: effects of factors; absolute if missing.
        since: first row that counts for each factor and for ``terminated``, int64 [F + 1]; None for all.
    """
    groups = find_groups(cardinalities, rows.before, rows.after, ~resets.rows)
    layout = make_layout(cardinalities, groups, encoding)
    table, usual = _Table(layout, rows, resets.rows, effects, since), np.flatnonzero(~resets.rows)
    last = len(layout.outputs) - 1
    rows_of = {variable: np.arange(len(rows)) if variable == last else usual for variable in range(last + 1)}
    now = _graphs(table, rows_of, usual, True, in_pairs)
    layout = _with_mutexes(layout, now.graphs, rows)
    none = Part(no_synchronic(now.graphs))
    synchronic = none
    if jointly:
        dependent = find_dependent(layout, now.graphs, rows, usual)
        synchronic = _synchronic_graphs(table, layout, now.graphs, usual, dependent, in_pairs)
    reset, reset_synchronic = now, none
    if resets.rows.any():
        reset, reset_synchronic = _reset_graphs(table, layout, now, synchronic, resets, in_pairs)
    return Fitted(
        layout,
        now.graphs,
        synchronic.graphs,
        reset.graphs,
        reset_synchronic.graphs,
        bool(resets.rows.any()),
        [*now.asked, *synchronic.asked],
        [*now.found, *synchronic.found],
    )


def _reset_graphs(
    table: _Table, layout: Layout, usual: Part, synchronic: Part, resets: Resets, in_pairs: bool
) -> tuple[Part, Part]:
    """Graphs of the next state in a reset, without and with synchronic arcs."""
    rare, last = np.flatnonzero(resets.rows), len(layout.outputs) - 1
    own = np.zeros(last + 1, dtype=np.bool_)
    own[:-2] = [resets.redrawn[layout.members[b:e]].any() for b, e in zip(layout.first, layout.first[1:-2], strict=False)]
    own[-2] = resets.redrawn[-1]
    own |= np.isin(layout.mutex_of, layout.mutex_of[own]) & (layout.mutex_of >= 0)
    reset = _graphs(table, dict.fromkeys(np.flatnonzero(own).tolist(), rare), rare, False, in_pairs)
    if own[:-1].all() and not resets.jointly:
        return reset, Part(no_synchronic(reset.graphs))
    others, common = ~own, np.flatnonzero(~resets.rows)
    others[last] = False
    observed = [rare if own[variable] else common for variable in range(last + 1)]
    questions, found = usual.of(others)
    still = float(usual.graphs.still[0])
    graphs = table.build([*reset.asked, *questions], [*reset.found, *found], observed, still)
    late, late_found = synchronic.of(others)
    if resets.jointly:
        owner = feature_owners(layout)
        earlier = [Asked(int(v), np.flatnonzero(own[owner] & (owner < v))) for v in np.flatnonzero(own)]
        dependent = [each for each in earlier if len(each.features) and layout.mutex_of[each.variable] < 0]
        arcs = _synchronic_graphs(table, layout, graphs, rare, dependent, in_pairs)
        late, late_found = [*arcs.asked, *late], [*arcs.found, *late_found]
    if not late:
        return Part(graphs), Part(no_synchronic(graphs))
    return Part(graphs), Part(table.build(late, late_found, observed, still))


def _synchronic_graphs(
    table: _Table, layout: Layout, graphs: Graphs, usual: Ints, dependent: Sequence[Asked], in_pairs: bool
) -> Part:
    """Graphs of those given variables that depend on other variables' next values in some rows."""
    rows, kinds, n_features = table.rows, table.kinds(usual), table.features.shape[1]
    all_questions: list[Question] = []
    all_found: list[Search] = []
    for variable, features in dependent:
        counting = table.counting(variable, usual)
        needed = uncertain_rows(rows.select(counting), layout, graphs, np.asarray([variable]))[:, 0]
        some = table.observed(variable).select(counting[needed])
        following = shown(layout, rows.after[counting[needed]], features)
        first, pattern = distinct(following, some.pattern)
        questions = table.questions(variable, replace(some, pattern=pattern))
        more_kinds = np.concatenate([kinds, kinds.max(initial=0) + 1 + kinds[features]])
        more = np.concatenate([table.features[some.pattern[first]], following[first]], axis=1)
        found = find_splits([q.target for q in questions], more, more_kinds, layout.encoding.n_action_classes, in_pairs)
        if any(split.feature >= n_features for search in found for split in search.splits):
            numbers = np.concatenate([np.arange(n_features), n_features + features])
            all_questions += questions
            all_found += [search.renamed(numbers) for search in found]
    if not all_questions:
        return Part(no_synchronic(graphs))
    observed = [usual] * len(layout.outputs)
    return Part(table.build(all_questions, all_found, observed, float(graphs.still[0])), all_questions, all_found)


def _with_mutexes(layout: Layout, graphs: Graphs, rows: TransitionBatch) -> Layout:
    """The layout with mutex groups of bits that are never on together, although they would often be if they were independent."""
    bits = graphs.changing[is_lone_bit(layout)[graphs.changing]]
    if len(bits) < 2 or len(rows) == 0:
        return layout
    factors = layout.members[layout.first[bits]]
    on = rows.after[:, factors].astype(np.float32)
    some = np.linspace(0, len(rows) - 1, min(len(rows), MUTEX_ROWS)).astype(np.int64)
    start = np.concatenate([[0], np.cumsum(_cardinalities(layout))]).astype(np.int64)
    few = rows.select(some)
    probs = sampling.marginals(few.states, few.actions, layout, graphs, start)
    ones = probs[:, start[factors] + 1]
    expected = ones.T @ ones * (len(rows) / len(some))
    return layout_with_mutexes(layout, [bits[c] for c in find_cliques(np.rint(on.T @ on).astype(np.int64), expected)])


def _cardinalities(layout: Layout) -> NDArray[np.int64]:
    """Number of values of each factor."""
    cardinalities = np.full(layout.n_factors, 2, dtype=np.int64)
    lone = np.flatnonzero(np.diff(layout.first) == 1)
    cardinalities[layout.members[layout.first[lone]]] = layout.outputs[lone]
    return cardinalities


def indicator_rates(layout: Layout, rows: TransitionBatch, flags: Bools) -> Floats:
    """Probability [N] that a transition is flagged given state and action, from a decision graph fitted to flags [N]."""
    table, every, last = _Table(layout, rows, flags, NO_EFFECTS, None), np.arange(len(rows)), len(layout.outputs) - 1
    graphs = _graphs(table, {last: every}, every, True, False).graphs
    rates: Floats = sampling.reset_rates(rows.states, rows.actions, sampling.work_space(layout, graphs, graphs))
    return rates


def _graphs(table: _Table, rows_of: Mapping[int, Ints], observed: Ints, regular: bool, in_pairs: bool) -> Part:
    """The graphs of some variables, each fitted to the given rows; ``observed`` are the rows of this regime.

    The probability of change of variables that never changed is estimated jointly in a ``regular`` regime, else for each
    separately.
    """
    questions = [question for variable, which in rows_of.items() for question in table.ask(variable, which)]
    found = find_splits(
        [q.target for q in questions], table.features, table.kinds(observed), table.layout.encoding.n_action_classes, in_pairs
    )
    n_variables = len(table.layout.outputs)
    still = 0.5 / (len(observed) * (n_variables if regular else 1) + 1.0)
    return Part(table.build(questions, found, [observed] * n_variables, still), questions, found)
