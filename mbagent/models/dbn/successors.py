"""Predictions of decision graphs: samples, exact probabilities, and successors in compiled code (``systematic_sampling.py``).

This module evaluates every variable in every row. Compiled search does the same, by ``WholeKernel``, for models with resets, or
with synchronic arcs of variables other than ``terminated``. For all other models, it uses ``expander.py``.
Shapes: B rows, F factors, U variables (the last two are ``terminated`` and the reset), Q mutex groups.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import BaseTransitionModel
from mbagent.models.dbn import sampling
from mbagent.models.dbn.affected_variables import only_end_is_synchronic
from mbagent.models.dbn.arrays import Graphs, distributions, show_next, show_next_adjacencies, write
from mbagent.models.dbn.expander import GraphKernel
from mbagent.models.dbn.features import Layout
from mbagent.models.dbn.fitting import Fitted, for_planning
from mbagent.models.dbn.mutex import leave_out_none, mutex_distribution, n_choices, settle
from mbagent.models.dbn.planes.invariants import (
    COVERING,
    MOST_TRIES,
    all_kept,
    enforced,
    has_invariants,
    kept_chances,
    leave_out,
)
from mbagent.models.dbn.sampling import Work, evaluate, needs_synchronic, only_possible, work_space
from mbagent.models.kernel import Outcomes, work_for
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import (
    MAIN,
    MASS,
    STRATA,
    Grid,
    Particles,
    begin,
    listed,
    n_outcomes,
    n_possible,
    new_particles,
    place_of,
    share_out,
    slot_of,
    weigh,
)
from mbagent.types import Actions, Bools, Floats, Ints, Keys, Randomness, States
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive, uniforms
from mbagent_envs.structs import Struct


class RowWork(Struct):
    """Graphs, and work space to list the outcomes of one row at a time.

    Attributes:
        w: graphs, and work space to evaluate them.
        p: particles.
        early: variables without synchronic arcs, then mutex groups (from number U on), int64.
        still_open: the variables and mutex groups with several possible outcomes, int64 [U + Q].
        base: the next state except for these, int64 [F].
        following: the next state of a particle, int64 [F].
    """

    w: Work
    p: Particles
    early: Ints
    still_open: Ints
    base: Ints
    following: Ints


def row_work(layout: Layout, graphs: Graphs, synchronic: Graphs, n_grid: int) -> RowWork:
    """Work space for at most ``n_grid`` samples."""
    w, n_variables = work_space(layout, graphs, synchronic), len(layout.outputs)
    width = n_variables + len(layout.exactly)
    return RowWork(
        w,
        new_particles(n_grid, width, len(w.joint)),
        np.concatenate([w.alone[w.alone < n_variables - 1], np.arange(n_variables, width)]),
        np.empty(width, dtype=np.int64),
        np.empty(layout.n_factors, dtype=np.int64),
        np.empty(layout.n_factors, dtype=np.int64),
    )


@compiled
def successors(states: Ints, actions: Ints, r: RowWork, grid: Grid, out: Outcomes) -> int:
    """Writes the outcomes of rows to ``out``, with counts and ``left_out`` [B]; returns their total number."""
    total = 0
    for b in range(len(states)):
        out.counts[b] = row_outcomes(states[b], actions[b], r, grid, total, out)
        out.left_out[b] = r.p.left[0]
        total += out.counts[b]
    return total


@compiled
def row_outcomes(state: Ints, action: int, r: RowWork, grid: Grid, total: int, out: Outcomes) -> int:
    """Writes the outcomes of a row from number ``total`` on, variable by variable; returns their number.

    See ``systematic_sampling.py``. The graphs must be those for planning.
    """
    w, p, layout, synchronic, n_grid = r.w, r.p, r.w.layout, r.w.synchronic, grid[0]
    evaluate(state, action, w.graphs.changing, w)
    for f in range(len(state)):
        r.base[f] = state[f]
    n_open, ended, end = 0, False, len(layout.outputs) - 2
    begin(p, n_grid, _fits(state, action, r, n_grid), place_of(state))
    for number in r.early:
        n, value = _distribution(number, state, w)
        best = only_possible(w.joint, 0, n)
        if best >= 0:
            if best != value:
                ended = _put(r.base, number, best, layout, ended)
            continue
        r.still_open[n_open] = number
        share_out(p, -1, number, n_open, w.joint, n, number == end, grid)
        n_open += 1
    if len(synchronic.changing):
        n_open = _split_synchronic(r, n_open, state, action, ended, grid)
    weigh(p, n_grid)
    for i in range(n_outcomes(p)):
        slot = slot_of(p, i, n_grid)
        out.terminated[total + i] = _fill(out.states[total + i], r, slot, n_open, ended)
        out.probabilities[total + i] = p.chances[slot, MASS]
    return n_outcomes(p)


@compiled
def _fits(state: Ints, action: int, r: RowWork, n_grid: int) -> bool:
    """Whether all outcomes of a row can be listed."""
    w, layout, graphs, possible = r.w, r.w.layout, r.w.graphs, 1
    for number in r.early:
        if number >= len(layout.outputs):
            possible *= n_choices(number - len(layout.outputs), state, w.rates, w.still, layout, graphs)
        else:
            possible *= n_possible(w.rates, graphs.start[number], layout.outputs[number])
        if possible > n_grid:
            return False
    for variable in w.synchronic.changing:
        needed = needs_synchronic(variable, action, w)
        possible *= layout.outputs[variable] if needed else n_possible(w.rates, graphs.start[variable], layout.outputs[variable])
        possible = min(possible, 2 * n_grid + 1)
    return bool(possible <= 2 * n_grid)


@compiled
def _distribution(number: int, state: Ints, w: Work) -> tuple[int, int]:
    """Writes a variable's or mutex group's distribution to ``w.joint``; returns size and current value (group: -1)."""
    n_variables = len(w.layout.outputs)
    if number >= n_variables:
        n = mutex_distribution(number - n_variables, state, w.rates, w.still, w.layout, w.graphs, w.joint) + 1
        leave_out_none(w.joint, n)
        return n, -1
    n, start = w.layout.outputs[number], w.graphs.start[number]
    for k in range(n):
        w.joint[k] = w.rates[start + k]
    return n, w.values[number]


@compiled
def _split_synchronic(r: RowWork, n_open: int, state: Ints, action: int, ended: bool, grid: Grid) -> int:
    """Draws variables with synchronic arcs, given each particle's next state so far; returns the new ``n_open``."""
    w, p, layout, synchronic = r.w, r.p, r.w.layout, r.w.synchronic
    end = len(layout.outputs) - 2
    for i in range(len(synchronic.changing)):
        number = synchronic.changing[i]
        n, start = layout.outputs[number], synchronic.start[number]
        r.still_open[n_open] = number
        if not needs_synchronic(number, action, w):
            for k in range(n):
                w.joint[k] = w.rates[start + k]
            share_out(p, -1, number, n_open, w.joint, n, number == end, grid)
            n_open += 1
            continue
        n_main, n_strata = p.state[MAIN], p.state[STRATA]
        for j in range(n_main + n_strata):
            slot = grid[0] + j if j < n_strata else j - n_strata  # strata first
            _fill(r.following, r, slot, n_open, ended)
            show_next(r.following, layout, w.on)
            if number == end:
                show_next_adjacencies(r.following, layout, w.on)
            distributions(synchronic.changing[i : i + 1], state, action, layout, synchronic, w.on, w.values, w.rates)
            for k in range(n):
                w.joint[k] = w.rates[start + k]
            share_out(p, slot, number, n_open, w.joint, n, number == end, grid)
        n_open += 1
    return n_open


@compiled
def _fill(state: Ints, r: RowWork, slot: int, n_open: int, ended: bool) -> bool:
    """Writes the next state that a particle represents; returns whether the episode is over."""
    over = ended
    for f in range(len(state)):
        state[f] = r.base[f]
    for v in range(n_open):
        over = _put(state, r.still_open[v], r.p.factors[slot, v], r.w.layout, over)
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
    """Number of resets among ``n_grid`` draws; if 0 < ``rate`` < 1: share max(``rate``, 1/4), in 1 ... ``n_grid`` - 1."""
    if rate <= 0.0 or rate >= 1.0:
        return 0 if rate <= 0.0 else n_grid
    return max(1, min(n_grid - 1, max(n_grid // 4, math.ceil(rate * n_grid))))


def mixed(parts: Sequence[tuple[NDArray[np.int64], NDArray[np.float64], Successors]], n_rows: int) -> Successors:
    """Mixture of the parts' successors; a part: its row indices [b], its probability in each row [b], its successors."""
    rows = np.concatenate([which[found.rows] for which, _, found in parts])
    weights = np.concatenate([found.probabilities * share[found.rows] for _, share, found in parts])
    order = np.argsort(rows, kind="stable")
    states = np.concatenate([found.states for _, _, found in parts])[order]
    terminated = np.concatenate([found.terminated for _, _, found in parts])[order]
    counts = np.bincount(rows, minlength=n_rows)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Successors(offsets, states, terminated, weights[order])


class WholeWork(Struct):
    """Work space: of usual steps and of resets, and the index of the reset variable, int64 [1]."""

    usual: RowWork
    in_reset: RowWork
    reset: Ints


@compiled
def whole_outcomes(
    kernel: WholeKernel, work: WholeWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See ``Kernel.outcomes``; all variables are evaluated."""
    layout, w, total = kernel.layout, work.usual.w, 0
    for action in range(len(layout.encoding.action_class)):
        rate = 0.0
        if kernel.has_reset:
            evaluate(state, action, work.reset, w)
            rate = w.rates[w.graphs.start[-1] - 1]
        draws, n, out.left_out[action] = reset_draws(rate, n_grid), 0, 0.0
        if rate < 1.0:
            n = row_outcomes(state, action, work.usual, (max(1, n_grid - draws), key, offset), total, out)
            _weigh_by(1.0 - rate, total, n, out)
            out.left_out[action] += (1.0 - rate) * work.usual.p.left[0]
        if rate > 0.0:
            more = row_outcomes(state, action, work.in_reset, (draws, key, offset), total + n, out)
            _weigh_by(rate, total + n, more, out)
            out.left_out[action] += rate * work.in_reset.p.left[0]
            n += more
        if len(layout.counts) or len(layout.observed):
            n = leave_out(layout, state, total, n, out)
        out.counts[action] = n
        total += n
    return total


@compiled
def _weigh_by(share: float, first: int, n: int, out: Outcomes) -> None:
    """Multiplies the probabilities of ``n`` outcomes from number ``first`` on by a share."""
    for q in range(first, first + n):
        out.probabilities[q] *= share


class WholeKernel(Struct):
    """Graphs for compiled search in models with resets or synchronic arcs (beyond those of ``terminated``).

    Attributes:
        layout, usual, synchronic, reset, reset_synchronic, has_reset: see ``fitting.Fitted``; the graphs are those for planning.
    """

    layout: Layout
    usual: Graphs
    synchronic: Graphs
    reset: Graphs
    reset_synchronic: Graphs
    has_reset: bool

    outcomes = staticmethod(whole_outcomes)


def kernel_of(fitted: Fitted, cardinalities: tuple[int, ...]) -> GraphKernel | WholeKernel:
    """The kernel of fitted graphs for planning: a ``GraphKernel`` if possible, else a ``WholeKernel``."""
    if not fitted.has_reset and only_end_is_synchronic(fitted.layout, fitted.synchronic):
        return GraphKernel.of(fitted.layout, fitted.usual, fitted.synchronic, cardinalities)
    f = fitted
    return WholeKernel(f.layout, f.usual, f.synchronic, f.reset, f.reset_synchronic, bool(f.has_reset))


@work_for.register
def whole_work(kernel: WholeKernel, n_grid: int) -> WholeWork:
    """See ``models.kernel.work_for``."""
    k, layout = kernel, kernel.layout
    return WholeWork(
        row_work(layout, k.usual, k.synchronic, n_grid),
        row_work(layout, k.reset, k.reset_synchronic, n_grid),
        np.array([len(layout.outputs) - 1]),
    )


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
    _kernel: tuple[Fitted, GraphKernel | WholeKernel] | None = None

    def kernel(self) -> GraphKernel | WholeKernel:
        """The graphs for compiled search, see ``models/kernel.py``."""
        if self._kernel is None or self._kernel[0] is not self.fitted:
            self._kernel = self.fitted, kernel_of(self._for_planning(), self.cardinalities)
        return self._kernel[1]

    def _for_planning(self) -> Fitted:
        if self._planned is None or self._planned[0] is not self.fitted:
            self._planned = self.fitted, for_planning(self.fitted)
        return self._planned[1]

    def _work(self) -> Work:
        return sampling.work_space(self.fitted.layout, self.fitted.usual, self.fitted.synchronic)

    def _work_in_reset(self) -> Work:
        return sampling.work_space(self.fitted.layout, self.fitted.reset, self.fitted.reset_synchronic)

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
        rates: Floats = sampling.reset_rates(states, actions, self._work())
        return rates

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        states, actions = self._rows(states, actions)
        keys = as_keys(rng, len(states))
        following, over = self._draw(states, actions, keys)
        for again in range(MOST_TRIES if has_invariants(self.fitted.layout) else 0):
            wrong = np.flatnonzero(~over & ~all_kept(self.fitted.layout, states, following))
            if len(wrong) == 0:
                break
            redrawn, ends = self._draw(states[wrong], actions[wrong], derive(keys[wrong], _AGAIN + again))
            following[wrong[~ends]] = redrawn[~ends]  # whether the episode ends is drawn once
        return following, over

    def _draw(self, states: States, actions: Actions, keys: Keys, greedy: bool = False) -> tuple[States, Bools]:
        """Samples with ``keys``; if ``greedy``, takes each variable's most probable value instead."""
        following, over = states.copy(), np.zeros(len(states), dtype=np.bool_)
        sampling.sample(states, actions, keys, greedy, self._work(), following, over)
        uniform = 0.5 if greedy else uniforms(derive(keys, _RESET), 1)[:, 0]
        happens = np.flatnonzero(uniform < self._reset_rates(states, actions))
        if len(happens):
            given, ends = states[happens], np.zeros(len(happens), dtype=np.bool_)
            redrawn = given.copy()
            sampling.sample(given, actions[happens], keys[happens], greedy, self._work_in_reset(), redrawn, ends)
            following[happens], over[happens] = redrawn, ends
        return following, over

    def likeliest(self, states: States, actions: Actions) -> tuple[States, Bools]:
        """Next states with each variable at its most probable value, int64 [B, F]; whether they end the episode, bool [B]."""
        states, actions = self._rows(states, actions)
        return self._draw(states, actions, np.zeros(len(states), dtype=np.uint64), greedy=True)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel; the marginals of variables with synchronic arcs are those learned without these arcs."""
        states, actions = self._rows(states, actions)
        start = np.concatenate([[0], np.cumsum(self.cardinalities)]).astype(np.int64)
        fitted = self.fitted
        probs = sampling.marginals(states, actions, fitted.layout, fitted.usual, start)
        if fitted.has_reset:
            redrawn = sampling.marginals(states, actions, fitted.layout, fitted.reset, start)
            probs += self._reset_rates(states, actions)[:, None] * (redrawn - probs)
        return probs

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; exact for the distribution that ``sample`` draws from.

        If there are invariants (``planes/invariants.py``), the probability that all hold is estimated from systematic draws.
        """
        states, actions = self._rows(states, actions)
        following, over = np.ascontiguousarray(next_states, dtype=np.int64), np.ascontiguousarray(terminated, dtype=np.bool_)
        layout = self.fitted.layout
        usual: Floats = sampling.log_prob(states, actions, following, over, self._work())
        if has_invariants(layout):
            planned = self._for_planning()
            found = self._successors(states, actions, planned.usual, planned.synchronic, COVERING, 0)
            kept = all_kept(layout, states, following)
            chances = kept_chances(layout, states, found)
            usual[~over] = np.where(kept, usual - np.log(chances), -np.inf)[~over]
        if not self.fitted.has_reset:
            return usual
        rate = self._reset_rates(states, actions)
        reset = sampling.log_prob(states, actions, following, over, self._work_in_reset())
        with np.errstate(divide="ignore"):
            return np.logaddexp(np.log1p(-rate) + usual, np.log(rate) + reset)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel and ``models/systematic_sampling.py``."""
        states, actions = self._rows(states, actions)
        planned = self._for_planning()
        if not self.fitted.has_reset:
            usual = self._successors(states, actions, planned.usual, planned.synchronic, n_samples, seed)
            return enforced(self.fitted.layout, states, usual)
        rates: Floats = sampling.reset_rates(states, actions, work_space(planned.layout, planned.usual, planned.synchronic))
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
        work = row_work(self.fitted.layout, graphs, synchronic, n_samples)

        def write(rows: slice, grid: Grid, out: Outcomes) -> int:
            return successors(states[rows], actions[rows], work, grid, out)

        return listed(len(states), n_samples, states.shape[1] + 1, seed, write)
