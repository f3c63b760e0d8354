"""The plan of a comparison: agents, cases, numbers of steps and episodes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from harness import Recorder, check_at_least, run_recorded
from mbagent import files
from studies.comparison.jobs import Job, all_goals, run_job
from studies.comparison.records import (
    AGENT,
    LEARNED_REWARD,
    RANDOM,
    REFERENCE,
    TRUE_MODEL,
    Record,
    read_records,
    write_records,
)
from worlds.games import CASES, Case, find_case

BASELINES = ("PPO", "DQN", "A2C")
_COST = {"DQN": 4.0, "PPO": 2.0, "A2C": 1.5, AGENT: 6.0, LEARNED_REWARD: 3.0, TRUE_MODEL: 5.0, REFERENCE: 4.5}


@dataclass(frozen=True)
class Settings:
    """Size of a comparison.

    Attributes:
        steps: environment steps for learning (cases may use fewer).
        seeds: independent trainings of each learning agent.
        episodes: evaluation episodes for each training, multiplied by a factor of the case.
        goal_episodes: the same for each new goal.
        baseline_multiples: the baselines are trained for these multiples of the steps.
        curve_steps: further agents are trained for these numbers of steps, as points of the learning curve.
        curve_seeds: trainings for each of these points.
        goal_seeds: trainings that are evaluated on new goals and with the learned reward.
        scale_episodes: episodes for measuring random play and references.
        baselines: baselines to compare with.
        cases: keys of the cases.
    """

    steps: int = 50_000
    seeds: int = 2
    episodes: int = 10
    goal_episodes: int = 4
    baseline_multiples: tuple[int, ...] = (1,)
    curve_steps: tuple[int, ...] = (1_000, 10_000)
    curve_seeds: int = 1
    goal_seeds: int = 1
    scale_episodes: int = 500
    baselines: tuple[str, ...] = BASELINES
    cases: tuple[str, ...] = tuple(case.key for case in CASES)

    def __post_init__(self) -> None:
        """Checks the ranges.

        Raises:
            ValueError: a setting is out of range.
        """
        check_at_least(self, steps=1, seeds=1, episodes=1, goal_episodes=1, scale_episodes=1)
        if self.goal_seeds < 0 or any(multiple < 1 for multiple in self.baseline_multiples):
            raise ValueError("goal_seeds must not be negative, and baseline_multiples must be at least 1.")
        if not self.cases:
            raise ValueError(f"There is no case to compare on; choose from {', '.join(case.key for case in CASES)}.")


QUICK = Settings()
FULL = Settings(
    scale_episodes=2000,
    seeds=5,
    episodes=20,
    goal_episodes=20,
    baseline_multiples=(1, 10),
    curve_steps=(1_000, 2_000, 5_000, 10_000, 20_000),
    curve_seeds=5,
    goal_seeds=5,
)


def plan_jobs(settings: Settings) -> list[Job]:
    """All jobs, longest first."""
    jobs: list[Job] = []
    for case in map(find_case, settings.cases):
        steps = case.steps(settings.steps)
        jobs.append(Job(REFERENCE, case.key, 0, 0, settings.scale_episodes, all_goals(case)))
        for seed in range(settings.seeds):
            jobs += _jobs_of_seed(settings, case, seed, steps)
    return sorted(jobs, key=lambda job: -_COST.get(job.agent, 0.0) * max(job.steps, settings.steps))


def _jobs_of_seed(settings: Settings, case: Case, seed: int, steps: int) -> list[Job]:
    episodes = case.episodes * settings.episodes
    agent = AGENT if case.reward_given else LEARNED_REWARD
    planned = Job(agent, case.key, seed, steps, episodes)
    if seed < settings.goal_seeds:
        fewer = case.episodes * settings.goal_episodes
        planned = replace(planned, goals=all_goals(case), goal_episodes=fewer, learn_reward=case.reward_given)
    jobs = [planned, Job(RANDOM, case.key, seed, 0, episodes)]
    if case.reward_given:
        jobs.append(replace(planned, agent=TRUE_MODEL, steps=0, learn_reward=False))
    jobs += [
        Job(name, case.key, seed, steps * multiple, episodes)
        for name in settings.baselines
        for multiple in settings.baseline_multiples
    ]
    if seed < settings.curve_seeds:
        jobs += [
            Job(agent, case.key, seed, fewer_steps, max(1, episodes // 2), curve=True)
            for fewer_steps in settings.curve_steps
            if fewer_steps < steps
        ]
    return jobs


def run(settings: Settings, folder: Path, *, workers: int, console: Console, resume: bool = False) -> list[Record]:
    """Runs a comparison, saving each job's records in ``folder / "records"`` as soon as it is done.

    Args:
        settings: settings of the comparison.
        folder: folder of the results.
        workers: number of processes.
        console: console for progress.
        resume: continue an interrupted run instead of starting again.

    Raises:
        ValueError: ``resume`` with settings that differ from those of the interrupted run, or no workers.
        CellsFailedError: see ``run_recorded``.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1 process, got {workers}.")
    kept, noted = folder / "records", folder / "records" / "settings.json"
    text = json.dumps(asdict(settings), indent=1)
    if resume and noted.exists() and noted.read_text(encoding="utf-8") != text:
        raise ValueError(f"The run kept in {kept} had other settings; give the same ones, or leave out --resume.")
    if not resume:  # delete only files of an earlier run
        for stale in [*kept.glob("*.json"), *kept.glob("*.progress"), *kept.glob("errors.log")]:
            stale.unlink()
    kept.mkdir(parents=True, exist_ok=True)
    files.write(noted, text)
    recorder = Recorder(run_job, write_records, read_records, _mean)
    return run_recorded(recorder, plan_jobs(settings), kept, workers=workers, console=console)


def _mean(records: Sequence[Record]) -> str:
    """Summary of a finished job for progress messages."""
    means = [record.mean for record in records if record.goal == "default"]
    return f", mean return {means[0]:.2f}" if means else ""


def load(folder: Path) -> tuple[Settings, list[Record]]:
    """The settings and records of an earlier ``run``.

    Raises:
        ValueError: there are none.
    """
    noted = folder / "records" / "settings.json"
    files = [file for file in sorted((folder / "records").glob("*.json")) if file.name != "settings.json"]
    if not files or not noted.exists():
        raise ValueError(f"There are no records in {folder / 'records'}; run the comparison first.")
    given: dict[str, Any] = json.loads(noted.read_text(encoding="utf-8"))
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    settings = Settings(**given)
    return settings, [record for file in files for record in read_records(file)]
