"""Prunes learned networks to one share after another and shows what is left (the paper's section 5).

python scripts/pruning.py                    # quick: FlierCatcher, one seed
python scripts/pruning.py --full             # three games, 5 seeds, 100 episodes each
python scripts/pruning.py --networks paper   # the paper's own networks
"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass
from pathlib import Path

from harness import Result, Run, run_cells, run_command
from studies.pruning.experiment import FRACTIONS, GAMES, Cell, Networks, Settings, Way, cells, run_cell
from studies.pruning.measures import measure_size
from studies.pruning.page import summary_rows, write_page

SIZES = (16, 32, 64, 128)
"""Numbers of variables."""


@dataclass(frozen=True)
class Args:
    """Prune networks and measure what is left."""

    full: bool = False
    """FlierCatcher, GeyserRunner and Maneuverer, 5 seeds and 100 episodes each."""
    games: tuple[str, ...] | None = None
    """Which games; by default flier_catcher, with --full geyser_high_cost and maneuverer, too."""
    fractions: tuple[float, ...] = FRACTIONS
    """Shares of the connections to remove."""
    ways: tuple[Way, ...] = Settings.ways
    """Just the smallest weights, or also what the transitions do not call for."""
    sizes: tuple[int, ...] | None = None
    """Numbers of variables to time worlds of; by default none, with --full 16, 32, 64 and 128."""
    networks: Networks = "causal"
    """The default networks, or the paper's own (much slower), both on flat variables."""
    timesteps: int = Settings.timesteps
    """Steps of random play to learn from."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = Settings.first_seed
    """Seed of the first."""
    episodes: int | None = None
    """Episodes that each agent plays; by default 10, with --full 100; 0 for none."""
    output: Path = Path("results/pruning")
    """Folder for the page, the figures and the table; earlier ones there are moved to a folder of their own inside it."""
    workers: int = 1
    """Number of processes, each with one thread; speeds are measured best with one."""


def settings_of(args: Args, run: Run | None = None) -> Settings:
    """The settings that the options stand for."""
    return Settings(
        games=args.games if args.games is not None else GAMES if args.full else GAMES[:1],
        fractions=tuple(sorted(set(args.fractions))),
        ways=args.ways,
        networks=args.networks,
        timesteps=args.timesteps,
        seeds=args.seeds if args.seeds is not None else 5 if args.full else 1,
        first_seed=args.first_seed,
        episodes=args.episodes if args.episodes is not None else 100 if args.full else 10,
    )


def execute(args: Args, settings: Settings, run: Run) -> None:
    """Prunes and measures; the page is written anew after each cell."""
    sizes = args.sizes if args.sizes is not None else SIZES if args.full else ()
    costs = [measure_size(d, settings.first_seed + i) for d in sizes for i in range(min(settings.seeds, 3))]
    run.write({"sizes": [row._asdict() for row in costs]})

    def write(results: list[Result[Cell]]) -> None:
        outcomes = [result.arrays["outcome"] for result in results]
        run.write({"summary": summary_rows(outcomes)})
        run.write_pictures(write_page(args.output / "report.html", outcomes, settings, run.command, costs))

    run_cells(run_cell, cells(settings), run, each=write)
    run.say(f"Wrote report.html, results.csv and the figures to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("pruning", __doc__, Args, settings_of, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
