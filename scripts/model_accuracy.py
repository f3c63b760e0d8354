"""Measures how accurately models predict next states on unseen layouts.

python scripts/model_accuracy.py                          # quick: one seed, 2,000 and 5,000 steps, 20,000 tests
python scripts/model_accuracy.py --full                   # 5 seeds, 2,000, 5,000 and 20,000 steps, 100,000 tests
python scripts/model_accuracy.py --models graphs --cases "Maneuverer, flat" --studies
python scripts/model_accuracy.py --cases --studies changes cost

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from harness import Row, Run, joined, run_cells, run_command
from studies.model_accuracy.experiment import CASES, Cell, Settings, cells, means, run_cell
from studies.model_accuracy.page import averaged, shown, write_page
from studies.model_accuracy.studies import STUDIES, Question, answer, questions

Plan: TypeAlias = tuple[list[Cell], list[Question]]


@dataclass(frozen=True)
class Args:
    """Measure how accurately models predict."""

    full: bool = False
    """5 seeds, up to 20,000 steps, 100,000 tests."""
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    """Which worlds."""
    models: tuple[str, ...] = ("graphs", "networks")
    """Models: any by name, and bayesnet, a dynamic Bayesian network by pyAgrum (pip install "mbagent[yardsticks]")."""
    steps: tuple[int, ...] | None = None
    """Steps of random play to learn from; by default 2,000 and 5,000, with --full 20,000 too."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = Settings.first_seed
    """Seed of the first repetition."""
    n_tests: int | None = None
    """Test transitions; by default 20,000, with --full 100,000."""
    output: Path = Path("results/model_accuracy")
    """Folder for results.csv; results of an earlier run are moved to a subfolder."""
    studies: tuple[str, ...] = tuple(name for name in STUDIES if name != "minatar")
    """Further studies: changes of rules, false alarms of such changes, transfer between sizes, cost, parents found, error
    estimates (trust), planning (agents); minatar needs pip install "mbagent[minatar]". None after --studies without values."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def plan(args: Args, run: Run | None = None) -> Plan:
    """The settings of the measurement, and the further studies.

    Raises:
        ValueError: an option is out of range.
    """
    settings = Settings(
        cases=args.cases,
        models=args.models,
        steps=args.steps if args.steps is not None else (2000, 5000, 20_000) if args.full else (2000, 5000),
        seeds=args.seeds if args.seeds is not None else 5 if args.full else 1,
        first_seed=args.first_seed,
        n_tests=args.n_tests if args.n_tests is not None else 100_000 if args.full else 20_000,
    )
    seeds = range(args.first_seed, args.first_seed + settings.seeds)
    return cells(settings) if args.cases else [], questions(args.studies, seeds, args.full)


def show(scores: list[Row], run: Run) -> None:
    """Prints means over seeds."""
    names = ("world", "model", "steps", "likeliest", "sampled", "joint TV", "log-likelihood", "fit, s", "draw, µs")
    lines = []
    for (case, model, steps), m in sorted(means(scores).items()):
        figures = [f"{100 * m[name]:.2f}%" for name in ("likeliest", "sampled")]
        figures += [
            f"{m['joint']:.4f}",
            f"{m['log_likelihood']:.3f}",
            f"{m['fit_seconds']:.1f}",
            f"{m['sample_microseconds']:.1f}",
        ]
        lines.append([case, model, f"{steps:,}", *("–" if "nan" in figure else figure for figure in figures)])
    run.show("Exact next states on new random play", names, lines, width=120)


def execute(args: Args, plan: Plan, run: Run) -> None:
    """Measures, runs the further studies, and writes the page."""
    todo, further = plan
    scores = [row for result in run_cells(run_cell, todo, run) for row in result.rows]
    if scores:
        show(scores, run)
    rows = joined(run_cells(answer, further, run))
    accuracy = [{"world": c, "model": m, "steps": n, **figures} for (c, m, n), figures in sorted(means(scores).items())]
    run.write_pictures(write_page(args.output / "report.html", rows, accuracy, run.command))
    for study, found in rows.items():
        lines = averaged(study, found)
        title = (STUDIES[study].__doc__ or "").splitlines()[0]
        run.show(title, lines[0], [[shown(value) for value in line.values()] for line in lines], width=120)
    run.say(f"Wrote report.html and the tables to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("model_accuracy", __doc__, Args, plan, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
