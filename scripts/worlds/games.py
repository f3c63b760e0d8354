"""The cases on which agents are compared: games with their settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from harness import find
from mbagent.evaluation.evaluate import Evaluation, Policy, evaluate_env, evaluate_game
from mbagent_envs.game import Game
from worlds.known_rules import game_of
from worlds.registry import World, find_world


@dataclass(frozen=True)
class Case:
    """One environment with its settings.

    Attributes:
        key: short name, used in results.csv.
        world: the environment; the report uses its name.
        about: one or two sentences for a newcomer.
        reference: description of the normalised return 1.
        exact: whether it is the exact optimum.
        steps_limit: environment steps for learning; None for the number in the comparison's settings.
        change_goals: whether the change-of-goal experiment is run.
        reward_given: whether the agent may use the environment's reward function; otherwise it learns one.
        episodes: factor of the number of evaluation episodes, which are cheap with few states.
    """

    key: str
    world: World
    about: str = ""
    reference: str = ""
    exact: bool = True
    steps_limit: int | None = None
    change_goals: bool = False
    reward_given: bool = True
    episodes: int = 1

    @property
    def title(self) -> str:
        """Title in the report."""
        return self.world.name

    def make_env(self, **more: Any) -> gym.Env[Any, Any]:
        """A new environment."""
        return self.world.make(**more)

    @property
    def game(self) -> Game | None:
        """The game as pure functions, or None if it is not one of this repository's games."""
        return game_of(self.world)

    def steps(self, default: int) -> int:
        """Environment steps for learning."""
        return default if self.steps_limit is None else min(self.steps_limit, default)


_OPTIMUM = "the exact optimum, by value iteration"
_GEYSER_TEXT = (
    "A runner earns more the further right it stands, but the right half is full of geysers, one of which "
    "erupts at a time; being hit costs {cost} points. "
)

CASES: tuple[Case, ...] = (
    Case(
        "geyser_deterministic",
        find_world("GeyserRunner, deterministic"),
        _GEYSER_TEXT.format(cost=2)
        + "The eruptions follow a fixed pattern: the best player runs right and moves aside just in time.",
        _OPTIMUM,
        change_goals=True,
        episodes=5,
    ),
    Case(
        "geyser_low_cost",
        find_world("GeyserRunner, stochastic, hit cost 1"),
        _GEYSER_TEXT.format(cost=1)
        + "The eruptions are random and hits are cheap: the best player runs to the far right and stays.",
        _OPTIMUM,
        change_goals=True,
        episodes=5,
    ),
    Case(
        "geyser_high_cost",
        find_world("GeyserRunner, stochastic, hit cost 5"),
        _GEYSER_TEXT.format(cost=5)
        + "The eruptions are random and hits are expensive: the best player sits on the last safe column.",
        _OPTIMUM,
        episodes=5,
    ),
    Case(
        "maneuverer",
        find_world("Maneuverer"),
        "A player walks around walls to a target; each time it arrives, new walls and a new target are drawn "
        "at random, so that almost every layout is new. One point for each target.",
        "shortest paths",
        exact=False,
        change_goals=True,
    ),
    Case(
        "flier_catcher",
        find_world("FlierCatcher"),
        "Fliers enter from the right at random rows and move one column per step; the player moves up and down in "
        "the first column and earns a point for each flier it catches.",
        "dynamic programming over the visible fliers, strong but not proven optimal",
        exact=False,
        change_goals=True,
    ),
    Case(
        "frozen_lake",
        find_world("FrozenLake 4x4"),
        "Gymnasium's slippery lake: the agent is given neither the reward nor the rules of termination and "
        "learns both. One point for the goal; holes end the episode.",
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
        ValueError: there is none; the message lists the known names.
    """
    return find("case", key, {case.key: case for case in CASES})


def goals_of(case: Case) -> list[str]:
    """Names of the case's goals, "default" first."""
    game = case.game
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
    """Plays evaluation episodes of a case and scores them for the given goals; see ``evaluate_game``."""
    game = case.game
    if game is None:
        return evaluate_env(case.make_env, policy, episodes=episodes, seed=seed, repeatable=repeatable)
    functions = {"default": game.reward, **game.reward_functions}
    chosen = {name: functions[name] for name in goals}
    return evaluate_game(game, policy, episodes=episodes, seed=seed, goals=chosen, repeatable=repeatable, report=report)
