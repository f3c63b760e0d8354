"""Known rules of worlds, as tables or models, and the scales of their returns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import gymnasium as gym

from exact import FiniteHorizonMDP, toy_text_mdp
from mbagent.adapters.rddl import RddlEnv
from mbagent.evaluation.evaluate import Policy, evaluate_env, evaluate_game, random_policy
from mbagent.models.protocol import TransitionModel
from mbagent.models.simulator import SimulatorModel
from mbagent.models.tabular import toy_text_model
from mbagent.rewards import RewardFn
from mbagent_envs.game import Game
from mbagent_envs.references import reference_policy
from worlds.rddl import RddlModel, RddlTables, rddl_tables
from worlds.registry import World, find_world
from worlds.snapshots import SnapshotModel

RANDOM_EPISODES = 300
"""Number of episodes of random play for the scale of worlds that are neither games nor known as tables."""


@cache
def tables_of(target: str) -> RddlTables:
    """The tables of an RDDL domain's first instance."""
    return rddl_tables(RddlEnv(target))


def exact_world(world: World) -> FiniteHorizonMDP | None:
    """A world as tables; None if its rules are not available."""
    if world.kind in ("toy_text", "planes"):
        return toy_text_mdp(world.make())
    return _exact_rddl(world.target) if world.kind == "rddl" else None


@cache
def _exact_rddl(target: str) -> FiniteHorizonMDP:
    return tables_of(target).mdp(RddlEnv(target).rddl.horizon)


def true_model(world: World) -> tuple[TransitionModel, RewardFn] | None:
    """A world's rules and reward for the planner; None if they are not available."""
    if world.kind == "toy_text":
        return toy_text_model(world.make())
    if world.kind == "game":
        game = game_of(world)
        assert game is not None
        return SimulatorModel(game), game.reward
    if world.kind == "rddl":
        model = RddlModel(tables_of(world.target))
        return model, model.reward
    if world.kind == "minigrid":
        tried = _snapshots(world.name)
        return tried, tried.reward
    return None


@cache
def _snapshots(name: str) -> SnapshotModel:
    return SnapshotModel(find_world(name).make())


def game_of(world: World) -> Game | None:
    """A game as pure functions; None if the world is not one of this repository's games."""
    env = world.make()
    game = getattr(env.unwrapped, "game", None)
    env.close()
    return game if isinstance(game, Game) else None


@dataclass(frozen=True)
class Scale:
    """Scale of a world's normalised returns: the returns that correspond to 0 and 1.

    Attributes:
        random: mean return of uniformly random play.
        reference: mean return of the reference; NaN if the goal has none.
    """

    random: float
    reference: float


def scale_of(world: World, goal: str = "default", episodes: int = 1000) -> Scale:
    """The scale of a world: exact if it is known as tables, else measured.

    Args:
        world: the world.
        goal: name of a game's goal.
        episodes: episodes of a game's reference player; random play, which is fast and varies most, plays ten times as many.
            Without a reference the best return is not known.
    """
    known = exact_world(world)
    if known is not None:
        return Scale(known.random_return(), known.optimal_return())
    game = game_of(world)
    if game is not None:
        return _scale_of_game(game, goal, episodes)
    space = world.make().action_space
    assert isinstance(space, gym.spaces.Discrete)
    chance = random_policy(int(space.n), seed=1)
    return Scale(float(evaluate_env(world.make, chance, episodes=RANDOM_EPISODES, seed=1).default.mean()), float("nan"))


def _scale_of_game(game: Game, goal: str, episodes: int) -> Scale:
    seed = 1_000_000  # separate from the agents' evaluation episodes
    goals = {goal: {"default": game.reward, **game.reward_functions}[goal]}

    def mean(policy: Policy, n: int, *, repeatable: bool = False) -> float:
        return float(evaluate_game(game, policy, episodes=n, seed=seed, goals=goals, repeatable=repeatable).returns[goal].mean())

    best = reference_policy(game, goal)
    low = mean(random_policy(int(game.action_space.n)), 10 * episodes)
    return Scale(low, mean(best, episodes, repeatable=True) if best is not None else float("nan"))
