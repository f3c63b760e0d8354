"""Learns each game by random play, forecasts 1 ... n steps with both methods, and compares with the game itself."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import mbagent
from harness import Result, Row, check_at_least, check_known
from mbagent.models.neural.forecasts import DirectForecastModel, iterate, longest_string, random_strings
from mbagent.models.registry import build_direct
from mbagent.models.simulator import SimulatorModel
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.types import Actions, Keys, States
from mbagent_envs.random_keys import derive
from studies.forecasting import measures as m
from worlds.registry import World, find_world

Method = Literal["iterated", "direct", "true again"]
"""The iterated one-step model, models of n steps, and a second set of samples from the game (error by chance alone)."""

NAN = float("nan")

MOST_LISTED = 300
"""Largest number of states for which joint distributions are compared exactly."""


CASES = tuple(map(find_world, ("GeyserRunner, stochastic", "GeyserRunner, deterministic", "Maneuverer", "FlierCatcher")))
"""The games."""


@dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        cases: names of the games.
        steps: numbers of steps n, ascending from 1.
        timesteps: steps of random play to learn from.
        seeds: number of repetitions.
        first_seed: seed of the first.
        n_starts: start states of forecasts, from random play that was not used for learning.
        n_draws: samples for each.
        episodes: episodes played by flat Monte Carlo with each kind of forecast; 0 for none.

    Raises:
        ValueError: a setting is out of range.
    """

    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    steps: tuple[int, ...] = tuple(range(1, 16))
    timesteps: int = 20_000
    seeds: int = 3
    first_seed: int = 1000
    n_starts: int = 200
    n_draws: int = 100
    episodes: int = 0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        names = [case.name for case in CASES]
        check_known("game", self.cases, names)
        if not self.cases:
            raise ValueError(f"There is nothing to measure: name at least one game of {', '.join(map(repr, names))}.")
        for case in (case for case in CASES if case.name in self.cases):
            n_actions = ActionEnumeration(case.make().action_space).n
            if self.steps and max(self.steps) > longest_string(n_actions):
                raise ValueError(
                    f"{case.name} has {n_actions} actions: forecasts reach at most {longest_string(n_actions)} steps ahead, "
                    f"got {max(self.steps)}."
                )
        if not self.steps or min(self.steps) < 1:
            raise ValueError(f"Forecasts reach n = 1, 2, ... steps ahead, got {list(self.steps)}.")
        check_at_least(self, timesteps=100, seeds=1, n_starts=1, n_draws=2, episodes=0, first_seed=0)


@dataclass(frozen=True)
class Score:
    """A method's error at n steps on one game with one seed.

    Attributes:
        case, seed, method, n: identification.
        joint: exact total variation of the joint distribution; NaN if there are too many states.
        inexact: share of samples that differ from the only possible outcome; NaN if too few cases have only one.
        marginal: total variation of single factors, from samples.
        fit_seconds: wall time of the model's fit.
    """

    case: str
    seed: int
    method: Method
    n: int
    joint: float
    inexact: float
    marginal: float
    fit_seconds: float = NAN


@dataclass(frozen=True)
class Cell:
    """One game with one seed."""

    case: World
    seed: int
    settings: Settings


def cells(settings: Settings) -> list[Cell]:
    """All cells; those on planes come first, since they take longest."""
    chosen = [case for case in reversed(CASES) if case.name in settings.cases]
    return [Cell(case, settings.first_seed + i, settings) for case in chosen for i in range(settings.seeds)]


def run_cell(cell: Cell) -> Result[Cell]:
    """Learns, forecasts, compares. Tables: "results", see ``Score``; "returns", mean returns with each kind of forecast."""
    torch.set_num_threads(1)
    env, settings = cell.case.make(), cell.settings
    space, n_actions = FactoredSpace(env.observation_space), ActionEnumeration(env.action_space).n
    longer = tuple(n for n in settings.steps if n > 1)
    agent = mbagent.ModelLearningAgent("FlatMonteCarloPolicy", env, model="tabular", seed=cell.seed)
    agent.learn(settings.timesteps)
    model = build_direct(space, n_actions, agent.learning_rate, longer)  # type: ignore[arg-type]  # a number here
    log = model.fit(agent.transitions, seed=cell.seed).log
    seconds = {n: log.get(f"seconds_{n}_steps", NAN) for n in (1, *longer)}
    scores = _compare(cell, SimulatorModel(env.unwrapped.game), model, seconds)  # type: ignore[attr-defined]
    played = _play(cell, model) if settings.episodes else []
    return Result(
        cell, {"results": [asdict(score) for score in scores], "returns": played}, f"{cell.case.name}, seed {cell.seed}"
    )


def _compare(cell: Cell, true: SimulatorModel, model: DirectForecastModel, seconds: dict[int, float]) -> list[Score]:
    settings, seed = cell.settings, cell.seed
    starts = _typical(true, settings.n_starts, seed)
    strings = random_strings(derive(seed, 3, np.arange(len(starts))), max(settings.steps), true.n_actions)
    listed = m.listed_states(true, starts, MOST_LISTED)
    joints = _joints(true, model, listed, settings.steps, seed) if listed is not None else {}
    scores = []
    for n in settings.steps:
        ways = {
            "true": lambda s, a, k: iterate(true, s, a, k),
            "iterated": lambda s, a, k: iterate(model.one_step, s, a, k),
            "direct": model.forecast,
            "true again": lambda s, a, k: iterate(true, s, a, k),
        }
        drawn = {
            name: _draw(way, starts, strings[:, :n], settings.n_draws, derive(seed, n, i))
            for i, (name, way) in enumerate(ways.items())
        }
        truth = drawn.pop("true")
        for name, draws in drawn.items():
            method: Method = name  # type: ignore[assignment]
            joint = joints.get((method, n), NAN)
            inexact, marginal = m.inexact_share(draws, truth), m.marginal_variation(draws, truth, true.cardinalities)
            took = {"iterated": seconds[1], "direct": seconds.get(n, NAN)}.get(method, NAN)
            scores.append(Score(cell.case.name, seed, method, n, joint, inexact, marginal, took))
    return scores


def _typical(true: SimulatorModel, n: int, seed: int) -> States:
    """States int64 [n, F] after 0 ... 49 steps of random play."""
    keys = derive(seed, 1, np.arange(n))
    states, strings = true.start_states(n, seed=seed), random_strings(keys, 50, true.n_actions)
    for step in range(49):
        going = np.arange(n) % 50 > step
        states[going], _ = true.sample(states[going], strings[going, step], derive(keys[going], step + 1000))
    return states


def _draw(way: Any, starts: States, strings: Actions, n_draws: int, key: Keys) -> States:
    """Samples int64 [cases, n_draws, F]."""
    rows = np.repeat(np.arange(len(starts)), n_draws)
    states, _ = way(starts[rows], strings[rows], derive(key, np.arange(len(rows))))
    result: States = states.reshape(len(starts), n_draws, -1)
    return result


def _joints(
    true: SimulatorModel, model: DirectForecastModel, states: States, steps: tuple[int, ...], seed: int, n_strings: int = 8
) -> dict[tuple[Method, int], float]:
    """Exact total variation of joint distributions, over all states and some random action strings."""
    starts = np.repeat(np.arange(len(states)), n_strings)
    strings = random_strings(derive(seed, 2, np.arange(len(starts))), max(steps), true.n_actions)
    exact, learned = m.transition_matrices(true, states), m.transition_matrices(model.one_step, states)
    result: dict[tuple[Method, int], float] = {}
    for n in steps:
        truth, iterated = m.follow(exact, starts, strings[:, :n]), m.follow(learned, starts, strings[:, :n])
        direct = m.direct_distribution(model, states, starts, strings[:, :n]) if n in model.known else iterated
        result["iterated", n], result["direct", n] = m.joint_variation(iterated, truth), m.joint_variation(direct, truth)
        result["true again", n] = 0.0
    return result


def _play(cell: Cell, model: DirectForecastModel) -> list[Row]:
    """Flat Monte Carlo with each kind of forecast, on episodes with the same seeds."""
    settings, rows = cell.settings, []
    for forecasts in ("iterated", "direct"):
        env = make_vec_env(cell.case.make, n_envs=settings.episodes, seed=cell.seed)
        agent = mbagent.ModelLearningAgent(
            "FlatMonteCarloPolicy",
            env,
            model=model,
            horizon=max(settings.steps),
            policy_kwargs={"forecasts": forecasts},
            seed=cell.seed,
        )
        agent.set_parameters(agent.get_parameters())  # the model is fitted: no learning is needed
        value, _ = evaluate_policy(agent, env, n_eval_episodes=settings.episodes)
        rows.append({"case": cell.case.name, "seed": cell.seed, "forecasts": forecasts, "value": float(value)})  # type: ignore[arg-type]
    return rows
