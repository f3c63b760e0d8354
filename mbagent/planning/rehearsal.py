"""Trying ways to look ahead in imagination, and taking another than the usual one only where it plays better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.models.base import Actions, States
from mbagent.planning.fitted_values import Task
from mbagent.planning.leaf_values import Floats, LeafValues
from mbagent_envs.random_keys import derive

PLAYERS = 16
"""Episodes that each way is tried in; the luck is the same for all ways."""

BLOCKS, STEPS = 6, 5
"""They are played in blocks of so many steps, until one way is clearly better."""

CLEARLY = 1.5
"""Standard errors by which a way must beat the usual one in the end."""

SURELY = 3.0
"""Standard errors of a difference at which no more is played."""

_SALT = 0x4EE8


class Way(NamedTuple):
    """How a planner looks ahead where it cannot solve the whole machine.

    Attributes:
        leaf: what unexpanded states are worth.
        states: states imagined around a root before the search.
        samples: draws for each (state, action) near it.
    """

    leaf: LeafValues
    states: int
    samples: int


Act: TypeAlias = Callable[[Way, States], Actions]
"""``act(way, states int64 [B, F]) -> actions [B]``."""


def best_way(task: Task, usual: Way, others: Sequence[Way], act: Act) -> Way:
    """The first of the other ways that plays better than the usual one in imagination; the usual one where none does.

    Args:
        task: model, goal, start states, discount and seed.
        usual: the way that is taken when in doubt.
        others: the most hopeful first.
        act: chooses actions in a way.
    """
    known = _Trial(task, usual, act)
    for other in others:
        if _is_better(_Trial(task, other, act), known):
            return other
    return usual


def _is_better(other: _Trial, usual: _Trial) -> bool:
    gain, error = 0.0, 0.0
    for n_blocks in range(1, BLOCKS + 1):
        gains = other.returns(n_blocks) - usual.returns(n_blocks)
        gain, error = float(gains.mean()), float(gains.std(ddof=1)) / PLAYERS**0.5
        if abs(gain) > SURELY * error:
            break
    return gain > CLEARLY * error


class _Trial:
    """Imagined episodes from start states, played in one way."""

    def __init__(self, task: Task, way: Way, act: Act) -> None:
        self._task, self._way, self._act = task, way, act
        rng = np.random.default_rng([task.seed, _SALT])
        self._states = task.start[rng.integers(len(task.start), size=PLAYERS)]
        self._alive, self._totals = np.arange(PLAYERS), [np.zeros(PLAYERS)]

    def returns(self, n_blocks: int) -> Floats:
        """Discounted return [PLAYERS] of each episode after so many blocks; one that has ended earns nothing more."""
        while len(self._totals) <= n_blocks:
            total, begin = self._totals[-1].copy(), (len(self._totals) - 1) * STEPS
            for step in range(begin, begin + STEPS):
                self._step(step, total)
            self._totals.append(total)
        return self._totals[n_blocks]

    def _step(self, step: int, total: Floats) -> None:
        if len(self._alive) == 0:
            return
        task, states = self._task, self._states
        actions = self._act(self._way, states)
        after, over = task.model.sample(states, actions, derive(task.seed, _SALT, step, self._alive))
        total[self._alive] += task.gamma**step * task.goal(states, actions, after)
        self._alive, self._states = self._alive[~over], after[~over]
