"""Compares the model-learning agent with PPO, DQN and A2C; writes one HTML report and a table of all figures.

python scripts/compare_agents.py            # quick: two trainings of each agent
python scripts/compare_agents.py --full     # five trainings, and baselines also at ten times the steps

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Pictures are drawn without a window or sound, so that no display is needed.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from harness import Run, check_known, run_command
from studies.comparison.page import write_report
from studies.comparison.plan import BASELINES, FULL, QUICK, Settings, load
from studies.comparison.plan import run as run_comparison
from studies.comparison.records import Record
from studies.comparison.summary import save_csv, summarise
from worlds.games import CASES, find_case


@dataclass(frozen=True)
class Args:
    """Compare the model-learning agent with PPO, DQN and A2C."""

    full: bool = False
    """Five trainings, more episodes, and the baselines also at ten times the steps (hours, not minutes)."""
    output: Path = Path("results/compare")
    """Folder for report.html, results.csv and the records of all trainings."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""
    cases: tuple[str, ...] = tuple(case.key for case in CASES)
    """Which environments."""
    steps: int | None = None
    """Environment steps for learning; by default 50,000."""
    seeds: int | None = None
    """Independent trainings of each agent; by default 2, with --full 5."""
    episodes: int | None = None
    """Episodes after each training, more in environments with few states; by default 10, with --full 20."""
    goal_seeds: int | None = None
    """Trainings that are evaluated on new goals and with the learned reward; by default 1, with --full 5."""
    goal_episodes: int | None = None
    """Episodes for each new goal; by default 4, with --full 20."""
    baselines: tuple[str, ...] = BASELINES
    """Agents to compare with; none after --baselines without values."""
    baseline_multiples: tuple[int, ...] | None = None
    """The baselines are trained for these multiples of the steps; by default 1, with --full 1 and 10."""
    curves: bool = True
    """Whether the agent is also trained for fewer steps, for its learning curve."""
    resume: bool = False
    """Continue an interrupted run with the same settings instead of starting again."""
    report_only: bool = False
    """Only rewrite the report, from the records and settings of the last run in the folder."""


_OVERRIDES = ("steps", "seeds", "episodes", "goal_seeds", "goal_episodes", "baselines", "baseline_multiples")


def settings_of(args: Args) -> Settings:
    """The settings of the comparison given by the options."""
    chosen = FULL if args.full else QUICK
    given: dict[str, Any] = {name: getattr(args, name) for name in _OVERRIDES}
    chosen = replace(chosen, **{name: value for name, value in given.items() if value is not None})
    check_known("baseline", args.baselines, BASELINES)
    cases = tuple(find_case(key).key for key in args.cases)
    curve_steps = tuple(s for s in chosen.curve_steps if s < chosen.steps and args.curves)
    return replace(chosen, cases=cases, curve_steps=curve_steps)


Records: TypeAlias = tuple[Settings, list[Record], float]
"""Settings of a comparison, its records, and its duration in minutes."""


def prepare(args: Args, run: Run) -> Records:
    """The records of a new comparison, or of the last one in the folder.

    Raises:
        ValueError: an option is out of range, or there are no records.
        CellsFailedError: jobs failed.
    """
    settings, start = settings_of(args), time.perf_counter()
    if args.report_only:
        return *load(args.output), 0.0
    records = run_comparison(settings, args.output, workers=args.workers, console=run.console, resume=args.resume)
    return settings, records, (time.perf_counter() - start) / 60


def execute(args: Args, found: Records, run: Run) -> None:
    """Summarises the records and writes the report."""
    settings, records, minutes = found
    run.say("Writing the report ...")
    results = summarise(records, settings)
    save_csv(args.output / "results.csv", records, results)
    write_report(args.output / "report.html", results, settings, command=run.command, minutes=minutes)
    run.say(f"Wrote {args.output / 'report.html'} and {args.output / 'results.csv'}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("compare_agents", __doc__, Args, prepare, execute, argv, opens=False)


if __name__ == "__main__":
    sys.exit(main())
