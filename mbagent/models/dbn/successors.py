"""Predictions of decision graphs: samples, exact probabilities, and successors in compiled code (``systematic_sampling.py``).

Here every variable is evaluated in every row. Compiled search does so for models with resets or synchronic arcs other than
termination's, see ``WholeKernel``; for all others it uses ``expander.py``.
Shapes: B rows, F factors, U variables (the last two are ``terminated`` and the reset), Q mutex groups.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import BaseTransitionModel
from mbagent.models.dbn import expander as expander  # registers its overloads
from mbagent.models.dbn import sampling
from mbagent.models.dbn.affected_variables import AffectedIndex, affected_index, only_end_is_synchronic
from mbagent.models.dbn.arrays import Graphs, distributions, n_features, show, show_next, show_next_adjacencies, write
from mbagent.models.dbn.features import Layout
from mbagent.models.dbn.fitting import Fitted, for_planning
from mbagent.models.dbn.mutex import leave_out_none, mutex_distribution, n_choices, settle
from mbagent.models.dbn.planes.invariants import COVERING, MOST_TRIES, Invariants, all_kept, enforced, kept_chances, leave_out
from mbagent.models.dbn.sampling import Work, alone, needs_synchronic, only_possible, work_space
from mbagent.models.overloads import Outcomes, implements, outcomes, work_for
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import (
    MAIN,
    MASS,
    STRATA,
    Found,
    Grid,
    Particles,
    assemble,
    begin,
    n_outcomes,
    n_possible,
    new_particles,
    place_of,
    room,
    rows_at_once,
    share_out,
    slot_of,
    start,
    used,
    weigh,
)
from mbagent.types import Actions, Bools, Floats, Ints, Keys, Randomness, States
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive, uniforms


@compiled
def successors(states: Ints, actions: Ints, layout: Layout, graphs: Graphs, synchronic: Graphs, grid: Grid) -> Found:
    """The outcomes of each row, variable by variable; see ``systematic_sampling.py``. The graphs must be those for planning."""
    w, n_variables, n_grid = work_space(layout, graphs, synchronic), len(layout.outputs), grid[0]
    single = alone(layout, graphs, w.later)
    early = np.concatenate((single[single < n_variables - 1], n_variables + np.arange(len(layout.exactly))))
    width = n_variables + len(layout.exactly)
    p, found = new_particles(n_grid, width, len(w.joint)), room(len(states), n_grid, states.shape[1] + 1)
    still_open, base = np.empty(width, dtype=np.int64), np.empty(states.shape[1], dtype=np.int64)
    total = 0
    for b in range(len(states)):
        show(states[b], actions[b], layout, w.on)
        distributions(graphs.changing, states[b], actions[b], layout, graphs, w.on, w.values, w.rates)
        base[:] = states[b]
        n_open, ended = 0, False
        begin(p, n_grid, _fits(early, states[b], actions[b], layout, graphs, synchronic, w, n_grid), place_of(states[b]))
        for number in early:
            n, value = _distribution(number, states[b], layout, graphs, w)
            best = only_possible(w.joint, 0, n)
            if best >= 0:
                if best != value:
                    ended = _put(base, number, best, layout, ended)
                continue
            still_open[n_open] = number
            share_out(p, -1, number, n_open, w.joint, n, number == n_variables - 2, grid)
            n_open += 1
        if len(synchronic.changing):
            n_open = _split_synchronic(
                p, n_open, states[b], actions[b], base, still_open, ended, layout, graphs, synchronic, w, grid
            )
        _list(p, n_open, base, still_open, ended, layout, found, b, total, n_grid)
        total += found[0][b]
    return used(found, total)


@compiled
def _fits(
    early: Ints, state: Ints, action: int, layout: Layout, graphs: Graphs, synchronic: Graphs, w: Work, n_grid: int
) -> bool:
    """Whether all outcomes of a row can be listed."""
    possible = 1
    for number in early:
        if number >= len(layout.outputs):
            possible *= n_choices(number - len(layout.outputs), state, w.rates, w.still, layout, graphs)
        else:
            possible *= n_possible(w.rates, graphs.start[number], layout.outputs[number])
        if possible > n_grid:
            return False
    for variable in synchronic.changing:
        needed = needs_synchronic(variable, action, w, layout, graphs)
        possible *= layout.outputs[variable] if needed else n_possible(w.rates, graphs.start[variable], layout.outputs[variable])
        possible = min(possible, 2 * n_grid + 1)
    return bool(possible <= 2 * n_grid)


@compiled
def _distribution(number: int, state: Ints, layout: Layout, graphs: Graphs, w: Work) -> tuple[int, int]:
    """Writes the distribution of a variable or mutex group to ``w.joint``; returns its size and the current value or -1."""
    n_variables = len(layout.outputs)
    if number >= n_variables:
        n = mutex_distribution(number - n_variables, state, w.rates, w.still, layout, graphs, w.joint) + 1
        leave_out_none(w.joint, n)
        return n, -1
    n, start = layout.outputs[number], graphs.start[number]
    w.joint[:n] = w.rates[start : start + n]
    return n, w.values[number]


@compiled
def _split_synchronic(
    p: Particles,
    n_open: int,
    state: Ints,
    action: int,
    base: Ints,
    still_open: Ints,
    ended: bool,
    layout: Layout,
    graphs: Graphs,
    synchronic: Graphs,
    w: Work,
    grid: Grid,
) -> int:
    """Draws variables with synchronic arcs, given each particle's next state so far; returns the new ``n_open``."""
    following, end = np.empty_like(base), len(layout.outputs) - 2
    for i in range(len(synchronic.changing)):
        number = synchronic.changing[i]
        n, start = layout.outputs[number], synchronic.start[number]
        still_open[n_open] = number
        if not needs_synchronic(number, action, w, layout, graphs):
            w.joint[:n] = w.rates[start : start + n]
            share_out(p, -1, number, n_open, w.joint, n, number == end, grid)
            n_open += 1
            continue
        n_main, n_strata = p.state[MAIN], p.state[STRATA]
        for j in range(n_main + n_strata):
            slot = grid[0] + j if j < n_strata else j - n_strata  # strata first
            _fill(following, base, p, slot, still_open, n_open, layout, ended)
            show_next(following, layout, w.on)
            if number == end:
                show_next_adjacencies(following, layout, w.on)
            distributions(synchronic.changing[i : i + 1], state, action, layout, synchronic, w.on, w.values, w.rates)
            w.joint[:n] = w.rates[start : start + n]
            share_out(p, slot, number, n_open, w.joint, n, number == end, grid)
        n_open += 1
    return n_open


@compiled
def _list(
    p: Particles,
    n_open: int,
    base: Ints,
    still_open: Ints,
    ended: bool,
    layout: Layout,
    found: Found,
    b: int,
    total: int,
    n_grid: int,
) -> None:
    """Writes the outcomes of row b from number ``total`` on."""
    counts, following, terminated, probabilities, left = found
    weigh(p, n_grid)
    left[b] = p.left[0]
    counts[b] = n_outcomes(p)
    for i in range(counts[b]):
        slot = slot_of(p, i, n_grid)
        terminated[total + i] = _fill(following[total + i], base, p, slot, still_open, n_open, layout, ended)
        probabilities[total + i] = p.chances[slot, MASS]


@compiled
def _fill(state: Ints, base: Ints, p: Particles, slot: int, still_open: Ints, n_open: int, layout: Layout, ended: bool) -> bool:
    """Writes the next state that a particle represents; returns whether the episode is over."""
    state[:] = base
    over = ended
    for v in range(n_open):
        over = _put(state, still_open[v], p.factors[slot, v], layout, over)
    return over


@compiled
def _put(state: Ints, number: int, value: int, layout: Layout, ended: bool) -> bool:
    """Sets the value of a variable or mutex group in a next state; returns whether the episode is over."""
    n_variables = len(layout.outputs)
    if number == n_variables - 2:
        return value == 1
    if number >= n_variables:
        settle(state, number - n_variables, value, layout)
    else:
        write(state, number, value, layout)
    return ended


@compiled
def reset_draws(rate: float, n_grid: int) -> int:
    """Number of ``n_grid`` draws for resets: their share or a quarter, but at least one each for resets and usual steps."""
    if rate <= 0.0 or rate >= 1.0:
        return 0 if rate <= 0.0 else n_grid
    return max(1, min(n_grid - 1, max(n_grid // 4, math.ceil(rate * n_grid))))


def mixed(parts: Sequence[tuple[NDArray[np.int64], NDArray[np.float64], Successors]], n_rows: int) -> Successors:
    """A mixture of successors; each part has the numbers of its rows [b], its probability for each row [b], and successors."""
    rows = np.concatenate([which[found.rows] for which, _, found in parts])
    weights = np.concatenate([found.probabilities * share[found.rows] for _, share, found in parts])
    order = np.argsort(rows, kind="stable")
    states = np.concatenate([found.states for _, _, found in parts])[order]
    terminated = np.concatenate([found.terminated for _, _, found in parts])[order]
    counts = np.bincount(rows, minlength=n_rows)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, states, terminated, weights[order])


class WholeKernel(NamedTuple):
    """Decision graphs for compiled search, for models with resets or synchronic arcs.

    Attributes:
        layout, usual, synchronic, reset, reset_synchronic, has_reset: see ``fitting.Fitted``; for planning.
    """

    layout: Layout
    usual: Graphs
    synchronic: Graphs
    reset: Graphs
    reset_synchronic: Graphs
    has_reset: bool


def kernel_of(fitted: Fitted, cardinalities: tuple[int, ...]) -> AffectedIndex | WholeKernel:
    """The kernel of fitted graphs for planning: an ``AffectedIndex`` if possible, else a ``WholeKernel``."""
    if not fitted.has_reset and only_end_is_synchronic(fitted.layout, fitted.synchronic):
        return affected_index(fitted.layout, fitted.usual, fitted.synchronic, cardinalities)
    f = fitted
    return WholeKernel(f.layout, f.usual, f.synchronic, f.reset, f.reset_synchronic, bool(f.has_reset))


class WholeWork(NamedTuple):
    """Work space.

    Attributes:
        on: features, bool [D].
        values: current values of the variables, int64 [U].
        rates: next-value distributions, [sum of cardinalities].
        actions: indices of all actions, int64 [A].
        states: the current state, int64 [1, F].
        reset: index of the reset variable, int64 [1].
    """

    on: Bools
    values: Ints
    rates: Floats
    actions: Ints
    states: Ints
    reset: Ints


@implements(work_for, WholeKernel)
@compiled
def whole_work(kernel: WholeKernel, n_grid: int) -> WholeWork:
    """See ``overloads.work_for``."""
    layout = kernel.layout
    return WholeWork(
        np.empty(n_features(layout), dtype=np.bool_),
        np.empty(len(layout.outputs), dtype=np.int64),
        np.empty(kernel.usual.start[-1], dtype=np.float64),
        np.arange(len(layout.encoding.action_class)),
        np.empty((1, layout.n_factors), dtype=np.int64),
        np.array([len(layout.outputs) - 1]),
    )


@implements(outcomes, WholeKernel)
@compiled
def whole_outcomes(
    kernel: WholeKernel, work: WholeWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See ``overloads.outcomes``; all variables are evaluated."""
    layout, graphs, states, actions, total = kernel.layout, kernel.usual, work.states, work.actions, 0
    states[:] = state
    for action in range(len(layout.encoding.action_class)):
        rate, a = 0.0, action
        if kernel.has_reset:
            show(state, action, layout, work.on)
            distributions(work.reset, state, action, layout, graphs, work.on, work.values, work.rates)
            rate = work.rates[graphs.start[-1] - 1]
        draws, n, out.left_out[action] = reset_draws(rate, n_grid), 0, 0.0
        if rate < 1.0:
            grid = (max(1, n_grid - draws), key, offset)
            found = successors(states[:1], actions[a : a + 1], layout, graphs, kernel.synchronic, grid)
            n = _take(found[1], found[2], found[3], 1.0 - rate, total, out)
            out.left_out[action] += (1.0 - rate) * found[4][0]
        if rate > 0.0:
            grid = (draws, key, offset)
            found = successors(states[:1], actions[a : a + 1], layout, kernel.reset, kernel.reset_synchronic, grid)
            n += _take(found[1], found[2], found[3], rate, total + n, out)
            out.left_out[action] += rate * found[4][0]
        if len(layout.counts) or len(layout.observed):
            n = _leave_out(layout, state, total, n, out)
        out.counts[action] = n
        total += n
    return total


@compiled
def _leave_out(layout: Layout, state: Ints, first: int, n: int, out: Outcomes) -> int:
    """Removes outcomes that violate an invariant from the last ``n``; returns how many are left."""
    counts, observed, weights, cells = layout.counts, layout.observed, layout.weights, layout.cells
    return leave_out(counts, observed, weights, cells, state, out.states, out.terminated, out.probabilities, first, n)


@compiled
def _take(states: Ints, terminated: Bools, probabilities: Floats, share: float, total: int, out: Outcomes) -> int:
    """Copies outcomes, which have a share of the probability, to ``out`` from number ``total`` on; returns how many."""
    for q in range(len(states)):
        out.states[total + q] = states[q]
        out.terminated[total + q] = terminated[q]
        out.probabilities[total + q] = share * probabilities[q]
    return len(states)


_RESET = 1 << 33
"""Salt of the random number that decides whether a reset happens."""

_AGAIN = 1 << 34
"""Salt of the random numbers of the first repeated draw."""


class GraphPredictions(BaseTransitionModel):
    """Predictions of a model from its fitted graphs.

    Attributes:
        fitted: the graphs.
    """

    fitted: Fitted
    _planned: tuple[Fitted, Fitted] | None = None
    _kernel: tuple[Fitted, AffectedIndex | WholeKernel] | None = None

    def kernel(self) -> AffectedIndex | WholeKernel:
        """The graphs for compiled search, see ``models/overloads.py``."""
        if self._kernel is None or self._kernel[0] is not self.fitted:
            self._kernel = self.fitted, kernel_of(self._for_planning(), self.cardinalities)
        return self._kernel[1]

    def _for_planning(self) -> Fitted:
        if self._planned is None or self._planned[0] is not self.fitted:
            self._planned = self.fitted, for_planning(self.fitted)
        return self._planned[1]

    @property
    def _invariants(self) -> Invariants:
        return Invariants(self.fitted.layout.counts, self.fitted.layout.observed)

    @property
    def _cells(self) -> tuple[Ints, Ints]:
        """Weights and cells of the invariants: see ``invariants.keeps``."""
        return self.fitted.layout.weights, self.fitted.layout.cells

    def _rows(self, states: States, actions: Actions) -> tuple[States, Actions]:
        states, actions = np.ascontiguousarray(states, dtype=np.int64), np.ascontiguousarray(actions, dtype=np.int64)
        if states.ndim != 2 or states.shape[1] != len(self.cardinalities) or actions.shape != (len(states),):
            raise ValueError(
                f"A model of {len(self.cardinalities)} factors needs states [B, {len(self.cardinalities)}] and actions [B], "
                f"got shapes {states.shape} and {actions.shape}."
            )
        return states, actions

    def _reset_rates(self, states: States, actions: Actions) -> Floats:
        if not self.fitted.has_reset:
            return np.zeros(len(states))
        rates: Floats = sampling.reset_rates(states, actions, self.fitted.layout, self.fitted.usual)
        return rates

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        states, actions = self._rows(states, actions)
        keys = as_keys(rng, len(states))
        following, over = self._draw(states, actions, keys)
        for again in range(0 if self._invariants.none else MOST_TRIES):
            wrong = np.flatnonzero(~over & ~all_kept(*self._invariants, *self._cells, states, following))
            if len(wrong) == 0:
                break
            redrawn, ends = self._draw(states[wrong], actions[wrong], derive(keys[wrong], _AGAIN + again))
            following[wrong[~ends]] = redrawn[~ends]  # whether the episode ends is drawn once
        return following, over

    def _draw(self, states: States, actions: Actions, keys: Keys, greedy: bool = False) -> tuple[States, Bools]:
        """Draws by keys, or takes the most probable value of each variable."""
        fitted, following, over = self.fitted, states.copy(), np.zeros(len(states), dtype=np.bool_)
        sampling.sample(states, actions, keys, greedy, fitted.layout, fitted.usual, fitted.synchronic, following, over)
        uniform = 0.5 if greedy else uniforms(derive(keys, _RESET), 1)[:, 0]
        happens = np.flatnonzero(uniform < self._reset_rates(states, actions))
        if len(happens):
            given, ends = states[happens], np.zeros(len(happens), dtype=np.bool_)
            redrawn, graphs = given.copy(), (fitted.reset, fitted.reset_synchronic)
            sampling.sample(given, actions[happens], keys[happens], greedy, fitted.layout, *graphs, redrawn, ends)
            following[happens], over[happens] = redrawn, ends
        return following, over

    def likeliest(self, states: States, actions: Actions) -> tuple[States, Bools]:
        """The most probable next states, variable by variable, int64 [B, F], and whether they end the episode, bool [B]."""
        states, actions = self._rows(states, actions)
        return self._draw(states, actions, np.zeros(len(states), dtype=np.uint64), greedy=True)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel; the marginals of variables with synchronic arcs are those learned without these arcs."""
        states, actions = self._rows(states, actions)
        start = np.concatenate([[0], np.cumsum(self.cardinalities)]).astype(np.int64)
        fitted, probs = self.fitted, np.empty((len(states), int(start[-1])))
        sampling.marginals(states, actions, fitted.layout, fitted.usual, start, probs)
        if fitted.has_reset:
            rate, redrawn = self._reset_rates(states, actions)[:, None], np.empty_like(probs)
            sampling.marginals(states, actions, fitted.layout, fitted.reset, start, redrawn)
            probs += rate * (redrawn - probs)
        return probs

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact for the distribution that ``sample`` draws from.

        If there are invariants (``planes/invariants.py``), the probability that all hold is estimated from systematic draws.
        """
        states, actions = self._rows(states, actions)
        following, over = np.ascontiguousarray(next_states, dtype=np.int64), np.ascontiguousarray(terminated, dtype=np.bool_)
        layout = self.fitted.layout
        usual: Floats = sampling.log_prob(states, actions, following, over, layout, self.fitted.usual, self.fitted.synchronic)
        if not self._invariants.none:
            planned = self._for_planning()
            found = self._successors(states, actions, planned.usual, planned.synchronic, COVERING, 0)
            kept = all_kept(*self._invariants, *self._cells, states, following)
            chances = kept_chances(self._invariants, *self._cells, states, found)
            usual[~over] = np.where(kept, usual - np.log(chances), -np.inf)[~over]
        if not self.fitted.has_reset:
            return usual
        rate = self._reset_rates(states, actions)
        reset = sampling.log_prob(states, actions, following, over, layout, self.fitted.reset, self.fitted.reset_synchronic)
        with np.errstate(divide="ignore"):
            return np.logaddexp(np.log1p(-rate) + usual, np.log(rate) + reset)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel and ``models/systematic_sampling.py``."""
        states, actions = self._rows(states, actions)
        planned = self._for_planning()
        if not self.fitted.has_reset:
            usual = self._successors(states, actions, planned.usual, planned.synchronic, n_samples, seed)
            return enforced(self._invariants, *self._cells, states, usual)
        rates: Floats = sampling.reset_rates(states, actions, planned.layout, planned.usual)
        n_resets = np.array([reset_draws(rate, n_samples) for rate in rates], dtype=np.int64)
        parts = []
        for n in np.unique(n_resets):
            some = np.flatnonzero((n_resets == n) & (rates < 1.0))
            found = self._successors(
                states[some], actions[some], planned.usual, planned.synchronic, max(1, n_samples - int(n)), seed
            )
            parts.append((some, 1.0 - rates[some], found))
            if n > 0:
                some = np.flatnonzero(n_resets == n)
                found = self._successors(states[some], actions[some], planned.reset, planned.reset_synchronic, int(n), seed)
                parts.append((some, rates[some], found))
        return mixed(parts, len(states))

    def _successors(
        self, states: States, actions: Actions, graphs: Graphs, synchronic: Graphs, n_samples: int, seed: int
    ) -> Successors:
        key, offset = start(seed)
        layout, n_outputs = self.fitted.layout, states.shape[1] + 1
        step = rows_at_once(n_samples, n_outputs)
        parts = [
            successors(states[b : b + step], actions[b : b + step], layout, graphs, synchronic, (n_samples, key, offset))
            for b in range(0, len(states), step)
        ]
        return assemble(parts, n_outputs)
