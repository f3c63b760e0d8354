"""Returns of agents with the true and with a learned model, compared with the optimum or the best known player."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from exact import toy_text_mdp
from harness import Row
from mbagent.agent import ModelLearningAgent
from mbagent.evaluation.baselines import as_policy
from mbagent.evaluation.statistics import interquartile_interval, normalised
from mbagent.models.simulator import SimulatorModel
from mbagent.models.tabular import toy_text_model
from mbagent.types import Floats
from worlds.games import find_case, play
from worlds.known_rules import Scale, scale_of
from worlds.registry import find_world

GAMES = ("geyser_deterministic", "geyser_low_cost", "geyser_high_cost", "flier_catcher", "maneuverer")
"""Cases that are games."""

TOY_TEXT = {"FrozenLake 4x4": 100, "FrozenLake 8x8": 100, "CliffWalking": 200, "Taxi": 200}
"""Gymnasium's tabular MDPs, with the steps of an episode."""

EPISODES, SCALE_EPISODES, STEPS = 20, 300, 50_000
"""Episodes per seed; episodes for measuring the scale; steps for learning."""


@dataclass(frozen=True)
class Played:
    """Normalised returns of one agent.

    Attributes:
        world: its name.
        model: "true" or "learned".
        seed: seed of the agent.
        scores: normalised return of each episode; for a tabular MDP, the normalised exact value.
        value: mean return.
        reference: return that corresponds to 1.
    """

    world: str
    model: str
    seed: int
    scores: Floats
    value: float
    reference: float


def play_table(name: str, seed: int) -> Played:
    """Plans in a tabular MDP with its true model; the value of the agent's policy is computed exactly."""
    env = find_world(name).make(max_episode_steps=TOY_TEXT[name])
    model, reward = toy_text_model(env)
    agent = ModelLearningAgent("MctsPolicy", env, model=model, reward=reward, seed=seed)
    actions, _ = agent.predict(np.arange(model.cardinalities[0]))
    known = toy_text_mdp(env)
    value, low, high = known.policy_return(np.asarray(actions)), known.random_return(), known.optimal_return()
    return Played(name, "true", seed, np.asarray(normalised([value], low, high)), value, high)


def play_game(key: str, seed: int, learned: bool, scale: Scale, episodes: int = EPISODES, steps: int = STEPS) -> Played:
    """Plays a game with its true model, or with one learned from ``steps`` steps, with the agent's default settings."""
    case, game = find_case(key), find_case(key).game
    assert game is not None
    if learned:
        agent = ModelLearningAgent("MctsPolicy", case.make_env(), seed=seed).learn(steps, log_interval=None)
    else:
        agent = ModelLearningAgent("MctsPolicy", case.make_env(), model=SimulatorModel(game), seed=seed)
    returns = play(case, as_policy(agent), episodes=episodes, seed=seed, repeatable=True).default
    scores = np.asarray(normalised(returns, scale.random, scale.reference))
    return Played(key, "learned" if learned else "true", seed, scores, float(returns.mean()), scale.reference)


def scales(say: Callable[[str], None]) -> dict[str, Scale]:
    """Scales of all games."""
    found = {}
    for key in GAMES:
        say(f"scale of {key}")
        found[key] = scale_of(find_case(key).world, episodes=SCALE_EPISODES)
    return found


def summary(played: list[Played]) -> Row:
    """Row that summarises the agents of one world and model."""
    first = played[0]
    scores = np.stack([agent.scores for agent in played])
    interval = interquartile_interval(scores)
    return {
        "world": first.world,
        "model": first.model,
        "seeds": len(played),
        "episodes": scores.size,
        "normalised": interval.estimate,
        "low": interval.low,
        "high": interval.high,
        "return": float(np.mean([agent.value for agent in played])),
        "reference": first.reference,
    }
