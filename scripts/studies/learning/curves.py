"""Learning curves: returns of one agent in one world after given numbers of environment steps."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import gymnasium as gym
import numpy as np
import torch

from harness import Result, Row, Run, grouped
from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.baselines import BaselineName, as_policy, train_baseline
from mbagent.evaluation.evaluate import Policy, evaluate_env, random_policy
from mbagent.evaluation.figures import Line, Panel, draw_panels
from worlds.registry import World, for_networks

OURS, RANDOM = "mbagent", "random"
PLAYERS = (OURS, "PPO", "DQN", RANDOM)


@dataclass(frozen=True)
class Cell:
    """One agent in one world, with the steps after which it is evaluated.

    Attributes:
        world: the environment.
        agent: one of PLAYERS.
        seed: seed of learning and play.
        marks: environment steps after which to play, ascending.
        episodes: episodes per mark, the same for all agents.
    """

    world: World
    agent: str
    seed: int
    marks: tuple[int, ...]
    episodes: int


def run_cell(cell: Cell) -> Result[Cell]:
    """Learns up to each mark, with a row for each."""
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a learned reward, and of other packages
        rows = {OURS: _ours, RANDOM: _random}.get(cell.agent, _baseline)(cell)
    last = rows[-1]
    label = f"{last['world']}, {last['agent']}, seed {last['seed']}: {last['return']:.2f} after {last['steps']:,} steps"
    return Result(cell, {"curves": rows}, label)


def _random(cell: Cell) -> list[Row]:
    space = cell.world.make().action_space
    assert isinstance(space, gym.spaces.Discrete)
    return [_row(cell, cell.marks[-1], random_policy(int(space.n), cell.seed), False, 0.0)]


def _row(cell: Cell, steps: int, policy: Policy, repeatable: bool, seconds: float) -> Row:
    began = time.perf_counter()
    played = evaluate_env(cell.world.make, policy, episodes=cell.episodes, seed=cell.seed, repeatable=repeatable)
    returns = played.default
    return {
        "world": cell.world.name,
        "agent": cell.agent,
        "seed": cell.seed,
        "steps": steps,
        "return": float(returns.mean()),
        "error": float(returns.std(ddof=1) / len(returns) ** 0.5) if len(returns) > 1 else float("nan"),
        "episodes": len(returns),
        "learn_seconds": seconds,
        "play_seconds": time.perf_counter() - began,
    }


def _ours(cell: Cell) -> list[Row]:
    agent, rows, seconds = ModelLearningAgent("MctsPolicy", cell.world.make(), seed=cell.seed), [], 0.0
    for mark in cell.marks:
        began = time.perf_counter()
        agent.learn(mark - agent.num_timesteps, log_interval=None, reset_num_timesteps=False)
        seconds += time.perf_counter() - began
        rows.append(_row(cell, mark, as_policy(agent), True, seconds))
    return rows


def _baseline(cell: Cell) -> list[Row]:
    """One training per mark, so that schedules end there; the better of most likely and sampled actions counts."""
    rows = []
    for mark in cell.marks:
        began = time.perf_counter()
        name = cast("BaselineName", cell.agent)
        algorithm, _ = train_baseline(
            name,
            lambda: for_networks(cell.world.make()),
            steps=mark,
            seed=cell.seed,
            evaluate=lambda policy, repeatable: 0.0,
            points=1,
        )
        seconds = time.perf_counter() - began
        both = [_row(cell, mark, as_policy(algorithm, deterministic=likely), likely, seconds) for likely in (True, False)]
        rows.append(max(both, key=lambda row: float(row["return"])))
    return rows


def show(rows: Sequence[Row], run: Run) -> None:
    """Prints means over seeds."""
    lines = []
    for (world, agent, steps), own in sorted(grouped(rows, ("world", "agent", "steps")).items()):
        value, error, seconds = (float(np.mean([row[name] for row in own])) for name in ("return", "error", "learn_seconds"))
        lines.append([world, agent, f"{steps:,}", f"{value:.2f}", f"{error:.2f}", f"{seconds:.0f}"])
    run.show("Learning curves", ("world", "agent", "steps", "return", "standard error", "learning, s"), lines)


def draw_curves(rows: Sequence[Row]) -> bytes:
    """Plots mean return against environment steps: a panel per world, a line per agent and seed. Returns a PNG."""
    panels: list[Panel] = []
    for (world,), mine in grouped(rows, ("world",)).items():
        lines = []
        for (agent, _), own in sorted(grouped(mine, ("agent", "seed")).items()):
            own.sort(key=lambda row: int(row["steps"]))
            steps, values, errors = ([row[name] for row in own] for name in ("steps", "return", "error"))
            colour = f"C{PLAYERS.index(agent)}"
            if agent == RANDOM:
                lines.append(Line((), values, colour, agent, style=":"))
            else:
                lines.append(Line(steps, values, colour, agent, errors, marker="."))
        panels.append(Panel(world, lines, "environment steps", "" if panels else "return", "log"))
    return draw_panels(panels, size=(3.4, 2.9), legend="below")
