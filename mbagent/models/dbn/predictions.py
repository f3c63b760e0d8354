"""Predictions of decision graphs: samples, exact probabilities and successors."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import BaseTransitionModel
from mbagent.models.dbn import sampling
from mbagent.models.dbn.affected_variables import AffectedIndex
from mbagent.models.dbn.arrays import Graphs
from mbagent.models.dbn.fitting import Fitted, for_planning
from mbagent.models.dbn.planes.invariants import COVERING, MOST_TRIES, Invariants, all_kept, enforced, kept_chances
from mbagent.models.dbn.successors import WholeKernel, kernel_of, mixed, reset_draws, successors
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import assemble, rows_at_once, start
from mbagent.types import Actions, Bools, Floats, Ints, Keys, Randomness, States
from mbagent_envs.random_keys import derive, uniforms

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
