"""Measures how accurately models sample transition probabilities (the paper's section 3.3), compared with the paper's results.

python scripts/sampling_accuracy.py                         # quick: 3 data sets a trial, without the largest trial
python scripts/sampling_accuracy.py --full                  # 20 data sets a trial, 60 of the tiniest, 5 of the largest
python scripts/sampling_accuracy.py --trials 2a --fit.targets online

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from harness import Result, Run, Tables, joined, open_folder, run_cells, run_command
from studies.sampling_accuracy.experiment import FIRST_SCORED_SEED, TABLES, Cell, Part, Settings, cells, run_cell
from studies.sampling_accuracy.page import write_page
from studies.sampling_accuracy.results import (
    Points,
    first_points,
    load_points,
    load_scores,
    load_settings,
    save_points,
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
    """Trials among 1a, 1b, 2a, 2b, 2c, 3; by default all but 3, with --full all."""
    parts: tuple[Part, ...] | None = None
    """Every sampler in every trial; variants of the combined sampler, with one change each; growing numbers of variables.
    By default the first, with --full all."""
    seeds: int | None = None
    """Data sets for each trial, at most 20 (60 of the tiniest, 5 of the largest); by default 3, with --full all."""
    first_seed: int = FIRST_SCORED_SEED
    """Number of the first data set; those below 1000 are reserved for choosing settings."""
    n_draws: int = 1000
    """Samples per input."""
    relates: Literal["previous", "input"] = "previous"
    """Source from which a variable copies: the output variable set before it, or the same variable of the input."""
    shuffle: Literal["output", "input"] = "output"
    """Whether the order of variables is drawn for every output or once for every input."""
    multiplier: float = 1.0
    """The paper's b: share of the d^2 inputs that are used."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Options for fitting the paper's networks."""
    output: Path = Path("results/sampling_accuracy")
    """Folder for the page and results.csv; results of an earlier run there are moved to a folder of their own inside it."""
    resume: bool = False
    """Keep the results that are already in the folder; they must have been measured with the same options."""
    report_only: bool = False
    """Only rewrite the page, from the results of an earlier run in the folder."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def settings_of(args: Args) -> Settings:
    """The settings given by the options."""
    trials = args.trials if args.trials is not None else tuple(t.name for t in TRIALS) if args.full else QUICK_TRIALS
    seeds = args.seeds if args.seeds is not None or args.full else 3
    parts: tuple[Part, ...] = args.parts if args.parts is not None else get_args(Part) if args.full else ("samplers",)
    return Settings(trials, seeds, args.first_seed, args.n_draws, args.fit, args.relates, args.shuffle, args.multiplier, parts)


class Plan(NamedTuple):
    """The work to do, and the results of an earlier run.

    Attributes:
        settings: settings shared by all results.
        todo: cells that are still to be run.
        kept: rows of an earlier run.
        points: pairs (observed, inferred) of an earlier run.
    """

    settings: Settings
    todo: list[Cell]
    kept: Tables
    points: Points


def prepare(args: Args, run: Run) -> Plan:
    """Prepares the folder for a new or continued run.

    Raises:
        ValueError: there are no results to continue from, or they were measured with other options.
    """
    settings, noted = settings_of(args), args.output / "settings.json"
    if args.report_only:
        settings = load_settings(noted)
    else:
        args.output.mkdir(parents=True, exist_ok=True)
        if args.resume and noted.exists():
            if load_settings(noted).measured() != settings.measured():
                raise ValueError(f"{args.output} was measured with other options ({noted}); give those, or another --output.")
        else:
            open_folder(args.output, run.console)
        save_settings(noted, settings)
    kept = {part: load_scores(args.output / f"{TABLES[part]}.csv") for part in get_args(Part)}
    done = {(part, score.trial, score.seed) for part, scores in kept.items() for score in scores}
    if args.report_only and not done:
        raise ValueError(f"There are no results in {args.output}: measure first.")
    todo = [] if args.report_only else [cell for cell in cells(settings) if (cell.part, cell.trial, cell.seed) not in done]
    rows = {TABLES[part]: [asdict(score) for score in scores] for part, scores in kept.items()}
    return Plan(settings, todo, rows, load_points(args.output / "points.npz"))


def execute(args: Args, plan: Plan, run: Run) -> None:
    """Runs the remaining cells, saving after each, and writes the page."""

    def save(results: list[Result[Cell]]) -> None:
        if results[-1].cell.part == "samplers":
            save_points(args.output / "points.npz", {**first_points(results), **plan.points})

    results = run_cells(run_cell, plan.todo, run, kept=plan.kept, order=lambda cell: cell.place, each=save)
    tables = joined(sorted(results, key=lambda result: result.cell.place), plan.kept)
    scores = {part: [Score(**row) for row in tables[name]] for part, name in TABLES.items()}
    points = {**first_points(results), **plan.points}
    write_page(args.output / "report.html", scores, points, plan.settings, run.command)
    run.say(f"Wrote report.html and the figures behind it to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("sampling_accuracy", __doc__, Args, prepare, execute, argv, opens=False)


if __name__ == "__main__":
    sys.exit(main())
