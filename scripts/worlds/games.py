"""What the agents are compared on: games with their settings, and the scales of their returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

import mbagent_envs  # noqa: F401  (registers the games)
from exact import toy_text_mdp
from harness import find
from mbagent.evaluation.evaluate import Evaluation, Policy, evaluate_env, evaluate_game, random_policy
from mbagent_envs.game import Game
from mbagent_envs.references import reference_policy


@dataclass(frozen=True)
class Case:
    """One environment with its settings.

    Attributes:
        key: short name, used in results.csv.
        title: what the report calls it.
        env_id: id for ``gym.make``.
        kwargs: arguments for ``gym.make``.
        about: one or two sentences for a newcomer.
        reference: what the normalised return of 1 stands for.
        exact: whether that is the exact optimum.
        steps_limit: environment steps for learning; None for the comparison's own number.
        change_goals: whether the change-of-goal experiment is run on it.
        reward_given: whether the agent may read the environment's reward function; it learns one otherwise.
        episodes: reporting episodes are multiplied by this: where there are few states, many cost little.
    """

    key: str
    title: str
    env_id: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""
    reference: str = ""
    exact: bool = True
    steps_limit: int | None = None
    change_goals: bool = False
    reward_given: bool = True
    episodes: int = 1

    def make_env(self, **more: Any) -> gym.Env[Any, Any]:
        """A new environment."""
        return gym.make(self.env_id, **self.kwargs, **more)

    def steps(self, default: int) -> int:
        """Environment steps for learning."""
        return default if self.steps_limit is None else min(self.steps_limit, default)


_OPTIMUM = "the exact optimum, by value iteration"
_GEYSER = "mbagent/GeyserRunner-v0"
_GEYSER_TEXT = (
    "A runner earns more the further right it stands, but the right half is full of geysers, one of which "
    "erupts at a time; being hit costs {cost} points. "
)

CASES: tuple[Case, ...] = (
    Case(
        "geyser_deterministic",
        "GeyserRunner, deterministic",
        _GEYSER,
        {"mode": "deterministic"},
        _GEYSER_TEXT.format(cost=2)
        + "The eruptions follow a fixed pattern: the best player runs right and steps aside just in time.",
        _OPTIMUM,
        change_goals=True,
        episodes=5,
    ),
    Case(
        "geyser_low_cost",
        "GeyserRunner, stochastic, hit cost 1",
        _GEYSER,
        {"mode": "stochastic", "hit_cost": 1.0},
        _GEYSER_TEXT.format(cost=1)
        + "The eruptions are random and hits are cheap: the best player runs to the far right and stays.",
        _OPTIMUM,
        change_goals=True,
        episodes=5,
    ),
    Case(
        "geyser_high_cost",
        "GeyserRunner, stochastic, hit cost 5",
        _GEYSER,
        {"mode": "stochastic", "hit_cost": 5.0},
        _GEYSER_TEXT.format(cost=5)
        + "The eruptions are random and hits are expensive: the best player sits on the last safe column.",
        _OPTIMUM,
        episodes=5,
    ),
    Case(
        "maneuverer",
        "Maneuverer",
        "mbagent/Maneuverer-v0",
        {},
        "A player walks round walls to a target; each time it arrives, walls and target are drawn anew "
        "around it, so that almost every layout is one it has never seen. One point for each target.",
        "shortest paths",
        exact=False,
        change_goals=True,
    ),
    Case(
        "flier_catcher",
        "FlierCatcher",
        "mbagent/FlierCatcher-v0",
        {},
        "Fliers come in from the right, one column a step, at random rows; the player moves up and down in "
        "the first column and earns a point for each flier it catches.",
        "dynamic programming over the visible fliers, strong but not proved optimal",
        exact=False,
        change_goals=True,
    ),
    Case(
        "frozen_lake",
        "FrozenLake 4x4",
        "FrozenLake-v1",
        {"map_name": "4x4", "is_slippery": True},
        "Gymnasium's slippery lake: the agent is told neither the reward nor when an episode ends and learns "
        "both. One point for the goal, holes end the episode.",
        "the exact optimum, by dynamic programming over 100 steps",
        steps_limit=20_000,
        reward_given=False,
        episodes=50,
    ),
)
"""The cases of the comparison, in the report's order."""


def find_case(key: str) -> Case:
    """The case called ``key``.

    Raises:
        ValueError: there is none; the message lists those there are.
    """
    return find("case", key, {case.key: case for case in CASES})


def game_of(case: Case) -> Game | None:
    """The case's game as pure functions, or None when it is not one of this package's games."""
    env = case.make_env()
    game = getattr(env.unwrapped, "game", None)
    env.close()
    return game if isinstance(game, Game) else None


def goals_of(case: Case) -> list[str]:
    """Names of the case's goals, "default" first."""
    game = game_of(case)
    others = [] if game is None else sorted(name for name in game.reward_functions if name != "default")
    return ["default", *others]


def play(
    case: Case,
    policy: Policy,
    *,
    episodes: int,
    seed: int,
    goals: tuple[str, ...] = ("default",),
    repeatable: bool = False,
    report: Callable[[float], None] | None = None,
) -> Evaluation:
    """Plays reporting episodes of a case and scores them for the goals named; see ``evaluate_game``."""
    game = game_of(case)
    if game is None:
        return evaluate_env(case.make_env, policy, episodes=episodes, seed=seed, repeatable=repeatable)
    functions = {"default": game.reward, **game.reward_functions}
    chosen = {name: functions[name] for name in goals}
    return evaluate_game(game, policy, episodes=episodes, seed=seed, goals=chosen, repeatable=repeatable, report=report)


@dataclass(frozen=True)
class Scale:
    """Where 0 and 1 lie on a case's scale of normalised returns.

    Attributes:
        random: mean return of uniformly random play.
        reference: mean return of the reference; NaN when the goal has none.
    """

    random: float
    reference: float


def measure_scale(case: Case, goal: str = "default", episodes: int = 1000) -> Scale:
    """Measures a goal's scale over many episodes, or computes it exactly from a toy_text table."""
    game = game_of(case)
    if game is None:
        known = toy_text_mdp(case.make_env())
        return Scale(known.random_return(), known.optimal_return())
    seed = 1_000_000  # not the episodes that the agents are scored on
    chance = random_policy(int(game.action_space.n))
    # Random play is quick, and its returns vary most.
    low = play(case, chance, episodes=10 * episodes, seed=seed, goals=(goal,)).returns[goal].mean()
    best = reference_policy(game, goal)
    if best is None:
        return Scale(float(low), float("nan"))
    high = play(case, best, episodes=episodes, seed=seed, goals=(goal,), repeatable=True).returns[goal].mean()
    return Scale(float(low), float(high))
