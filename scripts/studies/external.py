"""The agent on environments of other packages, compared with the exact optimum, its planner on the true rules, and SB3.

A cell is one agent in one world with one seed: it learns, plays whole episodes, and is timed.
"""

from __future__ import annotations

import csv
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch

from harness import Result, Row, Run, grouped
from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.baselines import BaselineName, as_policy, train_baseline
from mbagent.evaluation.evaluate import Policy, evaluate_env, milliseconds_per_decision, random_policy
from mbagent.evaluation.report import Table, format_number
from mbagent.evaluation.statistics import interquartile_interval, interquartile_mean
from mbagent.learned_env import LearnedEnv
from worlds.known_rules import exact_world, scale_of, true_model
from worlds.registry import ARCADE, CONTINUOUS, WORLDS, World, for_networks

OURS, TRUE, IN_LEARNED_ENV = "mbagent", "mbagent, true model", "PPO in LearnedEnv"
AGENTS = (OURS, TRUE, "PPO", "DQN", IN_LEARNED_ENV, "random")
"""Agents: this one; its planner on the true rules; SB3's; SB3's PPO trained in the learned environment; random play."""

TIMED = 100
"""Number of observations from play on which single decisions are timed."""


@dataclass(frozen=True)
class Cell:
    """One agent in one world, with one seed.

    Attributes:
        world: the environment.
        agent: one of AGENTS.
        seed: seed of learning and play.
        steps: environment steps for learning.
        episodes: episodes to play.
        baseline_steps: training steps of the baselines, which may be more.
        reward_scale: factor of their rewards in training; None for their default.
    """

    world: World
    agent: str
    seed: int
    steps: int
    episodes: int
    baseline_steps: int
    reward_scale: float | None = None


@dataclass(frozen=True)
class Player:
    """A policy and the cost of its training."""

    policy: Policy
    steps: int
    learn_seconds: float
    repeatable: bool


def run_cell(cell: Cell) -> Result[Cell]:
    """Learns, plays and times. The normalised return uses the exact return if it is known, else the returns of episodes."""
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a learned reward, and of other packages
        scale = scale_of(cell.world)
        results = [(player, *_played(cell, player)) for player in (make() for make in _players(cell))]
        player, returns, milliseconds = max(results, key=lambda result: result[1].mean())
        exact = _exact_return(cell, player)
    span, value = scale.reference - scale.random, float(returns.mean()) if np.isnan(exact) else exact
    row = {
        "world": cell.world.name,
        "agent": cell.agent,
        "seed": cell.seed,
        "steps": player.steps,
        "episodes": len(returns),
        "return": float(returns.mean()),
        "exact": exact,
        "random": scale.random,
        "optimum": scale.reference,
        "normalised": (value - scale.random) / span,
        "positive": float((returns > 0).mean()),
        "learn_seconds": player.learn_seconds,
        "milliseconds": milliseconds,
    }
    label = f"{cell.world.name}, {cell.agent}, seed {cell.seed}: {row['return']:.3f} (normalised {row['normalised']:.3f})"
    return Result(cell, {"results": [row]}, label)


def _players(cell: Cell) -> Sequence[Callable[[], Player]]:
    """Ways to create the agent's player; SB3's have two, with the most likely or with sampled actions: the better one counts."""
    if cell.agent == OURS:
        return (partial(_ours, cell),)
    if cell.agent == TRUE:
        return (partial(_with_true_model, cell),)
    if cell.agent == "random":
        space = cell.world.make().action_space
        assert isinstance(space, gym.spaces.Discrete)
        return (partial(Player, random_policy(int(space.n), cell.seed), 0, 0.0, False),)
    make_env: Callable[[], gym.Env[Any, Any]] = cell.world.make_for_networks
    if cell.agent == IN_LEARNED_ENV:
        env = cell.world.make()
        agent = _learned(cell, env)
        limit = _limit(env)
        make_env = partial(_learned_env, agent, limit)
    name = cast("BaselineName", "PPO" if cell.agent == IN_LEARNED_ENV else cell.agent)
    began = time.perf_counter()
    algorithm, _ = train_baseline(
        name,
        make_env,
        steps=cell.baseline_steps,
        seed=cell.seed,
        evaluate=lambda policy, repeatable: 0.0,
        points=1,
        reward_scale=cell.reward_scale,
    )
    seconds = time.perf_counter() - began
    return tuple(
        partial(
            Player,
            _seen_as_by_networks(cell.world, as_policy(algorithm, deterministic=likely)),
            cell.baseline_steps,
            seconds,
            likely,
        )
        for likely in (True, False)
    )


def _learned(cell: Cell, env: gym.Env[Any, Any]) -> ModelLearningAgent:
    agent = ModelLearningAgent("MctsPolicy", env, seed=cell.seed, **cell.world.settings)
    return agent.learn(cell.steps, log_interval=None)


def _learned_env(agent: ModelLearningAgent, limit: int | None) -> gym.Env[Any, Any]:
    return for_networks(LearnedEnv(agent, max_episode_steps=limit))


def _limit(env: gym.Env[Any, Any]) -> int | None:
    """The step limit of an episode, wherever the package stores it."""
    inner: Any = env.unwrapped
    found = getattr(env.spec, "max_episode_steps", None) or getattr(inner, "max_steps", None)
    return int(found) if found else getattr(getattr(inner, "rddl", None), "horizon", None)


def _ours(cell: Cell) -> Player:
    began = time.perf_counter()
    agent = _learned(cell, cell.world.make())
    return Player(as_policy(agent), cell.steps, time.perf_counter() - began, True)


def _with_true_model(cell: Cell) -> Player:
    known = true_model(cell.world)
    if known is None:
        raise ValueError(f"The true rules of {cell.world.name} are not available.")
    model, reward = known
    agent = ModelLearningAgent("MctsPolicy", cell.world.make(), model=model, reward=reward, seed=cell.seed)
    return Player(as_policy(agent), 0, 0.0, True)


def _seen_as_by_networks(world: World, policy: Policy) -> Policy:
    """Converts a policy on the networks' observations to one on the world's own."""
    if world.kind != "minigrid":
        return policy
    return lambda obs: policy(np.asarray(obs).reshape(len(obs), -1).astype(np.float32) / 10)


def _played(cell: Cell, player: Player) -> tuple[np.ndarray, float]:
    """Returns of whole episodes, and milliseconds per decision for one observation."""
    returns = evaluate_env(
        cell.world.make, player.policy, episodes=cell.episodes, seed=cell.seed, repeatable=player.repeatable
    ).default
    return returns, milliseconds_per_decision(player.policy, _observed(cell, player.policy))


def _exact_return(cell: Cell, player: Player) -> float:
    """Expected return if the rules are known and the player is deterministic; else NaN."""
    known = exact_world(cell.world)
    return known.policy_return(player.policy(known.observations)) if known is not None and player.repeatable else float("nan")


def _observed(cell: Cell, policy: Policy) -> np.ndarray:
    """Observations from play in one copy of the environment."""
    env = cell.world.make()
    observed: list[Any] = []
    obs, _ = env.reset(seed=cell.seed)
    while len(observed) < TIMED:
        observed.append(obs)
        obs, _, terminated, truncated, _ = env.step(int(policy(np.asarray(obs)[None])[0]))
        if terminated or truncated:
            obs, _ = env.reset()
    return np.stack(observed)


def show(rows: Sequence[Row], run: Run) -> None:
    """Prints each agent in each world: normalised return as interquartile mean over seeds, the rest as means."""
    order = {name: i for i, name in enumerate(AGENTS)}
    places = {world.name: i for i, world in enumerate((*WORLDS, *CONTINUOUS, *ARCADE))}
    lines = []
    for (world, agent), group in sorted(
        grouped(rows, ("world", "agent")).items(), key=lambda item: (places[item[0][0]], order[item[0][1]])
    ):
        mean = {name: float(np.mean([row[name] for row in group])) for name in group[0] if name not in ("world", "agent")}
        known = np.isfinite(mean["normalised"])
        interval = interquartile_interval(np.array([[row["normalised"]] for row in group])) if known else None
        ends = f"{interval.low:.3f} to {interval.high:.3f}" if interval and len(group) > 1 else "–"
        figures = [f"{mean['steps']:,.0f}", *(f"{mean[name]:.3f}" for name in ("return", "exact", "optimum"))]
        figures += [f"{interval.estimate:.3f}" if interval else "–", ends, f"{100 * mean['positive']:.1f}%"]
        figures += [f"{mean['learn_seconds']:.1f}", f"{mean['milliseconds']:.2f}"]
        lines.append([world, agent, *("–" if figure == "nan" else figure for figure in figures)])
    names = ("world", "agent", "steps", "return", "exact", "optimum", "normalised", "95%", "return > 0", "learning, s")
    run.show("Environments of other packages", (*names, "decision, ms"), lines, width=150)


def markdown_table(paths: Sequence[Path]) -> str:
    """Markdown table from files with the rows of ``run_cell``; if a world and an agent are in several, the last one counts.

    Normalised returns are interquartile means over trainings; if the optimum is not known, the share of episodes with a return
    above 0 is shown. Times are medians, since the first training includes compilation and single ones may plan differently.
    """
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            new: dict[tuple[str, str], list[dict[str, str]]] = {}
            for row in csv.DictReader(file):
                new.setdefault((row["world"], row["agent"]), []).append(row)
        found |= new
    agents = [agent for agent in AGENTS if any(agent == other for _, other in found)]
    lines = []
    for world in WORLDS:
        groups = {agent: found.get((world.name, agent), []) for agent in agents}
        if any(groups.values()):
            ours = [_median(groups.get(OURS, []), name, digits) for name, digits in (("learn_seconds", 1), ("milliseconds", 2))]
            lines.append([world.name, *(_score(group) for group in groups.values()), *ours])
    return Table(["", *agents, "learning, s", "decision, ms"], lines).markdown()


def _score(rows: Sequence[dict[str, str]]) -> str:
    if not rows:
        return "–"
    values = np.array([float(row["normalised"]) for row in rows])
    if np.isfinite(values).all():
        return format_number(float(interquartile_mean(values)), 3)
    return f"{100 * np.mean([float(row['positive']) for row in rows]):.3g}%"


def _median(rows: Sequence[dict[str, str]], name: str, digits: int) -> str:
    return format_number(float(np.median([float(row[name]) for row in rows])), digits) if rows else "–"
