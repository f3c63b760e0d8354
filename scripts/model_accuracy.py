"""Measures how exactly models predict next states from layouts that they have not seen.

python scripts/model_accuracy.py                          # quick: one seed, 2,000 and 5,000 steps, 20,000 tests
python scripts/model_accuracy.py --full                   # 5 seeds, 2,000, 5,000 and 20,000 steps, 100,000 tests
python scripts/model_accuracy.py --models graphs --cases "Maneuverer, flat"

"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import csv
import sys
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from mbagent.analysis.folders import replaced, set_aside
from mbagent.analysis.model_accuracy.experiment import CASES, Outcome, Score, Settings, means, plan, run_task
from mbagent.analysis.parallel import run_all


@dataclass(frozen=True)
class Args:
    """Measure how exactly models predict."""

    full: bool = False
    """5 seeds, up to 20,000 steps, 100,000 tests."""
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    """Which worlds."""
    models: tuple[str, ...] = ("graphs", "networks")
    """Which models."""
    steps: tuple[int, ...] | None = None
    """Steps of random play to learn from; by default 2,000 and 5,000, with --full 20,000 too."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = Settings.first_seed
    """Seed of the first."""
    n_tests: int | None = None
    """Transitions to test on; by default 20,000, with --full 100,000."""
    output: Path = Path("results/model_accuracy")
    """Folder for results.csv; results of an earlier run there are moved to a folder of their own inside it."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def settings_of(args: Args) -> Settings:
    """The settings that the options stand for."""
    if args.workers < 1:
        raise ValueError(f"--workers must be at least 1 process, got {args.workers}.")
    return Settings(
        cases=args.cases,
        models=args.models,
        steps=args.steps if args.steps is not None else (2000, 5000, 20_000) if args.full else (2000, 5000),
        seeds=args.seeds if args.seeds is not None else 5 if args.full else 1,
        first_seed=args.first_seed,
        n_tests=args.n_tests if args.n_tests is not None else 100_000 if args.full else 20_000,
    )


def save(path: Path, scores: list[Score]) -> None:
    """Writes a csv with a line for each score."""
    with replaced(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [column.name for column in fields(Score)])
        writer.writeheader()
        writer.writerows(asdict(score) for score in scores)


def show(scores: list[Score], console: Console) -> None:
    """Prints means over seeds."""
    names = ("world", "model", "steps", "likeliest", "sampled", "joint TV", "log-likelihood", "fit, s", "draw, µs")
    table = Table(*names, title="Exact next states on new random play")
    for (case, model, steps), m in sorted(means(scores).items()):
        figures = [f"{100 * m[name]:.2f}%" for name in ("likeliest", "sampled")]
        figures += [
            f"{m['joint']:.4f}",
            f"{m['log_likelihood']:.3f}",
            f"{m['fit_seconds']:.1f}",
            f"{m['sample_microseconds']:.1f}",
        ]
        table.add_row(case, model, f"{steps:,}", *("–" if "nan" in figure else figure for figure in figures))
    Console(width=max(console.width, 120)).print(table)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        tasks = plan(settings_of(args))
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    args.output.mkdir(parents=True, exist_ok=True)
    if moved := set_aside(args.output):
        console.print(f"Moved earlier results to {moved}.", highlight=False, soft_wrap=True)
    scores: list[Score] = []

    def line(outcome: Outcome) -> str:
        return f"{outcome.task.case.name}, {outcome.task.steps} steps, seed {outcome.task.seed}"

    for outcome in run_all(run_task, tasks, workers=args.workers, console=console, name=line):
        scores += outcome.scores
        save(args.output / "results.csv", scores)
    show(scores, console)
    console.print(f"Wrote results.csv to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
