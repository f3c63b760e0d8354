"""One agent in one world with one seed: it learns, plays whole episodes, and is timed."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch

from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.baselines import BaselineName, as_policy, train_baseline
from mbagent.evaluation.evaluate import Policy, evaluate_env, milliseconds_per_decision, random_policy
from mbagent.learned_env import LearnedEnv
from worlds.environments import World, exact_world, for_networks, scale_of, true_model

Row = dict[str, Any]

OURS, TRUE, IMAGINED = "mbagent", "mbagent, true model", "PPO in LearnedEnv"
AGENTS = (OURS, TRUE, "PPO", "DQN", IMAGINED, "random")
"""Agents: this one; its planner on the true rules; SB3's; SB3's PPO trained in what this one learned; random play."""

TIMED = 100
"""Observations met in play on which single decisions are timed."""


@dataclass(frozen=True)
class Task:
    """One agent in one world, with one seed.

    Attributes:
        world: where.
        agent: one of AGENTS.
        seed: of learning and play.
        steps: environment steps for learning.
        episodes: to play.
        baseline_steps: steps for the baselines, which may be more.
        reward_scale: what their rewards are multiplied with for training; None for their usual scale.
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
    """A policy with what it took to get it."""

    policy: Policy
    steps: int
    learn_seconds: float
    repeatable: bool


def run_task(task: Task) -> Row:
    """Learns, plays and times. The normalised return is of the exact return where that is known, else of the episodes'."""
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the reward is learned, and of packages around
        scale = scale_of(task.world)
        results = [(player, *_played(task, player)) for player in (make() for make in _players(task))]
        player, returns, milliseconds = max(results, key=lambda result: result[1].mean())
        exact = _exact_return(task, player)
    span, value = scale.reference - scale.random, float(returns.mean()) if np.isnan(exact) else exact
    return {
        "world": task.world.name,
        "agent": task.agent,
        "seed": task.seed,
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


def _players(task: Task) -> Sequence[Callable[[], Player]]:
    """How to get the agent; of SB3's there are two, which act by their likeliest actions or draw them: the better counts."""
    if task.agent == OURS:
        return (partial(_ours, task),)
    if task.agent == TRUE:
        return (partial(_with_true_model, task),)
    if task.agent == "random":
        space = task.world.make().action_space
        assert isinstance(space, gym.spaces.Discrete)
        return (partial(Player, random_policy(int(space.n), task.seed), 0, 0.0, False),)
    make_env: Callable[[], gym.Env[Any, Any]] = task.world.make_for_networks
    if task.agent == IMAGINED:
        env = task.world.make()
        agent = _learned(task, env)
        limit = _limit(env)
        make_env = partial(_imagined, agent, limit)
    name = cast("BaselineName", "PPO" if task.agent == IMAGINED else task.agent)
    began = time.perf_counter()
    algorithm, _ = train_baseline(
        name,
        make_env,
        steps=task.baseline_steps,
        seed=task.seed,
        evaluate=lambda policy, repeatable: 0.0,
        points=1,
        reward_scale=task.reward_scale,
    )
    seconds = time.perf_counter() - began
    return tuple(
        partial(
            Player,
            _seen_as_by_networks(task.world, as_policy(algorithm, deterministic=likely)),
            task.baseline_steps,
            seconds,
            likely,
        )
        for likely in (True, False)
    )


def _learned(task: Task, env: gym.Env[Any, Any]) -> ModelLearningAgent:
    agent = ModelLearningAgent("MctsPolicy", env, seed=task.seed, **task.world.settings)
    return agent.learn(task.steps, log_interval=None)


def _imagined(agent: ModelLearningAgent, limit: int | None) -> gym.Env[Any, Any]:
    return for_networks(LearnedEnv(agent, max_episode_steps=limit))


def _limit(env: gym.Env[Any, Any]) -> int | None:
    """The steps of an episode, wherever a package keeps them."""
    inner: Any = env.unwrapped
    found = getattr(env.spec, "max_episode_steps", None) or getattr(inner, "max_steps", None)
    return int(found) if found else getattr(getattr(inner, "rddl", None), "horizon", None)


def _ours(task: Task) -> Player:
    began = time.perf_counter()
    agent = _learned(task, task.world.make())
    return Player(as_policy(agent), task.steps, time.perf_counter() - began, True)


def _with_true_model(task: Task) -> Player:
    known = true_model(task.world)
    if known is None:
        raise ValueError(f"The true rules of {task.world.name} are not at hand.")
    model, reward = known
    agent = ModelLearningAgent("MctsPolicy", task.world.make(), model=model, reward=reward, seed=task.seed)
    return Player(as_policy(agent), 0, 0.0, True)


def _seen_as_by_networks(world: World, policy: Policy) -> Policy:
    """A policy on observations as the world shows them."""
    if world.kind != "minigrid":
        return policy
    return lambda obs: policy(np.asarray(obs).reshape(len(obs), -1).astype(np.float32) / 10)


def _played(task: Task, player: Player) -> tuple[np.ndarray, float]:
    """Returns of whole episodes, and milliseconds of a decision about one observation."""
    returns = evaluate_env(
        task.world.make, player.policy, episodes=task.episodes, seed=task.seed, repeatable=player.repeatable
    ).default
    return returns, milliseconds_per_decision(player.policy, _met(task, player.policy))


def _exact_return(task: Task, player: Player) -> float:
    """Expected return, where the rules are known and the player always does the same; else NaN."""
    known = exact_world(task.world)
    return known.policy_return(player.policy(known.observations)) if known is not None and player.repeatable else float("nan")


def _met(task: Task, policy: Policy) -> np.ndarray:
    """Observations met in play, one copy."""
    env = task.world.make()
    met: list[Any] = []
    obs, _ = env.reset(seed=task.seed)
    while len(met) < TIMED:
        met.append(obs)
        obs, _, terminated, truncated, _ = env.step(int(policy(np.asarray(obs)[None])[0]))
        if terminated or truncated:
            obs, _ = env.reset()
    return np.stack(met)
