"""Trying ways to look ahead in imagination, and taking another than the first only where it plays better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.planning.fitted_value_iteration import Task
from mbagent.planning.value_function import LeafValues
from mbagent.types import Actions, Floats, States
from mbagent_envs.random_keys import derive

RACED_EPISODES = 12
"""Episodes that each way is tried in; the luck is the same for all ways."""

MOST_BLOCKS, BLOCK_STEPS = 5, 4
"""They are played in blocks of so many steps, until one way is clearly better."""

CLEARLY = 1.5
"""Standard errors by which a way must beat the best before it in the end."""

SURELY = 3.0
"""Standard errors of a difference at which no more is played."""

HOPELESS = 0.5
"""Standard errors by which a way is behind when it is given up."""

_SALT = 0x4EE8


class LookaheadConfig(NamedTuple):
    """How a planner looks ahead where it cannot solve the whole machine.

    Attributes:
        leaf: what unexpanded states are worth.
        states: states imagined around a root before the search.
        samples: draws for each (state, action) near it.
    """

    leaf: LeafValues
    states: int
    samples: int


Act: TypeAlias = Callable[[LookaheadConfig, States], Actions]
"""``act(config, states int64 [B, F]) -> actions [B]``."""


def best_config(task: Task, configs: Sequence[LookaheadConfig], act: Act) -> LookaheadConfig:
    """The way that earns most in imagined play; in doubt the earlier one.

    Args:
        task: model, goal, states to start from, discount and seed.
        configs: another than the first must clearly beat the best before it.
        act: chooses actions in a way.
    """
    best, *others = (_Trial(task, config, act) for config in configs)
    for other in others:
        if _plays_better(other, best):
            best = other
    return best.config


def _plays_better(other: _Trial, best: _Trial) -> bool:
    """Whether one way clearly earns more than another; no more is played than it takes to tell."""
    gain, error = 0.0, 0.0
    for n_blocks in range(1, MOST_BLOCKS + 1):
        gains = other.returns(n_blocks) - best.returns(n_blocks)
        gain, error = float(gains.mean()), float(gains.std(ddof=1)) / RACED_EPISODES**0.5
        alike = n_blocks > 1 and not gains.any()
        if alike or gain < -HOPELESS * error or gain > SURELY * error:
            break
    return gain > CLEARLY * error


class _Trial:
    """Expanded episodes from start states, played in one way."""

    def __init__(self, task: Task, config: LookaheadConfig, act: Act) -> None:
        self.config, self._task, self._act = config, task, act
        rng = np.random.default_rng([task.seed, _SALT])
        self._states = task.start[rng.integers(len(task.start), size=RACED_EPISODES)]
        self._alive, self._total = np.arange(RACED_EPISODES), [np.zeros(RACED_EPISODES)]

    def returns(self, n_blocks: int) -> Floats:
        """Discounted return [RACED_EPISODES] of each episode after so many blocks; one that has ended earns nothing more."""
        while len(self._total) <= n_blocks * BLOCK_STEPS:
            self._play()
        return self._total[n_blocks * BLOCK_STEPS]

    def _play(self) -> None:
        """One step of all episodes that go on."""
        step, total = len(self._total) - 1, self._total[-1].copy()
        self._total.append(total)
        if len(self._alive) == 0:
            return
        task, states = self._task, self._states
        actions = self._act(self.config, states)
        after, over = task.model.sample(states, actions, derive(task.seed, _SALT, step, self._alive))
        total[self._alive] += task.gamma**step * task.goal(states, actions, after)
        self._alive, self._states = self._alive[~over], after[~over]
