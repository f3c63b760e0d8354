"""Prunes learned networks to increasing shares and measures the results (the paper's section 5).

python scripts/pruning.py                    # quick: FlierCatcher, one seed
python scripts/pruning.py --full             # three games, 5 seeds, 100 episodes each
python scripts/pruning.py --networks paper   # the paper's own networks
"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
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
    """Prune networks and measure the results."""

    full: bool = False
    """FlierCatcher, GeyserRunner and Maneuverer, 5 seeds and 100 episodes each."""
    games: tuple[str, ...] | None = None
    """Games; by default flier_catcher, with --full also geyser_high_cost and maneuverer."""
    fractions: tuple[float, ...] = FRACTIONS
    """Shares of the connections to remove."""
    ways: tuple[Way, ...] = Settings.ways
    """Remove only the smallest weights, or also those that the transitions do not support."""
    sizes: tuple[int, ...] | None = None
    """Numbers of variables of environments for timing; by default none, with --full 16, 32, 64 and 128."""
    networks: Networks = "causal"
    """The default networks, or the paper's own (much slower), both on flat variables."""
    timesteps: int = Settings.timesteps
    """Steps of random play to learn from."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = Settings.first_seed
    """Seed of the first repetition."""
    episodes: int | None = None
    """Episodes for each agent; by default 10, with --full 100; 0 for none."""
    output: Path = Path("results/pruning")
    """Folder for the page, the figures and the table; earlier ones are moved to a subfolder."""
    workers: int = 1
    """Number of processes, each with one thread; speeds are most reliable with one."""


def settings_of(args: Args, run: Run | None = None) -> Settings:
    """The settings given by the options."""
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
    """Prunes and measures; the page is rewritten after each cell."""
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
