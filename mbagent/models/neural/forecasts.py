"""Forecasts several steps ahead (paper 4.2): by iterating the one-step model, or by a separate model for each number of steps.

"One alternative, if the agent wants to plan n steps in advance, is to learn a model for transition probabilities between
states separated by n steps given a string of n actions. [...] it can use several separate models corresponding to each
desired value of n, an approach known as independent value prediction [Cheng et al., 2006]."
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.base import BaseTransitionModel
from mbagent.models.fit_report import FitReport
from mbagent.models.protocol import LARGEST_NUMBER, Successors, TransitionModel, as_keys
from mbagent.types import Actions, Bools, Floats, Keys, Randomness, States
from mbagent_envs.random_keys import derive, uniforms

ModelBuilder: TypeAlias = Callable[[int], BaseTransitionModel]
"""``build(n)``: an unfitted model whose action is a string of n actions, numbered as ``number_strings`` does."""

_REST = 1 << 32
"""Salt of the random numbers of steps after a direct forecast; larger than any number of steps."""


def iterate(model: TransitionModel, states: States, strings: Actions, rng: Randomness) -> tuple[States, Bools]:
    """Samples the state after each string of actions, step by step; a terminated row keeps its last state.

    Args:
        model: the one-step model.
        states: int64 [B, F].
        strings: int64 [B, n], n >= 0.
        rng: a Generator, or keys uint64 [B].

    Returns:
        (states int64 [B, F], whether they are terminal bool [B]).
    """
    keys, states = as_keys(rng, len(states)), np.array(states, dtype=np.int64)
    over = np.zeros(len(states), dtype=np.bool_)
    for step in range(strings.shape[1]):
        alive = np.flatnonzero(~over)
        if len(alive) == 0:
            break
        states[alive], over[alive] = model.sample(states[alive], strings[alive, step], derive(keys[alive], step))
    return states, over


def number_strings(strings: Actions, n_actions: int) -> Actions:
    """Number int64 [B] of each string int64 [B, n]; digits in base ``n_actions`` are the actions, lowest digit first.

    Raises:
        ValueError: the strings are too long to be numbered, or an action is out of range.
    """
    n = strings.shape[1]
    if strings.size and not (strings.min() >= 0 and strings.max() < n_actions):
        raise ValueError(f"Strings are made of actions 0 ... {n_actions - 1}, got {strings.min()} ... {strings.max()}.")
    if n_actions**n > LARGEST_NUMBER:
        raise ValueError(
            f"Strings of {n} actions out of {n_actions} are too many to number; forecast fewer steps directly, "
            f"at most {longest_string(n_actions)}."
        )
    numbers: Actions = (strings * n_actions ** np.arange(n, dtype=np.int64)).sum(axis=1, dtype=np.int64)
    return numbers


def longest_string(n_actions: int) -> int:
    """Maximum length of a string of actions in ``number_strings``; 1000 with only one action, which sets no limit."""
    n = 1
    while n_actions > 1 and n_actions ** (n + 1) <= LARGEST_NUMBER:
        n += 1
    return n if n_actions > 1 else 1000


def steps_apart(data: TransitionDataset, n: int, seed: int = 0) -> TransitionDataset:
    """Transitions between states that are ``n`` steps apart; the action of each is the string of actions in between.

    If an episode terminates within a string, it stays in its last state, and the remaining actions of the string are random.
    Strings that extend beyond the end of a truncated episode are omitted. If the longest episode was truncated, its length is
    taken as the time limit, and strings that start less than n steps before this limit are omitted in all episodes. Keeping only
    those that terminate would overestimate the probability of termination.

    Args:
        data: transitions of single steps, in the observed order within each episode.
        n: steps, at least 1.
        seed: seed of the actions after termination.

    Raises:
        ValueError: n is below 1.
    """
    if n < 1:
        raise ValueError(f"States can be n = 1, 2, ... steps apart, got n = {n}.")
    rows = data.rows()
    rows = rows.select(np.argsort(rows.episodes, kind="stable"))
    result = TransitionDataset(data.cardinalities, data.n_actions**n)
    n_rows, start = len(rows), np.arange(len(rows))
    last, over = start.copy(), np.zeros(n_rows, dtype=np.bool_)
    strings = np.random.default_rng(seed).integers(data.n_actions, size=(n_rows, n))
    whole = np.ones(n_rows, dtype=np.bool_)
    for step in range(n):
        here = np.minimum(start + step, n_rows - 1)
        follows = start + step < n_rows
        if step:
            follows &= (rows.episodes[here] == rows.episodes[start]) & (rows.states[here] == rows.next_states[last]).all(axis=1)
        whole &= follows | over
        continues = whole & ~over
        strings[continues, step], last[continues] = rows.actions[here[continues]], here[continues]
        over[continues] = rows.terminated[last[continues]]
    whole &= _far_from_limit(rows, n)
    first, end = start[whole], last[whole]
    result.append(
        TransitionBatch(
            before=rows.before[first],
            actions=number_strings(strings[whole], data.n_actions),
            after=rows.after[end],
            terminated=over[whole],
            rewards=np.zeros(len(first)),
            episodes=rows.episodes[first],
        )
    )
    return result


def _far_from_limit(rows: TransitionBatch, n: int) -> Bools:
    """Mask of rows that start at least ``n`` steps before the episode length limit; rows must be ordered by episode."""
    if len(rows) == 0:
        return np.zeros(0, dtype=np.bool_)
    _, first, lengths = np.unique(rows.episodes, return_index=True, return_counts=True)
    ended = rows.terminated[first + lengths - 1]
    limit = lengths.max() if not ended[lengths == lengths.max()].all() else np.inf
    far: Bools = np.arange(len(rows)) - np.repeat(first, lengths) + n <= limit
    return far


class DirectForecastModel(BaseTransitionModel):
    """A one-step model, and separate models for some larger numbers of steps.

    As a transition model, it behaves like its one-step model, so every planner can use it. ``forecast`` uses the other models:
    their errors do not accumulate over steps, but a model of many steps is harder to learn.

    Args:
        one_step: the one-step model.
        build: function that builds the n-step model.
        steps: the numbers of steps that get a separate model, each at least 2.

    Raises:
        ValueError: a number of steps is below 2, or so large that the strings of actions cannot be numbered.
    """

    def __init__(self, one_step: BaseTransitionModel, build: ModelBuilder, steps: tuple[int, ...]) -> None:
        """See the class."""
        super().__init__(one_step.cardinalities, one_step.n_actions)
        if any(n < 2 for n in steps):
            raise ValueError(f"Numbers of steps with a separate model must be 2 or more, got {sorted(steps)}.")
        limit = longest_string(self.n_actions)
        if any(n > limit for n in steps):
            raise ValueError(
                f"Strings of {max(steps)} actions out of {self.n_actions} are too many to number; "
                f"choose numbers of steps up to {limit}."
            )
        self.one_step = one_step
        self.direct = {n: build(n) for n in sorted(steps)}
        self._known: set[int] = set()

    @property
    def known(self) -> frozenset[int]:
        """The numbers of steps that have a fitted separate model."""
        return frozenset(self._known)

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel; the report is that of the one-step model. If no episode has n steps, there is no n-step model."""
        began, share = time.perf_counter(), 1.0 / (1 + len(self.direct))

        def part(i: int) -> Callable[[float], None] | None:
            return None if progress is None else lambda done: progress(share * (i + done))

        report = self.one_step.fit(data, seed=seed, progress=part(0))
        log = {**report.log, "seconds_1_steps": report.seconds}
        self._known = set()
        for i, (n, model) in enumerate(self.direct.items(), start=1):
            apart = steps_apart(data, n, seed)
            if len(apart):
                log[f"seconds_{n}_steps"] = model.fit(apart, seed=seed, progress=part(i)).seconds
                self._known.add(n)
        return replace(report, seconds=time.perf_counter() - began, log=log)

    def forecast(self, states: States, strings: Actions, rng: Randomness) -> tuple[States, Bools]:
        """Samples the state after each string of actions, int64 [B, n], n >= 0.

        Uses the n-step model if it is fitted, else the fitted model with the largest number of steps below n, followed by single
        steps.

        Returns:
            (states int64 [B, F], whether they are terminal bool [B]).
        """
        keys, n = as_keys(rng, len(states)), strings.shape[1]
        first = max((known for known in self._known if known <= n), default=0)
        if first == 0:
            return iterate(self.one_step, states, strings, keys)
        reached, over = self.direct[first].sample(states, number_strings(strings[:, :first], self.n_actions), derive(keys, first))
        go_on = np.flatnonzero(~over)
        if n > first and len(go_on):
            reached[go_on], over[go_on] = iterate(
                self.one_step, reached[go_on], strings[go_on, first:], derive(keys[go_on], _REST)
            )
        return reached, over

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        return self.one_step.sample(states, actions, rng)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        return self.one_step.marginals(states, actions)

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        return self.one_step.log_prob(states, actions, next_states, terminated)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel."""
        return self.one_step.successors(states, actions, n_samples, seed)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""
        parts = {1: self.one_step, **self.direct}
        state = {f"steps{n}.{name}": value for n, model in parts.items() for name, value in model.state_dict().items()}
        return {**state, "known": np.array(sorted(self._known), dtype=np.int64)}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel.

        Raises:
            ValueError: the arrays are not those of a model of this shape; the model is unchanged.
        """
        before = self.state_dict()
        try:
            self._take(state)
        except Exception:
            self._take(before)
            raise

    def _take(self, state: Mapping[str, NDArray[Any]]) -> None:
        parts = {1: self.one_step, **self.direct}
        known = [int(n) for n in np.ravel(state.get("known", ()))]
        prefixes = {f"steps{n}" for n in parts}
        foreign = [name for name in state if name != "known" and name.partition(".")[0] not in prefixes]
        if foreign or "known" not in state or not set(known) <= set(self.direct):
            raise ValueError(
                f"These weights are not those of forecasts of {sorted(parts)} steps (first difference: "
                f"{(foreign or ['known'])[0]!r}); build the model for the steps that they were saved from."
            )
        for n, model in parts.items():
            prefix = f"steps{n}."
            model.load_state_dict({name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)})
        self._known = set(known)


def random_strings(keys: Keys, n: int, n_actions: int) -> Actions:
    """Random strings of actions, int64 [B, n], one string for each key."""
    return (uniforms(keys, n) * n_actions).astype(np.int64)
