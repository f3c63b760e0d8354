"""Racing of lookahead configurations in simulated episodes: a later one replaces the best only if clearly better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mbagent.planning.fitted_value_iteration import Task
from mbagent.planning.value_iteration import LeafValues
from mbagent.types import Actions, Floats, States
from mbagent_envs.random_keys import derive

RACED_EPISODES = 12
"""Number of simulated episodes for each configuration; all configurations share the random numbers."""

MOST_BLOCKS, BLOCK_STEPS = 5, 4
"""Maximum number of blocks of simulated steps, and steps of a block; a comparison can end after each block."""

CLEARLY = 1.5
"""Number of standard errors by which a configuration must be better than the best so far in the end."""

SURELY = 3.0
"""Number of standard errors of a positive difference at which a comparison ends early."""

HOPELESS = 0.5
"""Number of standard errors of a negative difference at which a configuration is rejected early."""

_SALT = 0x4EE8


class LookaheadConfig(NamedTuple):
    """Configuration of a planner's lookahead, used if the reachable MDP is too large to solve.

    Attributes:
        leaf: values of unexpanded states.
        states: number of states expanded around a root before the search.
        samples: number of samples for each (state, action) near the root.
    """

    leaf: LeafValues
    states: int
    samples: int


Act: TypeAlias = Callable[[LookaheadConfig, States], Actions]
"""``act(config, states int64 [B, F]) -> actions [B]``."""


def best_config(task: Task, configs: Sequence[LookaheadConfig], act: Act) -> LookaheadConfig:
    """The configuration with the highest return in simulated episodes; if there is no clear difference, the earlier one.

    Args:
        task: model, goal, start states, discount and seed.
        configs: candidates in order; to win, a later one must be clearly better than the best before it.
        act: function that chooses actions, given a configuration.
    """
    best, *others = (_Trial(task, config, act) for config in configs)
    for other in others:
        if _plays_better(other, best):
            best = other
    return best.config


def _plays_better(other: _Trial, best: _Trial) -> bool:
    """Whether the return of ``other`` is clearly higher than that of ``best``; simulates only until the result is clear."""
    gain, error = 0.0, 0.0
    for n_blocks in range(1, MOST_BLOCKS + 1):
        gains = other.returns(n_blocks) - best.returns(n_blocks)
        gain, error = float(gains.mean()), float(gains.std(ddof=1)) / RACED_EPISODES**0.5
        identical = n_blocks > 1 and not gains.any()
        if identical or gain < -HOPELESS * error or gain > SURELY * error:
            break
    return gain > CLEARLY * error


class _Trial:
    """Simulated episodes from start states with one configuration."""

    def __init__(self, task: Task, config: LookaheadConfig, act: Act) -> None:
        self.config, self._task, self._act = config, task, act
        rng = np.random.default_rng([task.seed, _SALT])
        self._states = task.start[rng.integers(len(task.start), size=RACED_EPISODES)]
        self._alive, self._total = np.arange(RACED_EPISODES), [np.zeros(RACED_EPISODES)]

    def returns(self, n_blocks: int) -> Floats:
        """Each episode's discounted return, [RACED_EPISODES], up to ``n_blocks`` blocks or its end, whichever is earlier."""
        while len(self._total) <= n_blocks * BLOCK_STEPS:
            self._step()
        return self._total[n_blocks * BLOCK_STEPS]

    def _step(self) -> None:
        """Simulates one step of all episodes that have not ended."""
        step, total = len(self._total) - 1, self._total[-1].copy()
        self._total.append(total)
        if len(self._alive) == 0:
            return
        task, states = self._task, self._states
        actions = self._act(self.config, states)
        next_states, terminated = task.model.sample(states, actions, derive(task.seed, _SALT, step, self._alive))
        total[self._alive] += task.gamma**step * task.goal(states, actions, next_states)
        self._alive, self._states = self._alive[~terminated], next_states[~terminated]
