"""Benefit of fitted leaf values in MDPs with many noisy variables that are too large to solve."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from harness import Row
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner
from mbagent.types import Actions, Floats, States
from mbagent_envs.random_keys import derive
from worlds.coupled import CoupledWorld

EPISODES, STEPS = 16, 40
"""Number of episodes played in parallel, and their length."""

_SALT = 0xC40D


def play(world: CoupledWorld, act: Callable[[States], Actions], seed: int) -> Floats:
    """Plays episodes in parallel and returns their returns [EPISODES]."""
    rng = np.random.default_rng([seed, _SALT])
    states, total = world.start[rng.integers(len(world.start), size=EPISODES)], np.zeros(EPISODES)
    for step in range(STEPS):
        actions = act(states)
        after, _ = world.model.sample(states, actions, derive(seed, _SALT, step, np.arange(EPISODES)))
        total += world.goal(states, actions, after)
        states = after
    return total


def compare_values(world: CoupledWorld, seed: int) -> list[Row]:
    """Rows for random play, and for the default planner without and with fitted leaf values."""
    rng, rows = np.random.default_rng(seed), []
    returns = play(world, lambda states: rng.integers(world.model.n_actions, size=len(states)), seed)
    rows.append(_row(world, "random", returns, 0.0, 0.0))
    for name, learn_values in (("lookahead", False), ("learned values", True)):
        planner = MctsPlanner(PlannerSettings(learn_values=learn_values, seed=seed))
        planner.set_model(world.model, world.start)
        planner.set_goal(world.goal)
        planner.plan(world.start[:1])  # includes compilation
        planner.set_goal(world.goal)
        began = time.process_time()
        planner.plan(world.start[:1])
        once, began = time.process_time() - began, time.process_time()
        returns = play(world, lambda states, planner=planner: planner.plan(states).actions, seed)  # type: ignore[misc]
        rows.append(_row(world, name, returns, once, 1e3 * (time.process_time() - began) / (EPISODES * STEPS)))
    return rows


def _row(world: CoupledWorld, planner: str, returns: Floats, once: float, each: float) -> Row:
    error = float(returns.std(ddof=1) / np.sqrt(len(returns)))
    return {
        "world": world.name, "planner": planner, "return": float(returns.mean()), "error": error, "once for a goal, s": once,
        "ms a decision": each,
    }  # fmt: skip
