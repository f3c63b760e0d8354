"""Tabular models: a known table of outcomes, as in Gymnasium's toy_text environments, and counts of observed transitions.

Counts are accurate for (state, action) pairs that were observed often, but do not generalise to others (paper section 2.1).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.base import BaseTransitionModel, ExactModel
from mbagent.models.fit_report import FitReport
from mbagent.models.kernel import Outcomes, work_for
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import LISTED, MASS, Particles, new_particles, slot_of, thin, thin_row
from mbagent.types import Actions, Bools, Floats, Ints, Randomness, States
from mbagent_envs.jit import compiled
from mbagent_envs.random_keys import derive, hash_rows, uniforms
from mbagent_envs.structs import Struct


class TableWork(Struct):
    """Work space: particles, and a number for each outcome of a pair, [at least 2]."""

    p: Particles
    values: Floats


@compiled
def table_outcomes(
    kernel: TableKernel, work: TableWork, state: Ints, n_grid: int, key: np.uint64, offset: float, out: Outcomes
) -> int:
    """See ``Kernel.outcomes``."""
    p, total = work.p, 0
    for action in range(kernel.n_actions):
        pair = state[0] * kernel.n_actions + action
        first, end = kernel.offsets[pair], kernel.offsets[pair + 1]
        n = thin_row(first, end, kernel.terminated, kernel.probabilities, p, work.values, (n_grid, key, offset))
        for i in range(n):
            entry, probability = first + i, kernel.probabilities[first + i]
            if not p.state[LISTED]:
                slot = slot_of(p, i, n_grid)
                entry, probability = first + p.factors[slot, 1], p.chances[slot, MASS]
            out.states[total + i, 0], out.terminated[total + i] = kernel.next_states[entry], kernel.terminated[entry]
            out.probabilities[total + i] = probability
        out.counts[action], out.left_out[action] = n, p.left[0]
        total += n
    return total


class TableKernel(Struct):
    """A table for compiled search; see ``TabularMDP`` for the attributes."""

    offsets: Ints
    next_states: Ints
    terminated: Bools
    probabilities: Floats
    n_actions: int

    outcomes = staticmethod(table_outcomes)


@work_for.register
def table_work(kernel: TableKernel, n_grid: int) -> TableWork:
    """See ``models.kernel.work_for``."""
    most = max(2, int(np.diff(kernel.offsets).max(initial=0)))
    return TableWork(new_particles(n_grid, 2, most), np.empty(most))


class TabularMDP(ExactModel):
    """An MDP with one factor and known outcomes. There is nothing to learn: ``fit`` does nothing, ``state_dict`` is empty.

    Args:
        offsets: where the outcomes of (state, action) begin, int64 [S * A + 1], at index ``state * A + action``.
        next_states: int64 [M].
        terminated: bool [M].
        probabilities: [M], summing to one over each pair.
        n_actions: number of actions A.
        start: states that episodes start in, int64.

    Raises:
        ValueError: the arrays do not fit together, or a pair's probabilities do not sum to one.
    """

    def __init__(
        self,
        offsets: NDArray[np.int64],
        next_states: NDArray[np.int64],
        terminated: Bools,
        probabilities: Floats,
        n_actions: int,
        start: NDArray[np.int64],
    ) -> None:
        """See the class."""
        n_states, rest = divmod(len(offsets) - 1, n_actions)
        super().__init__((n_states,), n_actions)
        self.offsets = np.ascontiguousarray(offsets, dtype=np.int64)  # compiled code needs these types
        self.next_states = np.ascontiguousarray(next_states, dtype=np.int64)
        self.terminated = np.ascontiguousarray(terminated, dtype=np.bool_)
        self.probabilities = np.ascontiguousarray(probabilities, dtype=np.float64)
        self._start = start
        totals = np.add.reduceat(probabilities, offsets[:-1]) if len(probabilities) else np.zeros(0)
        lengths = {len(next_states), len(terminated), len(probabilities), int(offsets[-1])}
        if rest or len(lengths) > 1 or (np.diff(offsets) < 1).any() or not np.allclose(totals, 1.0):
            raise ValueError(
                "A table needs outcomes for every (state, action), arrays of equal length, and probabilities summing to one."
            )

    def start_states(self, n: int, seed: int = 0) -> States:
        """The first n start states, or all if there are fewer, int64 [n or fewer, 1]."""
        return self._start[:n, None]

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; all successors if they are few."""
        pairs = states[:, 0] * self.n_actions + actions
        counts = np.diff(self.offsets)[pairs]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        entries = np.arange(offsets[-1]) + np.repeat(self.offsets[pairs] - offsets[:-1], counts)
        found = Successors(offsets, self.next_states[entries, None], self.terminated[entries], self.probabilities[entries])
        return thin(found, n_samples, seed)

    def kernel(self) -> TableKernel:
        """The table for compiled search."""
        return TableKernel(self.offsets, self.next_states, self.terminated, self.probabilities, self.n_actions)

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        pairs, noise = states[:, 0] * self.n_actions + actions, uniforms(as_keys(rng, len(states)), 1)[:, 0]
        cumulated = np.concatenate([[0.0], np.cumsum(self.probabilities)])
        target = cumulated[self.offsets[pairs]] + noise
        entries = np.clip(np.searchsorted(cumulated, target, side="right") - 1, self.offsets[pairs], self.offsets[pairs + 1] - 1)
        return self.next_states[entries, None], self.terminated[entries]

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        found, (n_states,) = self.successors(states, actions, len(self.probabilities), 0), self.cardinalities
        result = np.zeros((len(states), n_states))
        np.add.at(result, (found.rows, found.states[:, 0]), found.probabilities)
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        found = self.successors(states, actions, len(self.probabilities), 0)
        matches = (found.states[:, 0] == next_states[found.rows, 0]) & (found.terminated == terminated[found.rows])
        with np.errstate(divide="ignore"):
            result: Floats = np.log(np.bincount(found.rows[matches], weights=found.probabilities[matches], minlength=len(states)))
        return result


def toy_text_model(env: gym.Env[Any, Any]) -> tuple[TabularMDP, Callable[[Any, Any, Any], Floats]]:
    """The true model of a Gymnasium toy_text environment, and its reward as a function of (obs, action, next_obs).

    Rewards of outcomes with the same (obs, action, next_obs) are averaged, weighted by their probabilities.

    Args:
        env: environment with ``unwrapped.P[state][action] -> [(probability, next state, reward, terminated)]``.

    Raises:
        TypeError: the environment has no such table.
    """
    unwrapped: Any = env.unwrapped
    if not hasattr(unwrapped, "P") or not hasattr(unwrapped, "initial_state_distrib"):
        raise TypeError(
            f"{unwrapped} has no table of its rules: it lacks the attributes P or initial_state_distrib of toy_text environments."
        )
    table, n_actions = unwrapped.P, int(unwrapped.action_space.n)
    n_states = len(table)
    offsets, rows = [0], []
    expected, mass = np.zeros((n_states, n_actions, n_states)), np.zeros((n_states, n_actions, n_states))
    for state in range(n_states):
        for action in range(n_actions):
            outcomes: dict[tuple[int, bool], float] = {}
            for probability, following, reward, over in table[state][action]:
                outcomes[following, bool(over)] = outcomes.get((following, bool(over)), 0.0) + probability
                expected[state, action, following] += probability * reward
                mass[state, action, following] += probability
            rows += [(following, over, p) for (following, over), p in outcomes.items()]
            offsets.append(len(rows))
    rewards = expected / np.maximum(mass, 1e-300)
    following, over, probabilities = zip(*rows, strict=True)
    start = np.flatnonzero(np.asarray(unwrapped.initial_state_distrib) > 0)
    model = TabularMDP(
        np.asarray(offsets),
        np.asarray(following),
        np.asarray(over),
        np.asarray(probabilities, dtype=np.float64),
        n_actions,
        start,
    )

    def reward_fn(obs: Any, action: Any, next_obs: Any) -> Floats:
        result: Floats = rewards[obs, action, next_obs]
        return result

    return model, reward_fn


_ARRAYS = ("states", "actions", "next_states", "terminated", "counts")


class TabularModel(BaseTransitionModel):
    """Frequencies of the outcomes observed after each (state, action), with a prior for an unchanged state.

    An outcome observed c times in n transitions has probability c / (n + prior); the outcome "same state, not terminated" has
    (c + prior) / (n + prior). After an unobserved pair, the state is predicted to stay unchanged.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        prior: weight of the outcome "same state, not terminated", in transitions.
        validation: share of episodes held out to measure the fit; the final table uses all episodes.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int, *, prior: float = 0.0, validation: float = 0.1) -> None:
        """See the class."""
        super().__init__(cardinalities, n_actions)
        self.prior = float(prior)
        self.validation = float(validation)
        none = np.zeros(0, dtype=np.int64)
        ints = np.zeros((0, len(self.cardinalities)), dtype=np.int64)
        self._store(ints, none, ints, none.astype(np.bool_), none)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel. Replaces earlier counts; ``seed`` selects the held-out episodes of the report."""
        began = time.perf_counter()
        train, held_out = data.split(self.validation, seed)
        self._count(train)
        loss, exact = self._measure(held_out)
        self._count(data.rows())
        if progress is not None:
            progress(1.0)
        pairs = float(len(self._pairs))
        return FitReport(
            n_train=len(data),
            n_validation=len(held_out),
            epochs=1,
            seconds=time.perf_counter() - began,
            predictor_loss=loss,
            exact_match=exact,
            log={"known_pairs": pairs, "outcomes": float(len(self._counts))},
        )

    def visits(self, states: States, actions: Actions) -> NDArray[np.int64]:
        """Number of times that each (state, action) was observed, int64 [B]."""
        pair = self._find(states, actions)
        totals = np.append(self._totals, 0)
        result: NDArray[np.int64] = totals[pair]
        return result

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        u = uniforms(as_keys(rng, len(states)), 1)[:, 0]
        pair = self._find(states, actions)
        chosen = _choose(pair, self._offsets, self._weights, u)
        known = chosen >= 0
        next_states, terminated = states.astype(np.int64), np.zeros(len(states), dtype=np.bool_)
        next_states[known], terminated[known] = self._next_states[chosen[known]], self._terminated[chosen[known]]
        return next_states, terminated

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel; exact."""
        found = self._full(states, actions)
        starts = np.concatenate([[0], np.cumsum(self.cardinalities)[:-1]])
        result = np.zeros((len(states), sum(self.cardinalities)))
        np.add.at(result, (found.rows[:, None], starts + found.states), found.probabilities[:, None])
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel; minus infinity for outcomes of probability 0."""
        found = self._full(states, actions)
        rows = found.rows
        matches = (found.states == next_states[rows]).all(axis=1) & (found.terminated == terminated[rows])
        mass = np.bincount(rows[matches], weights=found.probabilities[matches], minlength=len(states))
        with np.errstate(divide="ignore"):
            result: Floats = np.log(mass)
        return result

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; all observed outcomes with their probabilities, if they are few."""
        return thin(self._full(states, actions), n_samples, seed)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel: distinct transitions and their counts."""
        sources = np.repeat(np.arange(len(self._pairs)), np.diff(self._offsets))
        arrays = (
            self._pair_states[sources],
            self._pair_actions[sources],
            self._next_states,
            self._terminated,
            self._counts,
        )
        kept = self._counts > 0
        return {name: array[kept].copy() for name, array in zip(_ARRAYS, arrays, strict=True)}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a table for states with this number of factors; nothing is changed then.
        """
        if sorted(state) != sorted(_ARRAYS):
            raise ValueError(f"A table has the arrays {', '.join(_ARRAYS)}, but was given {', '.join(sorted(state))}.")
        wide = (len(state["counts"]), len(self.cardinalities))
        if np.shape(state["states"]) != wide or np.shape(state["next_states"]) != wide:
            raise ValueError(
                f"This table is for states of {wide[1]} factors, but was given arrays of shape "
                f"{np.shape(state['states'])}; build the model for the space that the table was saved from."
            )
        states, actions, next_states, terminated, counts = (np.asarray(state[name]).astype(np.int64) for name in _ARRAYS)
        self._store(states, actions, next_states, terminated == 1, counts)

    def _count(self, rows: TransitionBatch) -> None:
        outcome = np.concatenate([rows.next_states, rows.terminated[:, None].astype(np.int64)], axis=1)
        tags = derive(hash_rows(outcome), _pair_tags(rows.states, rows.actions))
        _, first, counts = np.unique(tags, return_index=True, return_counts=True)
        distinct = rows.select(first)
        self._store(distinct.states, distinct.actions, distinct.next_states, distinct.terminated, counts)

    def _store(self, states: States, actions: Actions, next_states: States, terminated: Bools, counts: NDArray[np.int64]) -> None:
        """Builds the table from distinct transitions; with a prior, adds the outcome "same state" to each pair."""
        if self.prior > 0.0 and len(counts):
            _, first = np.unique(_pair_tags(states, actions), return_index=True)
            same = (next_states == states).all(axis=1) & ~terminated
            missing = first[~np.isin(_pair_tags(states, actions)[first], _pair_tags(states[same], actions[same]))]
            states = np.concatenate([states, states[missing]])
            actions = np.concatenate([actions, actions[missing]])
            next_states = np.concatenate([next_states, states[missing]])
            terminated = np.concatenate([terminated, np.zeros(len(missing), dtype=np.bool_)])
            counts = np.concatenate([counts, np.zeros(len(missing), dtype=np.int64)])
        tags = _pair_tags(states, actions)
        order = np.lexsort((terminated, *next_states.T[::-1], tags))  # independent of the order of the data
        self._pairs, first, sizes = np.unique(tags[order], return_index=True, return_counts=True)
        self._pair_states, self._pair_actions = states[order][first], actions[order][first]
        self._next_states, self._terminated = next_states[order], terminated[order]
        self._counts = counts[order].astype(np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        source = np.repeat(np.arange(len(sizes)), sizes)
        self._totals = np.bincount(source, weights=self._counts, minlength=len(sizes)).astype(np.int64)
        same = (self._next_states == self._pair_states[source]).all(axis=1) & ~self._terminated
        self._weights = (self._counts + self.prior * same) / (self._totals + self.prior)[source]

    def _find(self, states: States, actions: Actions) -> NDArray[np.int64]:
        """Index of each (state, action) in the table, int64 [B]; -1 if it was never observed."""
        tags = _pair_tags(states, actions)
        if len(self._pairs) == 0:
            return np.full(len(tags), -1, dtype=np.int64)
        place = np.minimum(np.searchsorted(self._pairs, tags), len(self._pairs) - 1)
        return np.where(self._pairs[place] == tags, place, -1).astype(np.int64)

    def _full(self, states: States, actions: Actions) -> Successors:
        """All outcomes of each row; for unobserved pairs the unchanged state."""
        pair = self._find(states, actions)
        starts = np.append(self._offsets, self._offsets[-1])
        counts = np.where(pair >= 0, np.diff(starts)[pair], 1)
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        rows = np.repeat(np.arange(len(states)), counts)
        entry = np.arange(len(rows)) - offsets[rows] + starts[pair[rows]]
        known = pair[rows] >= 0
        next_states, terminated = states[rows].astype(np.int64), np.zeros(len(rows), dtype=np.bool_)
        weights = np.ones(len(rows))
        next_states[known], terminated[known] = self._next_states[entry[known]], self._terminated[entry[known]]
        weights[known] = self._weights[entry[known]]
        return Successors(offsets, next_states, terminated, weights)

    def _measure(self, rows: TransitionBatch) -> tuple[float, float]:
        """Nats per held-out transition, over those with positive probability, and share whose likeliest outcome is right."""
        if len(rows) == 0:
            return 0.0, 1.0
        logs = self.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated)
        found = self._full(rows.states, rows.actions)
        order = np.lexsort((-found.probabilities, found.rows))[found.offsets[:-1]]
        exact = (found.states[order] == rows.next_states).all(axis=1) & (found.terminated[order] == rows.terminated)
        finite = np.isfinite(logs)
        return float(-logs[finite].mean()) if finite.any() else 0.0, float(exact.mean())


@compiled
def _choose(pair: NDArray[np.int64], offsets: NDArray[np.int64], weights: Floats, u: Floats) -> NDArray[np.int64]:
    """Table entry sampled for each row: its pair's inverse cumulative sum at ``u``; -1 for unknown pairs."""
    chosen = np.full(len(pair), -1, dtype=np.int64)
    for b in range(len(pair)):
        if pair[b] < 0:
            continue
        left = u[b]
        for entry in range(offsets[pair[b]], offsets[pair[b] + 1]):
            if weights[entry] > 0.0:
                chosen[b] = entry
                left -= weights[entry]
                if left < 0.0:
                    break
    return chosen


def _pair_tags(states: States, actions: Actions) -> NDArray[np.uint64]:
    return derive(hash_rows(states), actions)
