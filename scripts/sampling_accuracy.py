"""Measures how accurately models sample transition probabilities (the paper's section 3.3), beside the paper's figures.

python scripts/sampling_accuracy.py                         # quick: 3 data sets a trial, without the largest trial
python scripts/sampling_accuracy.py --full                  # 20 data sets a trial, 60 of the tiniest, 5 of the largest
python scripts/sampling_accuracy.py --trials 2a --fit.targets online

"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import tyro
from rich.console import Console

from harness import check_run, open_folder, run_all
from studies.sampling_accuracy.experiment import FIRST_SCORED_SEED, Outcome, Part, Settings, Task, collect, plan, run_task
from studies.sampling_accuracy.page import write_page
from studies.sampling_accuracy.results import (
    Points,
    first_points,
    load_points,
    load_scores,
    load_settings,
    save_points,
    save_scores,
    save_settings,
)
from studies.sampling_accuracy.samplers import FitOptions
from studies.sampling_accuracy.scores import Score
from studies.sampling_accuracy.trials import TRIALS

QUICK_TRIALS = tuple(trial.name for trial in TRIALS if trial.options.d <= 8)


@dataclass(frozen=True)
class Args:
    """Measure how accurately models sample transition probabilities."""

    full: bool = False
    """All trials with 20 data sets each, 60 of the tiniest, 5 of the largest (about an hour)."""
    trials: tuple[str, ...] | None = None
    """Which of 1a, 1b, 2a, 2b, 2c, 3; by default all but 3, with --full all."""
    parts: tuple[Part, ...] | None = None
    """Every sampler in every trial; the combined sampler with one thing changed at a time; growing numbers of variables.
    By default the first, with --full all."""
    seeds: int | None = None
    """Data sets for each trial, at most 20 (60 of the tiniest, 5 of the largest); by default 3, with --full all."""
    first_seed: int = FIRST_SCORED_SEED
    """Number of the first data set; those below 1000 are for choosing settings."""
    n_draws: int = 1000
    """Draws for each input."""
    relates: Literal["previous", "input"] = "previous"
    """What a variable copies: the output variable set before it, or the same variable of the input."""
    shuffle: Literal["output", "input"] = "output"
    """Whether the order of variables is drawn anew for every output or once for every input."""
    multiplier: float = 1.0
    """The paper's b: share of the d^2 inputs that is used."""
    fit: FitOptions = field(default_factory=FitOptions)
    """How the paper's networks are fitted."""
    output: Path = Path("results/sampling_accuracy")
    """Folder for the page and results.csv; results of an earlier run there are moved to a folder of their own inside it."""
    resume: bool = False
    """Keep the data sets that the folder already has; they must have been measured with the same options."""
    report_only: bool = False
    """Only write the page again, from what an earlier run left in the folder."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def settings_of(args: Args) -> Settings:
    """The settings that the options stand for."""
    trials = args.trials if args.trials is not None else tuple(t.name for t in TRIALS) if args.full else QUICK_TRIALS
    seeds = args.seeds if args.seeds is not None or args.full else 3
    parts: tuple[Part, ...] = args.parts if args.parts is not None else get_args(Part) if args.full else ("samplers",)
    return Settings(trials, seeds, args.first_seed, args.n_draws, args.fit, args.relates, args.shuffle, args.multiplier, parts)


def prepare(args: Args, settings: Settings, console: Console) -> Settings:
    """Makes the folder ready for a run, or for what is left of one; returns the settings that its figures have.

    Raises:
        ValueError: there is nothing to go on with, or it was measured with other options.
    """
    check_run(args.output, args.workers)
    kept = args.output / "settings.json"
    if args.report_only:
        return load_settings(kept)
    args.output.mkdir(parents=True, exist_ok=True)
    if args.resume and kept.exists():
        if load_settings(kept).measured() != settings.measured():
            raise ValueError(f"{args.output} was measured with other options ({kept}); give those, or another --output.")
    else:
        open_folder(args.output, console)
    save_settings(kept, settings)
    return settings


def _line(outcome: Outcome) -> str:
    return f"{outcome.task.part}, {outcome.task.trial}, data set {outcome.task.seed}"


def measure(args: Args, tasks: list[Task], console: Console) -> tuple[dict[Part, list[Score]], Points]:
    """Does the tasks that are not done, saving after each; returns all scores in the folder, by part, and the points."""
    tables = {part: args.output / f"{'results' if part == 'samplers' else part}.csv" for part in get_args(Part)}
    kept = {part: load_scores(path) for part, path in tables.items()}
    drawn = load_points(args.output / "points.npz")
    done = {(part, score.trial, score.seed) for part, scores in kept.items() for score in scores}
    todo = [task for task in tasks if (task.part, task.trial, task.seed) not in done]
    outcomes: list[Outcome] = []
    for outcome in run_all(run_task, todo, workers=args.workers, console=console, name=_line):
        outcomes.append(outcome)
        part = outcome.task.part
        save_scores(tables[part], [*kept[part], *collect(outcomes, part)])
        if part == "samplers":
            save_points(args.output / "points.npz", {**first_points(outcomes), **drawn})
    scores = {part: [*kept[part], *collect(outcomes, part)] for part in kept}
    return scores, {**first_points(outcomes), **drawn}


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        settings = prepare(args, settings_of(args), console)
        scores, points = measure(args, [] if args.report_only else plan(settings), console)
        if not any(scores.values()):
            raise ValueError(f"There are no results in {args.output}: measure first.")
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    command = shlex.join(["python", "scripts/sampling_accuracy.py", *(sys.argv[1:] if argv is None else argv)])
    write_page(args.output / "report.html", scores, points, settings, command)
    console.print(f"Wrote report.html and the figures behind it to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
