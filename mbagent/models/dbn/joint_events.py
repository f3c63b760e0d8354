"""Joint events: values of several variables that occur together more often than the graphs predict.

A crash may set several variables at once, each of which often takes such a value by itself. No pair of them then looks far from
independent, but all together do: three bits, each on in 12% of steps, would all be on in 0.2%, and an event with probability
0.7% multiplies that by five. Patterns are grown from pairs by the log-likelihood ratio of Poisson counts, as in the search for
frequent item sets (Agrawal and Srikant 1994; DuMouchel 1999). The model then has a mixture: in an event, the variables of the
patterns have graphs of their own (see ``fitting.Resets``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mbagent.data import Factors, TransitionBatch
from mbagent.models.dbn import sampling
from mbagent.models.dbn.features import variable_values
from mbagent.models.dbn.fitting import ROWS_AT_ONCE, UNCERTAIN, Fitted, indicator_rates
from mbagent.models.held_out import thinned
from mbagent.types import Bools, Floats, Ints
from mbagent_envs.random_keys import derive

MARGIN = 3.0
"""Log-likelihood ratio, beyond the logarithm of the number of tests, from which a pattern counts as an event."""

MARGIN_OF_ENDS = 2.0
"""The same for patterns of transitions that end an episode, of which there are few; an error would only make the estimated
probability of the end follow the counts more closely."""

FEWEST = 4
"""Minimum number of rows of a pattern."""

MOST_PROBABILITIES = 20_000_000
"""Maximum number of rows times values, and of rows times items; of more rows, an evenly spaced subset is used."""

MOST_ITEMS = 500
"""Maximum number of items that are searched for patterns: those with the largest variance."""

MOST_SEEDS = 100
"""Maximum number of pairs that are extended, for each action."""

MOST_EVENT_KINDS = 16
"""Maximum number of patterns, each of which is a kind of event."""

PATTERN_DRAWS = 60_000
"""Number of draws in all from which the probability of a pattern is estimated if its variables depend on each other."""

VALUE, LEAST, MOST, CHANGE = range(4)
"""Kinds of items: the next value is a number, at least a number, at most a number, or the current value plus a number."""


class Items(NamedTuple):
    """Unexpected outcomes of single variables, each less probable than one half in the rows where it counts.

    Attributes:
        variable, kind, number: of each item, int64 [I]; the variables are in the order in which they are drawn.
    """

    variable: Ints
    kind: Ints
    number: Ints

    def some(self, which: Ints) -> Items:
        """Some of the items."""
        return Items(*(part[which] for part in self))


class Pattern(NamedTuple):
    """Items that occur together.

    Attributes:
        items: the items.
        action: the action class they follow, or -1 for all.
        observed: number of rows.
        expected: number of rows that the graphs predict.
        scale: ``expected`` divided by its value if the items were independent given state and action.
        chance: if not NaN, the probability that such a row is an event; else it follows from the rate of the pattern.
    """

    items: Items
    action: int
    observed: int
    expected: float
    scale: float
    chance: float


class Table(NamedTuple):
    """Transitions as values of variables.

    Attributes:
        now, then: current and next values, the latter with the end of the episode, int64 [N, U - 2] and [N, U - 1].
        chances: distribution of each variable, given the next values of those that it depends on, float32 [N, sum of values].
        start: where each variable's values begin in ``chances``, int64 [U + 1].
    """

    now: Ints
    then: Ints
    chances: NDArray[np.float32]
    start: Ints

    def select(self, rows: Ints) -> Table:
        """Some of the rows."""
        return Table(self.now[rows], self.then[rows], self.chances[rows], self.start)

    def occurs(self, items: Items) -> Bools:
        """Which transitions have which items, however probable these are, bool [N, I]."""
        columns = [np.zeros((len(self.then), 0), dtype=np.bool_)]
        for variable, kind, number in zip(*items, strict=True):
            then = self.then[:, variable]
            if kind == CHANGE:
                columns.append((then == self.now[:, variable] + number)[:, None])
            else:
                columns.append(
                    (then == number if kind == VALUE else then >= number if kind == LEAST else then <= number)[:, None]
                )
        return np.concatenate(columns, axis=1)

    def probabilities(self, items: Items) -> NDArray[np.float32]:
        """Probability of each item, float32 [N, I]."""
        result, rows = np.zeros((len(self.then), len(items.kind)), dtype=np.float32), np.arange(len(self.then))
        for i, (variable, kind, number) in enumerate(zip(*items, strict=True)):
            own = self.chances[:, self.start[variable] : self.start[variable + 1]]
            if kind == CHANGE:
                target = self.now[:, variable] + number
                inside = (target >= 0) & (target < own.shape[1])
                result[:, i] = own[rows, np.where(inside, target, 0)] * inside
            else:
                begin, end = (
                    (number, number + 1) if kind == VALUE else (number, own.shape[1]) if kind == LEAST else (0, number + 1)
                )
                result[:, i] = own[:, begin:end].sum(axis=1)
        return result


def table_of_rows(fitted: Fitted, rows: TransitionBatch) -> Table:
    """The transitions with their distributions."""
    layout, graphs = fitted.layout, fitted.usual
    work = sampling.work_space(layout, graphs, fitted.synchronic)
    parts = [sampling.conditionals(p.states, p.actions, p.next_states, work).astype(np.float32) for p in rows.parts(ROWS_AT_ONCE)]
    chances = np.concatenate([np.zeros((0, int(graphs.start[-1])), dtype=np.float32), *parts])
    return Table(
        variable_values(layout, rows.before).astype(np.int64), _seen(fitted, rows.after, rows.terminated), chances, graphs.start
    )


def ratio(observed: ArrayLike, expected: ArrayLike) -> Floats:
    """Log-likelihood ratio of Poisson counts that exceed their expectation, else 0."""
    observed, expected = np.asarray(observed, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = observed * np.log(observed / np.maximum(expected, 1e-12)) - (observed - expected)
    result: Floats = np.where(observed > expected, value, 0.0)
    return result


def find_patterns(fitted: Fitted, rows: TransitionBatch) -> list[Pattern]:
    """Patterns that occur more often than the graphs predict.

    Args:
        fitted: graphs without events.
        rows: the transitions that they were fitted to, without resets.
    """
    rows = thinned(rows, max(1, MOST_PROBABILITIES // max(int(fitted.usual.start[-1]), MOST_ITEMS)))
    table = table_of_rows(fitted, rows)
    items = _candidates(fitted, table)
    if len(np.unique(items.variable)) < 2:
        return []
    classes = fitted.layout.encoding.action_class[rows.actions]
    several = np.flatnonzero(np.bincount(classes) > 0)
    found: list[Pattern] = []
    for action in [*several, -1] if len(several) > 1 else [-1]:
        here = np.flatnonzero(classes == action) if action >= 0 else np.arange(len(rows))
        draws = max(1, PATTERN_DRAWS // len(rows))
        search = _Search(
            fitted, rows.select(here), table.select(here), items, int(action), float(np.log(len(several) + 1.0)), draws
        )
        search.leave_out([pattern for pattern in found if action < 0])
        found += [*search.ends(), *search.patterns()]
    return sorted(found, key=lambda pattern: pattern.expected - pattern.observed)[:MOST_EVENT_KINDS]


def _candidates(fitted: Fitted, table: Table) -> Items:
    """The items that are searched."""
    layout, synchronic, last = fitted.layout, fitted.synchronic, len(fitted.layout.outputs) - 1
    parts: list[tuple[int, int, int]] = []
    for variable in [*(v for v in range(last) if v not in synchronic.changing), *synchronic.changing.tolist()]:
        n = int(layout.outputs[variable])
        parts += [(variable, VALUE, value) for value in range(n)]
        if n > 2:
            parts += [(variable, kind, value) for value in range(1, n - 1) for kind in (LEAST, MOST)]
            changes = np.unique(table.then[:, variable] - table.now[:, variable])
            parts += [(variable, CHANGE, int(change)) for change in changes]
    items = Items(*np.asarray(parts, dtype=np.int64).reshape(-1, 3).T)
    spread, count = np.zeros(len(items.kind)), np.zeros(len(items.kind))
    for begin in range(0, len(items.kind), MOST_ITEMS):
        which = np.arange(begin, min(begin + MOST_ITEMS, len(items.kind)))
        shown, chances = _unexpected(table, items.some(which))
        spread[which], count[which] = (chances * (1.0 - chances)).sum(axis=0), shown.sum(axis=0)
    kept = np.flatnonzero((spread > UNCERTAIN) & (count >= FEWEST))
    return items.some(np.sort(kept[np.argsort(-spread[kept], kind="stable")[:MOST_ITEMS]]))


def _unexpected(table: Table, items: Items) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Which transitions have which items, and the probabilities, float32 [N, I]; 0 where an item is probable, except the end."""
    chances = table.probabilities(items)
    chances[(chances >= 0.5) & (items.variable < table.then.shape[1] - 1)] = 0.0
    return (table.occurs(items) & (chances > 0.0)).astype(np.float32), chances


class _Search:
    """The search for patterns after one action.

    Args:
        fitted: graphs without events.
        rows: N transitions.
        table: the rows as values.
        items: the items that are searched.
        action: its class, or -1 for all.
        tests: logarithm of the number of searches.
        draws: number of draws for each transition.
    """

    def __init__(
        self, fitted: Fitted, rows: TransitionBatch, table: Table, items: Items, action: int, tests: float, draws: int
    ) -> None:
        """See the class."""
        self.fitted, self.rows, self.table, self.items, self.action = fitted, rows, table, items, action
        self.tests, self.draws = tests, draws
        self.shown, self.chances = _unexpected(table, items)
        self.free = np.ones(len(rows), dtype=np.bool_)
        self._drawn: Table | None = None

    def leave_out(self, patterns: Sequence[Pattern]) -> None:
        """Excludes transitions with these patterns from the search."""
        for pattern in patterns:
            self.free &= ~self.table.occurs(pattern.items).all(axis=1)

    def patterns(self) -> list[Pattern]:
        """Patterns grown from pairs, the most evident first."""
        items, shown = self.items, self.shown
        observed, expected = shown.T @ shown, shown.T @ self.chances
        pairs = np.triu(ratio(observed, expected), 1)
        pairs[(items.variable[:, None] == items.variable) | (observed < FEWEST)] = 0.0
        seeds = np.argsort(-pairs, axis=None, kind="stable")[:MOST_SEEDS]
        evident = []
        for one, two in zip(*np.unravel_index(seeds, pairs.shape), strict=True):
            if pairs[one, two] <= 0.0:
                break
            rows = np.flatnonzero((shown[:, one] > 0.0) & (shown[:, two] > 0.0))
            members, evidence = self._extended([int(one), int(two)], rows)
            evident.append((evidence, sorted(members)))
        evident.sort(key=lambda entry: (-entry[0], entry[1]))
        found: list[Pattern] = []
        for i, (evidence, members) in enumerate(evident):
            if evidence < MARGIN + self.tests or len(found) == MOST_EVENT_KINDS:
                break
            if i == 0 or members != evident[i - 1][1]:
                pattern = self._pattern(items.some(np.asarray(members)))
                if float(ratio(pattern.observed, pattern.expected)) > MARGIN + self._penalty(len(members)) + self.tests:
                    found.append(pattern)
                    self.leave_out([pattern])
        return found

    def ends(self) -> list[Pattern]:
        """Patterns of transitions that end an episode, observed more often than expected."""
        left, end = self.rows.terminated & self.free, len(self.fitted.layout.outputs) - 2
        over = Items(np.array([end]), np.array([VALUE]), np.array([1]))
        found: list[Pattern] = []
        for _ in range(MOST_EVENT_KINDS):
            rows = np.flatnonzero(left)
            members = [] if len(rows) < FEWEST or left.mean() >= 0.5 else self._extended([], rows)[0]
            if not members:
                break
            left[rows[self.shown[rows][:, members].all(axis=1)]] = False
            common = self.items.some(np.asarray(sorted(members)))
            together, alone = self._pattern(Items(*map(np.append, common, over))), self._pattern(common)
            gain = max(float(ratio(each.observed, each.expected)) for each in (together, alone)) - self.tests
            if gain > MARGIN_OF_ENDS and together.observed:
                chances = [(alone.observed - alone.expected) / together.observed, 1.0 - together.expected / together.observed]
                found.append(together._replace(chance=float(np.clip(max(chances), 0.0, 1.0))))
                self.leave_out(found[-1:])
        return found

    def _extended(self, members: list[int], rows: Ints) -> tuple[list[int], float]:
        """A set of items present in the rows, extended by the most surprising others; and its evidence.

        If the set is initially empty, the evidence is that given these rows; else that in all rows.
        """
        items, end, given = self.items, len(self.fitted.layout.outputs) - 2, not members
        best, highest, total = list(members), -math.inf if members else 1.0, 0.0
        product = np.ones(len(self.rows)) if given else self.chances[:, members].astype(np.float64).prod(axis=1)
        while True:
            if members:
                evidence = total if given else float(ratio(len(rows), product.sum()))
                evidence -= self._penalty(len(members))
                if evidence > highest + 1.0:
                    best, highest = members, evidence
            observed, expected = self.shown[rows].sum(axis=0), self.chances[rows].sum(axis=0)
            gains = np.where(observed >= FEWEST, ratio(observed, expected), 0.0)
            gains[np.isin(items.variable, items.variable[members]) | (items.variable == end)] = 0.0
            item = int(gains.argmax())
            if gains[item] <= 0.5:
                return best, highest
            members, total, product = [*members, item], total + float(gains[item]), product * self.chances[:, item]
            rows = rows[self.shown[rows, item] > 0.0]

    def _penalty(self, size: int) -> float:
        """Logarithm of the number of patterns of a size."""
        return float(size * np.log(len(self.items.kind)) - scipy.special.gammaln(size + 1.0))

    def _pattern(self, items: Items) -> Pattern:
        """Pattern of ``items``, with observed and expected numbers of rows with all items."""
        shown, chances = _unexpected(self.table, items)
        observed = int((shown.all(axis=1) & self.free).sum())
        independent = expected = float(chances.astype(np.float64).prod(axis=1).sum())
        mutex = self.fitted.layout.mutex_of[items.variable] >= 0
        if mutex.any() or np.isin(items.variable, self.fitted.synchronic.changing).any():
            expected = float((_unexpected(self.drawn(), items)[0].all(axis=1).sum() + 0.5) / self.draws)
        return Pattern(items, self.action, observed, expected, expected / max(independent, 1e-12), math.nan)

    def drawn(self) -> Table:
        """Draws from the model, [N * draws] rows, with the distributions given what was drawn."""
        if self._drawn is None:
            f, parts, begin = self.fitted, [], 0
            work = sampling.work_space(f.layout, f.usual, f.synchronic)
            for part in self.rows.parts(ROWS_AT_ONCE):
                for copy in range(self.draws):
                    following, over = part.states.copy(), np.zeros(len(part), dtype=np.bool_)
                    keys = derive(np.arange(begin, begin + len(part), dtype=np.uint64), copy)
                    sampling.sample(part.states, part.actions, keys, False, work, following, over)
                    parts.append(table_of_rows(f, replace(part, after=following, terminated=over)))
                begin += len(part)
            now, then, chances = (np.concatenate([part[i] for part in parts]) for i in range(3))
            self._drawn = Table(now, then, chances, parts[0].start)
        return self._drawn


def _seen(fitted: Fitted, after: Factors, terminated: Bools) -> Ints:
    """Values of all variables but the last in next states [N, F] and ends [N], int64 [N, U - 1]."""
    return np.concatenate([variable_values(fitted.layout, after).astype(np.int64), terminated[:, None]], axis=1)


def excess(fitted: Fitted, rows: TransitionBatch, patterns: Sequence[Pattern]) -> Floats:
    """Initial probability that a transition is an event, [N], from its pattern's excess over the prediction."""
    classes, result = fitted.layout.encoding.action_class[rows.actions], np.zeros(len(rows))
    has, predicted = np.zeros((len(patterns), len(rows)), dtype=np.bool_), np.zeros((len(patterns), len(rows)))
    begin = 0
    for part in rows.parts(ROWS_AT_ONCE):
        table, these = table_of_rows(fitted, part), slice(begin, begin + len(part))
        for k, pattern in enumerate(patterns):
            shown, chances = _unexpected(table, pattern.items)
            has[k, these], predicted[k, these] = shown.all(axis=1), chances.astype(np.float64).prod(axis=1)
        begin += len(part)
    for k, pattern in enumerate(patterns):
        here = has[k] & ((classes == pattern.action) | (pattern.action < 0))
        if np.isfinite(pattern.chance):
            share = np.full(len(rows), pattern.chance)
        else:
            share = 1.0 - pattern.scale * predicted[k] / np.maximum(indicator_rates(fitted.layout, rows, here), 1e-12)
        result[here] = np.maximum(result[here], share[here])
    return result.clip(0.0, 1.0)


def event_chances(fitted: Fitted, rows: TransitionBatch, patterns: Sequence[Pattern]) -> Floats:
    """Probability that a transition with one of the patterns is an event, given graphs with events, [N]; 0 without a pattern."""
    parts = [np.zeros(0)]
    usually = sampling.work_space(fitted.layout, fitted.usual, fitted.synchronic)
    in_event = sampling.work_space(fitted.layout, fitted.reset, fitted.reset_synchronic)
    for part in rows.parts(ROWS_AT_ONCE):
        table, candidate = table_of_rows(fitted, part), np.zeros(len(part), dtype=np.bool_)
        for pattern in patterns:
            candidate |= table.occurs(pattern.items).all(axis=1)
        usual, event = (
            sampling.log_prob(part.states, part.actions, part.next_states, part.terminated, work) for work in (usually, in_event)
        )
        rate = sampling.reset_rates(part.states, part.actions, usually)
        with np.errstate(divide="ignore", invalid="ignore"):
            odds = np.log(rate) + event - np.log1p(-rate) - usual
        odds[np.isnan(odds)] = -np.inf  # impossible with and without an event
        parts.append(np.where(candidate, 1.0 / (1.0 + np.exp(-odds.clip(-50.0, 50.0))), 0.0))
    return np.concatenate(parts)


def settled(chances: Floats) -> Bools:
    """Selects rows evenly in proportion to their probabilities [N], as many as these sum to."""
    total = np.floor(np.cumsum(chances) + 0.5)
    result: Bools = np.diff(np.concatenate([[0.0], total])) > 0.0
    return result


def factors_of(fitted: Fitted, patterns: Sequence[Pattern]) -> Bools:
    """Which factors, and last ``terminated``, occur in the patterns, bool [F + 1]."""
    layout, result = fitted.layout, np.zeros(fitted.layout.n_factors + 1, dtype=np.bool_)
    for variable in np.unique(np.concatenate([p.items.variable for p in patterns])):
        result[layout.members[layout.first[variable] : layout.first[variable + 1]]] = True
        result[-1] |= variable == len(layout.outputs) - 2
    return result
