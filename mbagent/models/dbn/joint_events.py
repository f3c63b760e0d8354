"""Joint events: values of several variables that occur together more often than the graphs predict.

A crash may set several variables at once, each of which often takes such a value by itself. No pair of them then differs much
from independent variables, but all together do: three bits that are each on with 12% are all on in 0.2% of steps, and an event of
0.7% multiplies that by five. Patterns are grown from pairs by the log-likelihood ratio of Poisson counts, as in the search for
frequent item sets (Agrawal and Srikant 1994; DuMouchel 1999). The model then has a mixture: in an event, the variables of the
patterns have graphs of their own (see ``fitting.Resets``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from mbagent.data import Factors, TransitionBatch
from mbagent.models.dbn import sampling
from mbagent.models.dbn.features import variable_values
from mbagent.models.dbn.fitting import ROWS_AT_ONCE, UNCERTAIN, Fitted
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
"""Maximum number of rows times values; of more rows, an evenly spaced subset is used."""

MOST_ITEMS = 1000
"""Maximum number of values that are searched for patterns: those with the largest variance."""

MOST_SEEDS = 1000
"""Maximum number of pairs that are extended, for each action."""

LARGEST = 8
"""Maximum number of values in a pattern."""

MOST_PATTERNS = 8
"""Maximum number of patterns."""

DRAWS = 60_000
"""Number of draws in all from which the probability of a pattern is estimated if its variables depend on each other."""


class Pattern(NamedTuple):
    """Values that occur together.

    Attributes:
        variables, values: the values, int64 [K].
        action: the action class after which they do, or -1 for all.
        observed: number of rows.
        expected: number of rows that the graphs predict.
        chance: first estimate of the probability that such a row is an event.
    """

    variables: Ints
    values: Ints
    action: int
    observed: int
    expected: float
    chance: float


class _Items(NamedTuple):
    """Values that are searched for patterns, each less frequent than the others of its variable together.

    Attributes:
        variable, value: of each item, int64 [I], in the order in which the variables are drawn.
        shown: which rows have the value, float32 [N, I].
        chances: its probability, given the values of variables drawn earlier, float32 [N, I].
    """

    variable: Ints
    value: Ints
    shown: Floats
    chances: Floats


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
    n = max(1, MOST_PROBABILITIES // int(fitted.usual.start[-1]))
    if len(rows) > n:
        rows = rows.select(np.linspace(0, len(rows) - 1, n).astype(np.int64))
    items = _items(fitted, rows)
    if len(np.unique(items.variable)) < 2:
        return []
    classes = fitted.layout.encoding.action_class[rows.actions]
    several = np.flatnonzero(np.bincount(classes) > 0)
    found: list[Pattern] = []
    for action in [*several, -1] if len(several) > 1 else [-1]:
        here = np.flatnonzero(classes == action) if action >= 0 else np.arange(len(rows))
        part = items._replace(shown=items.shown[here], chances=items.chances[here])
        draws = max(1, DRAWS // len(rows))
        search = _Search(fitted, rows.select(here), part, int(action), float(np.log(len(several) + 1.0)), draws)
        for pattern in [*search.ends(), *search.patterns()]:
            if not any(_overlap(pattern, other) for other in found if action < 0 or other.action == action):
                found.append(pattern)
    return sorted(found, key=lambda pattern: pattern.expected - pattern.observed)[:MOST_PATTERNS]


def _overlap(one: Pattern, other: Pattern) -> bool:
    """Whether two patterns share two values or more."""
    same = (one.variables[:, None] == other.variables) & (one.values[:, None] == other.values)
    return int(same.sum()) > 1


def _items(fitted: Fitted, rows: TransitionBatch) -> _Items:
    """The values that are searched."""
    layout, graphs, synchronic = fitted.layout, fitted.usual, fitted.synchronic
    parts = [
        sampling.conditionals(p.states, p.actions, p.next_states, layout, graphs, synchronic).astype(np.float32)
        for p in rows.parts(ROWS_AT_ONCE)
    ]
    chances = np.concatenate([np.zeros((0, int(graphs.start[-1])), dtype=np.float32), *parts])
    values = _seen(fitted, rows.after, rows.terminated)
    last = len(layout.outputs) - 1
    order = [v for v in range(last) if v not in synchronic.changing and layout.mutex_of[v] < 0]
    order += [int(v) for v in synchronic.changing if layout.mutex_of[v] < 0]
    variable = np.concatenate([np.zeros(0, dtype=np.int64), *(np.full(layout.outputs[v], v) for v in order)]).astype(np.int64)
    value = np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(layout.outputs[v]) for v in order)]).astype(np.int64)
    column = graphs.start[variable] + value
    share = (values[:, variable] == value).mean(axis=0) if len(rows) else np.zeros(len(variable))
    spread = (chances[:, column] * (1.0 - chances[:, column])).sum(axis=0)
    kept = np.flatnonzero((spread > UNCERTAIN) & (share * len(rows) >= FEWEST) & (share < 0.5))
    kept = np.sort(kept[np.argsort(-spread[kept], kind="stable")[:MOST_ITEMS]])
    variable, value, column = variable[kept], value[kept], column[kept]
    return _Items(variable, value, (values[:, variable] == value).astype(np.float32), chances[:, column])


class _Search:
    """The search for patterns after one action.

    Args:
        fitted: graphs without events.
        rows: N transitions.
        items: the values that are searched.
        action: its class, or -1 for all.
        tests: logarithm of the number of searches.
        draws: number of draws for each transition.
    """

    def __init__(self, fitted: Fitted, rows: TransitionBatch, items: _Items, action: int, tests: float, draws: int) -> None:
        """See the class."""
        self.fitted, self.rows, self.items, self.action, self.tests, self.draws = fitted, rows, items, action, tests, draws
        self.price = float(np.log(len(items.variable)))
        self._drawn: Ints | None = None

    def patterns(self) -> list[Pattern]:
        """Patterns grown from pairs, the most evident first, without those that overlap a better one."""
        items = self.items
        observed, expected = items.shown.T @ items.shown, items.shown.T @ items.chances
        pairs = np.triu(ratio(observed, expected), 1)
        pairs[(items.variable[:, None] == items.variable) | (observed < FEWEST)] = 0.0
        seeds = np.argsort(-pairs, axis=None, kind="stable")[:MOST_SEEDS]
        evident = []
        for one, two in zip(*np.unravel_index(seeds, pairs.shape), strict=True):
            if pairs[one, two] <= 0.0:
                break
            rows = np.flatnonzero((items.shown[:, one] > 0.0) & (items.shown[:, two] > 0.0))
            members, total = self._extended([int(one), int(two)], rows, float(pairs[one, two]) - self.price)
            evident.append((total - self.price + float(gammaln(len(members) + 1.0)), members))
        evident.sort(key=lambda entry: -entry[0])
        found: list[Pattern] = []
        for evidence, members in evident:
            if evidence < MARGIN + self.tests or len(found) == MOST_PATTERNS:
                break
            pattern = self._pattern(members)
            if not any(_overlap(pattern, other) for other in found):
                n_patterns = self.price * len(members) - float(gammaln(len(members) + 1.0))
                if float(ratio(pattern.observed, pattern.expected)) > MARGIN + n_patterns + self.tests:
                    found.append(pattern)
        return found

    def ends(self) -> list[Pattern]:
        """Patterns of the transitions that end an episode, more of which are observed than expected."""
        left, end = self.rows.terminated.copy(), len(self.fitted.layout.outputs) - 2
        found: list[Pattern] = []
        for _ in range(MOST_PATTERNS):
            rows = np.flatnonzero(left)
            if len(rows) < FEWEST or left.mean() >= 0.5:
                break
            members, _ = self._extended([], rows, 0.0)
            if not members:
                break
            left[rows[self.items.shown[rows][:, members].all(axis=1)]] = False
            together, alone = self._pattern(members, end), self._pattern(members)
            gain = max(float(ratio(each.observed, each.expected)) for each in (together, alone)) - self.tests
            if gain > MARGIN_OF_ENDS:
                chance = (alone.observed - alone.expected) / together.observed
                found.append(together._replace(chance=float(np.clip(max(chance, together.chance), 0.0, 1.0))))
        return found

    def _extended(self, members: list[int], rows: Ints, total: float) -> tuple[list[int], float]:
        """A set of items, present in some rows, after adding the most surprising further items; with the total evidence."""
        items, end = self.items, len(self.fitted.layout.outputs) - 2
        best, best_total = list(members), total
        while len(members) < LARGEST:
            observed, expected = items.shown[rows].sum(axis=0), items.chances[rows].sum(axis=0)
            gains = np.where(observed >= FEWEST, ratio(observed, expected), 0.0)
            gains[np.isin(items.variable, items.variable[members])] = 0.0
            gains[items.variable == end] = 0.0
            item = int(gains.argmax())
            if gains[item] <= 0.5:
                break
            members, total = [*members, item], total + float(gains[item]) - self.price
            rows = rows[items.shown[rows, item] > 0.0]
            if total > best_total + 1.0:
                best, best_total = members, total
        return best, best_total

    def _pattern(self, members: Sequence[int], *end: int) -> Pattern:
        """Items as a pattern, optionally with the end of the episode, with numbers of observed and expected rows."""
        chosen = np.asarray(sorted(members), dtype=np.int64)
        variables = np.concatenate([self.items.variable[chosen], np.asarray(end, dtype=np.int64)])
        values = np.concatenate([self.items.value[chosen], np.ones(len(end), dtype=np.int64)])
        observed = int(_match(self.fitted, self.rows.after, self.rows.terminated, variables, values).sum())
        if np.isin(variables, self.fitted.synchronic.changing).any() or len(end):
            drawn = self.drawn()
            expected = ((drawn[:, variables] == values).all(axis=1).sum() + 0.5) / self.draws
        else:
            expected = self.items.chances[:, chosen].astype(np.float64).prod(axis=1).sum()
        chance = max(0.0, 1.0 - float(expected) / max(observed, 1))
        return Pattern(variables, values, self.action, observed, float(expected), chance)

    def drawn(self) -> Ints:
        """Values of all variables in draws from the model, [N * draws, U - 1]."""
        if self._drawn is None:
            f, parts = self.fitted, []
            for part in self.rows.parts(ROWS_AT_ONCE):
                for copy in range(self.draws):
                    following, over = part.states.copy(), np.zeros(len(part), dtype=np.bool_)
                    keys = derive(np.arange(len(part), dtype=np.uint64), copy)
                    sampling.sample(part.states, part.actions, keys, False, f.layout, f.usual, f.synchronic, following, over)
                    parts.append(_seen(f, following, over))
            self._drawn = np.concatenate(parts)
        return self._drawn


def _seen(fitted: Fitted, after: Factors, terminated: Bools) -> Ints:
    """Values of all variables but the last in next states [N, F] and ends [N], [N, U - 1]."""
    result: Ints = np.concatenate([variable_values(fitted.layout, after), terminated[:, None]], axis=1)
    return result


def _match(fitted: Fitted, after: Factors, terminated: Bools, variables: Ints, values: Ints) -> Bools:
    """Which next states [N, F] and ends [N] have the given values of the given variables."""
    result: Bools = (_seen(fitted, after, terminated)[:, variables] == values).all(axis=1)
    return result


def excess(fitted: Fitted, rows: TransitionBatch, patterns: Sequence[Pattern]) -> Floats:
    """First estimate of the probability that a transition is an event, [N]."""
    classes, result = fitted.layout.encoding.action_class[rows.actions], np.zeros(len(rows))
    for pattern in patterns:
        here = _match(fitted, rows.after, rows.terminated, pattern.variables, pattern.values)
        here &= (classes == pattern.action) | (pattern.action < 0)
        result[here] = np.maximum(result[here], pattern.chance)
    return result


def event_chances(fitted: Fitted, rows: TransitionBatch, patterns: Sequence[Pattern]) -> Floats:
    """Probability that a transition with one of the patterns is an event, given graphs with events, [N]; 0 without a pattern."""
    result = np.zeros(len(rows))
    candidates = np.zeros(len(rows), dtype=np.bool_)
    for pattern in patterns:
        candidates |= _match(fitted, rows.after, rows.terminated, pattern.variables, pattern.values)
    layout, some = fitted.layout, np.flatnonzero(candidates)
    for begin in range(0, len(some), ROWS_AT_ONCE):
        which = some[begin : begin + ROWS_AT_ONCE]
        part = rows.select(which)
        usual, event = (
            sampling.log_prob(part.states, part.actions, part.next_states, part.terminated, layout, graphs, synchronic)
            for graphs, synchronic in ((fitted.usual, fitted.synchronic), (fitted.reset, fitted.reset_synchronic))
        )
        rate = sampling.reset_rates(part.states, part.actions, layout, fitted.usual)
        with np.errstate(divide="ignore"):
            odds = np.log(rate) + event - np.log1p(-rate) - usual
        result[which] = 1.0 / (1.0 + np.exp(-odds.clip(-50.0, 50.0)))
    return result


def settled(chances: Floats) -> Bools:
    """Evenly spaced rows, as many as the sum of the probabilities [N], each about as often as its own."""
    total = np.floor(np.cumsum(chances) + 0.5)
    result: Bools = np.diff(np.concatenate([[0.0], total])) > 0.0
    return result


def factors_of(fitted: Fitted, patterns: Sequence[Pattern]) -> Bools:
    """Which factors, and whether ``terminated``, the patterns contain, bool [F + 1]."""
    layout, result = fitted.layout, np.zeros(fitted.layout.n_factors + 1, dtype=np.bool_)
    for variable in np.unique(np.concatenate([p.variables for p in patterns])):
        result[layout.members[layout.first[variable] : layout.first[variable + 1]]] = True
        result[-1] |= variable == len(layout.outputs) - 2
    return result
