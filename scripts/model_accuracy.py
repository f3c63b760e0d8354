"""Measures how exactly models predict next states from layouts that they have not seen.

python scripts/model_accuracy.py                          # quick: one seed, 2,000 and 5,000 steps, 20,000 tests
python scripts/model_accuracy.py --full                   # 5 seeds, 2,000, 5,000 and 20,000 steps, 100,000 tests
python scripts/model_accuracy.py --models graphs --cases "Maneuverer, flat" --studies
python scripts/model_accuracy.py --cases --studies changes cost

"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.table import Table

from harness import check_run, open_folder, run_all, write_csv
from mbagent import files
from studies.model_accuracy.experiment import CASES, Outcome, Score, Settings, means, plan, run_task
from studies.model_accuracy.page import averaged, shown, write_page
from studies.model_accuracy.studies import STUDIES, Study, parts


@dataclass(frozen=True)
class Args:
    """Measure how exactly models predict."""

    full: bool = False
    """5 seeds, up to 20,000 steps, 100,000 tests."""
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    """Which worlds."""
    models: tuple[str, ...] = ("graphs", "networks")
    """Which models: any by name, and bayesnet, a dynamic Bayesian network by pyAgrum (pip install "mbagent[yardsticks]")."""
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
    studies: tuple[str, ...] = tuple(name for name in STUDIES if name != "minatar")
    """Further questions: changes of rules, false alarms of such changes, transfer between sizes, cost, parents found, error
    estimates (trust), planning (agents); minatar needs pip install "mbagent[minatar]". None with --studies alone."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def settings_of(args: Args) -> Settings:
    """The settings that the options stand for."""
    check_run(args.output, args.workers)
    return Settings(
        cases=args.cases,
        models=args.models,
        steps=args.steps if args.steps is not None else (2000, 5000, 20_000) if args.full else (2000, 5000),
        seeds=args.seeds if args.seeds is not None else 5 if args.full else 1,
        first_seed=args.first_seed,
        n_tests=args.n_tests if args.n_tests is not None else 100_000 if args.full else 20_000,
    )


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


@dataclass(frozen=True)
class Question:
    """One study, or a part of it, with one seed."""

    study: str
    work: Study
    seed: int
    full: bool


def answer(question: Question) -> tuple[Question, list[dict[str, Any]]]:
    """Runs a study."""
    torch.set_num_threads(1)
    return question, question.work(question.seed, question.full)


def check_studies(names: Sequence[str]) -> None:
    """Refuses unknown studies, and those whose packages are missing.

    Raises:
        ValueError: there is one.
    """
    for name in names:
        if name not in STUDIES:
            raise ValueError(f"There is no study {name!r}; choose from {', '.join(STUDIES)}.")
    if "minatar" in names and importlib.util.find_spec("minatar") is None:
        raise ValueError('The study minatar needs MinAtar: pip install "mbagent[minatar]".')


def show_rows(study: str, rows: list[dict[str, Any]], console: Console) -> None:
    """Prints a study's means over seeds."""
    table = Table(*rows[0], title=(STUDIES[study].__doc__ or "").splitlines()[0])
    for row in rows:
        table.add_row(*(shown(value) for value in row.values()))
    Console(width=max(console.width, 120)).print(table)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        settings = settings_of(args)
        tasks = plan(settings) if args.cases else []
        check_studies(args.studies)
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    open_folder(args.output, console)
    scores: list[Score] = []
    rows: dict[str, list[dict[str, Any]]] = {}

    def line(outcome: Outcome) -> str:
        return f"{outcome.task.case.name}, {outcome.task.steps} steps, seed {outcome.task.seed}"

    for outcome in run_all(run_task, tasks, workers=args.workers, console=console, name=line):
        scores += outcome.scores
        write_csv(args.output / "results.csv", [asdict(score) for score in scores])
    if scores:
        show(scores, console)
    questions = [
        Question(name, work, args.first_seed + i, args.full)
        for name in args.studies
        for i in range(settings.seeds)
        for work in parts(name, args.full)
    ]
    for question, found in run_all(
        answer, questions, workers=args.workers, console=console, name=lambda done: f"{done[0].study}, seed {done[0].seed}"
    ):
        rows.setdefault(question.study, []).extend(found)
        write_csv(args.output / f"{question.study}.csv", rows[question.study])
    accuracy = [{"world": c, "model": m, "steps": n, **figures} for (c, m, n), figures in sorted(means(scores).items())]
    pictures = write_page(args.output / "report.html", rows, accuracy, "scripts/model_accuracy.py" + " --full" * args.full)
    for name, png in pictures.items():
        files.write(args.output / f"{name}.png", png)
    for study, found in rows.items():
        show_rows(study, averaged(study, found), console)
    console.print(f"Wrote report.html and the tables to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
