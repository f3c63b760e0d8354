"""The jobs of a comparison; each runs in a separate process."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from mbagent import ModelLearningAgent
from mbagent.evaluation.baselines import BaselineName, as_policy, best_mode, train_baseline
from mbagent.evaluation.evaluate import Policy, milliseconds_per_decision, random_policy
from mbagent.models import SimulatorModel
from studies.comparison.records import (
    AGENT,
    LEARNED_REWARD,
    RANDOM,
    REFERENCE,
    TRUE_MODEL,
    Record,
    hash_weights,
)
from worlds.games import Case, find_case, goals_of, play
from worlds.known_rules import scale_of

Report = Callable[[float], None]


@dataclass(frozen=True)
class Job:
    """One job.

    Attributes:
        agent: name of the agent (one of the names in ``records``, or a baseline's).
        case: key of the case.
        seed: seed of training and of the evaluation episodes.
        steps: environment steps for learning.
        episodes: evaluation episodes.
        goals: names of the goals to score.
        goal_episodes: evaluation episodes for each goal other than the default.
        learn_reward: whether the agent is also scored with a reward learned from the observed rewards.
        curve: whether this is only a point of the agent's learning curve.
    """

    agent: str
    case: str
    seed: int
    steps: int
    episodes: int
    goals: tuple[str, ...] = ("default",)
    goal_episodes: int = 0
    learn_reward: bool = False
    curve: bool = False

    @property
    def name(self) -> str:
        """Name for progress and files."""
        steps = f", {self.steps:,} steps" if self.steps else ""
        return f"{self.case}: {self.agent}, seed {self.seed}{steps}"

    @property
    def file_name(self) -> str:
        """File name of its records."""
        words = f"{self.case} {self.agent} {self.seed} {self.steps} {'curve' if self.curve else ''}"
        return "_".join("".join(c if c.isalnum() else " " for c in words).split()).lower() + ".json"


class RewardOnly(gym.Env[Any, Any]):
    """An environment without its reward function: rewards are only observed, as in most environments.

    Deliberately not a ``gym.Wrapper``, through which the inner environment's ``reward_fn`` would still be found.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self.spec = env.spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        return self._env.step(action)


class _ReportSteps(BaseCallback):
    """Reports the progress of exploration."""

    def __init__(self, total: int, report: Report | None) -> None:
        super().__init__()
        self._total = max(total, 1)
        self._tell = report

    def _on_step(self) -> bool:
        if self._tell is not None and self.n_calls % 64 == 0:
            self._tell(min(1.0, self.num_timesteps / self._total))
        return True


def run_job(job: Job, report: Report | None = None) -> list[Record]:
    """Runs a job.

    Args:
        job: the job.
        report: called regularly with the share done, 0 ... 1.

    Returns:
        One record for each goal.
    """
    torch.set_num_threads(1)
    case = find_case(job.case)
    if job.agent == RANDOM:
        return _play_fixed(job, case, random_policy(_n_actions(case), seed=job.seed))
    if job.agent == REFERENCE:
        return [_measure_scale(job, case, goal) for goal in job.goals]
    if job.agent == TRUE_MODEL:
        return _plan_on_true_model(job, case, report)
    if job.agent in (AGENT, LEARNED_REWARD):
        return _learn_and_plan(job, case, report)
    return _train_baseline(job, case, report)


def _n_actions(case: Case) -> int:
    return int(cast("gym.spaces.Discrete[Any]", case.make_env().action_space).n)


def _record(job: Job, goal: str, returns: NDArray[np.float64], **more: Any) -> Record:
    steps = more.pop("steps", job.steps)
    scores = tuple(returns.tolist())
    return Record(job.case, job.agent, goal, job.seed, steps, scores, curve_point=job.curve, **more)


def _play_fixed(job: Job, case: Case, policy: Policy) -> list[Record]:
    """Scores a policy that ignores the goal for all goals at once."""
    played = play(case, policy, episodes=job.episodes, seed=job.seed, goals=job.goals)
    return [_record(job, goal, returns) for goal, returns in played.returns.items()]


def _measure_scale(job: Job, case: Case, goal: str) -> Record:
    """Mean returns of the reference and of random play."""
    scale = scale_of(case.world, goal, job.episodes)
    return _record(job, goal, np.array([scale.reference]), extra={"random": scale.random})


def _typical_observations(case: Case, n: int = 24) -> NDArray[Any]:
    """Observations [n, ...] from random play, for the timing of decisions."""
    env = case.make_env()
    env.action_space.seed(0)
    rows = [env.reset(seed=0)[0]]
    while len(rows) < n * 4:
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        rows.append(env.reset()[0] if terminated or truncated else obs)
    return np.stack(rows[::4])


def _plan_on_true_model(job: Job, case: Case, report: Report | None) -> list[Record]:
    game = case.game
    if game is None:
        return []
    agent = ModelLearningAgent("MctsPolicy", case.make_env(), model=SimulatorModel(game), seed=job.seed)
    if not agent.policy.fitted:
        agent.learn(total_timesteps=1000)  # nothing is fitted: this only records start states for planning
    return _score_goals(job, case, agent, 0.0, report)


def _learn_and_plan(job: Job, case: Case, report: Report | None) -> list[Record]:
    env = case.make_env() if case.reward_given else RewardOnly(case.make_env())
    start = time.perf_counter()
    with _reward_warnings_ignored():
        agent = ModelLearningAgent("MctsPolicy", env, seed=job.seed)
        exploring = None if report is None else _part(report, 0, 3)
        agent.learn(total_timesteps=job.steps, callback=_ReportSteps(job.steps, exploring))
    seconds = time.perf_counter() - start
    planning = None if report is None else _part(report, 1, 2)
    records = _score_goals(job, case, agent, seconds, planning)
    if job.learn_reward:
        records += _learn_reward_too(job, case, agent, seconds)
    return records


def _learn_reward_too(job: Job, case: Case, agent: ModelLearningAgent, seconds: float) -> list[Record]:
    """Scores the same agent again with a goal learned only from the rewards observed during exploration.

    Neither exploration nor the transition model depends on rewards, so learning again without the reward function
    would give the same model, byte for byte.
    """
    start = time.perf_counter()
    with _reward_warnings_ignored():
        agent.set_env(RewardOnly(case.make_env()))
        agent.set_reward(None)
    seconds += time.perf_counter() - start
    default = replace(job, agent=LEARNED_REWARD, goals=("default",))
    return _score_goals(default, case, agent, seconds, None)


@contextmanager
def _reward_warnings_ignored() -> Iterator[None]:
    """Suppresses the warning that the reward has to be learned, which is intended here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*reward.*", category=UserWarning)
        yield


def _score_goals(job: Job, case: Case, agent: ModelLearningAgent, seconds: float, report: Report | None) -> list[Record]:
    """Gives the agent one goal after another and plays episodes for each."""
    game = case.game
    policy = as_policy(agent)
    learned = not isinstance(agent.model, SimulatorModel)
    records = []
    decision_ms = float("nan")
    for number, goal in enumerate(job.goals):
        before = hash_weights(agent.model.state_dict()) if learned else ""
        if goal != "default":
            assert game is not None
            agent.set_reward(game.reward_functions[goal])
        elif not job.curve:
            decision_ms = milliseconds_per_decision(policy, _typical_observations(case))
        played = play(
            case,
            policy,
            episodes=job.episodes if goal == "default" else job.goal_episodes,
            seed=job.seed,
            goals=(goal,),
            repeatable=True,
            report=None if report is None else _part(report, number, len(job.goals)),
        )
        after = hash_weights(agent.model.state_dict()) if learned else ""
        records.append(
            _record(
                job,
                goal,
                played.returns[goal],
                steps=agent.num_timesteps if learned else 0,
                learn_seconds=seconds,
                decision_ms=decision_ms if goal == "default" else float("nan"),
                weights_before=before,
                weights_after=after,
            )
        )
    return records


def _part(report: Report, number: int, total: int) -> Report:
    """Report function for part ``number`` of ``total`` equal parts."""
    return lambda share: report((number + share) / total)


def _train_baseline(job: Job, case: Case, report: Report | None) -> list[Record]:
    name = cast("BaselineName", job.agent)
    evaluating = 0.0

    def evaluate(policy: Policy, repeatable: bool) -> float:
        nonlocal evaluating
        begin = time.perf_counter()
        # Separate from the evaluation episodes: these choose between the algorithm's two modes.
        played = play(case, policy, episodes=50, seed=900_000 + job.seed, repeatable=repeatable)
        evaluating += time.perf_counter() - begin
        return float(played.default.mean())

    start = time.perf_counter()
    algorithm, curve = train_baseline(name, case.make_env, steps=job.steps, seed=job.seed, evaluate=evaluate, report=report)
    seconds = time.perf_counter() - start - evaluating
    deterministic, _ = best_mode(algorithm, evaluate)
    policy = as_policy(algorithm, deterministic=deterministic)
    played = play(case, policy, episodes=job.episodes, seed=job.seed, repeatable=deterministic)
    return [
        _record(
            job,
            "default",
            played.default,
            steps=algorithm.num_timesteps,
            learn_seconds=seconds,
            decision_ms=milliseconds_per_decision(policy, _typical_observations(case)),
            curve=tuple(curve),
            extra={"deterministic": float(deterministic)},
        )
    ]


def all_goals(case: Case) -> tuple[str, ...]:
    """The goals on which a model-based agent is scored for a case."""
    return tuple(goals_of(case)) if case.change_goals else ("default",)
