"""Trying ways to look ahead in imagination, and taking another than the usual one only where it plays better."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.models.base import Actions, States
from mbagent.planning.fitted_values import Task
from mbagent.planning.leaf_values import Floats, LeafValues
from mbagent_envs.random_keys import derive

PLAYERS = 12
"""Episodes that each way is tried in; the luck is the same for all ways."""

BLOCKS, STEPS = 5, 4
"""They are played in blocks of so many steps, until one way is clearly better."""

CLEARLY = 1.5
"""Standard errors by which a way must beat the usual one in the end."""

SURELY = 3.0
"""Standard errors of a difference at which no more is played."""

HOPELESS = 0.5
"""Standard errors by which a way is behind when it is given up."""

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


def plays_better(task: Task, other: Way, usual: Way, act: Act) -> bool:
    """Whether a way clearly earns more than the usual one in imagined play.

    Args:
        task: model, goal, states to start from, discount and seed.
        other: the way in question.
        usual: the way that is taken when in doubt.
        act: chooses actions in a way.
    """
    trials, gain, error = (_Trial(task, other, act), _Trial(task, usual, act)), 0.0, 0.0
    for n_blocks in range(1, BLOCKS + 1):
        gains = trials[0].returns(n_blocks) - trials[1].returns(n_blocks)
        gain, error = float(gains.mean()), float(gains.std(ddof=1)) / PLAYERS**0.5
        alike = n_blocks > 1 and not gains.any()
        if alike or gain < -HOPELESS * error or gain > SURELY * error:
            break
    return gain > CLEARLY * error


class _Trial:
    """Imagined episodes from start states, played in one way."""

    def __init__(self, task: Task, way: Way, act: Act) -> None:
        self._task, self._way, self._act = task, way, act
        rng = np.random.default_rng([task.seed, _SALT])
        self._states = task.start[rng.integers(len(task.start), size=PLAYERS)]
        self._alive, self._total, self._step = np.arange(PLAYERS), np.zeros(PLAYERS), 0

    def returns(self, n_blocks: int) -> Floats:
        """Discounted return [PLAYERS] of each episode after so many blocks; one that has ended earns nothing more."""
        while self._step < n_blocks * STEPS and len(self._alive):
            self._play()
        return self._total

    def _play(self) -> None:
        """One step of all episodes that go on."""
        task, states = self._task, self._states
        actions = self._act(self._way, states)
        after, over = task.model.sample(states, actions, derive(task.seed, _SALT, self._step, self._alive))
        self._total[self._alive] += task.gamma**self._step * task.goal(states, actions, after)
        self._alive, self._states = self._alive[~over], after[~over]
        self._step += 1
