"""Compares forecasts of 1 ... n steps: the one-step model iterated, and a separate model for each n (paper 4.2).

python scripts/forecast.py                # quick: n = 1, 2, 4, 8, 15, one seed, 5,000 steps of experience
python scripts/forecast.py --full         # n = 1 ... 15, 3 seeds, 20,000 steps, and returns of a planner with both kinds

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path

from harness import Run, joined, run_cells, run_command
from studies.forecasting.experiment import CASES, Settings, cells, run_cell
from studies.forecasting.page import write_page

QUICK_STEPS, FULL_STEPS = (1, 2, 4, 8, 15), tuple(range(1, 16))


@dataclass(frozen=True)
class Args:
    """Compare forecasts several steps ahead."""

    full: bool = False
    """Every n from 1 to 15, 3 seeds, 20,000 steps of experience, and the returns of a planner (about 40 minutes)."""
    games: tuple[str, ...] = tuple(case.name for case in CASES)
    """Which games."""
    steps: tuple[int, ...] | None = None
    """Numbers of steps to forecast; by default 1 2 4 8 15, with --full 1 to 15."""
    timesteps: int | None = None
    """Steps of random play to learn from; by default 5,000, with --full 20,000."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 3."""
    first_seed: int = Settings.first_seed
    """Seed of the first repetition."""
    n_starts: int = Settings.n_starts
    """Number of states from which forecasts start."""
    n_draws: int = Settings.n_draws
    """Draws for each."""
    episodes: int | None = None
    """Episodes that flat Monte Carlo plays with each kind of forecast; by default 0, with --full 3."""
    output: Path = Path("results/forecast")
    """Folder for the page, the figure and the tables; earlier ones are moved to a subfolder."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def settings_of(args: Args, run: Run | None = None) -> Settings:
    """The settings given by the options."""

    def chosen(given: int | None, quick: int, full: int) -> int:
        return given if given is not None else full if args.full else quick

    steps = args.steps if args.steps is not None else FULL_STEPS if args.full else QUICK_STEPS
    return Settings(
        cases=args.games,
        steps=tuple(sorted(set(steps))),
        timesteps=chosen(args.timesteps, 5000, 20_000),
        seeds=chosen(args.seeds, 1, 3),
        first_seed=args.first_seed,
        n_starts=args.n_starts,
        n_draws=args.n_draws,
        episodes=chosen(args.episodes, 0, 3),
    )


def execute(args: Args, settings: Settings, run: Run) -> None:
    """Learns and forecasts, and writes the page."""
    tables = joined(run_cells(run_cell, cells(settings), run))
    run.write_pictures({"forecast": write_page(args.output / "report.html", tables, settings, run.command)})
    run.say(f"Wrote report.html, forecast.png and results.csv to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("forecast", __doc__, Args, settings_of, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
