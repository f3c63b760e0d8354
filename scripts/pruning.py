"""Prunes learned networks to one share after another and shows what is left (the paper's section 5).

python scripts/pruning.py                    # quick: FlierCatcher, one seed
python scripts/pruning.py --full             # three games, 5 seeds, 100 episodes each
python scripts/pruning.py --networks paper   # the paper's own networks
"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich.console import Console

from harness import check_run, open_folder, run_all, write_csv
from mbagent import files
from studies.pruning.experiment import FRACTIONS, GAMES, Networks, Outcome, Settings, Way, plan, run_task
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


def settings_of(args: Args) -> Settings:
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


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        settings = settings_of(args)
        check_run(args.output, args.workers)
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    open_folder(args.output, console)
    sizes = args.sizes if args.sizes is not None else SIZES if args.full else ()
    costs = [measure_size(d, settings.first_seed + i) for d in sizes for i in range(min(settings.seeds, 3))]
    if costs:
        write_csv(args.output / "sizes.csv", [row._asdict() for row in costs])
    outcomes: list[Outcome] = []
    command = shlex.join(["python", "scripts/pruning.py", *(sys.argv[1:] if argv is None else argv)])
    work = run_all(
        run_task, plan(settings), workers=args.workers, console=console, name=lambda o: f"{o.task.game}, seed {o.task.seed}"
    )
    for outcome in work:
        outcomes.append(outcome)
        write_csv(args.output / "results.csv", [asdict(row) for o in outcomes for row in o.rows])
        write_csv(args.output / "summary.csv", summary_rows(outcomes))
        for name, png in write_page(args.output / "report.html", outcomes, settings, command, costs).items():
            files.write(args.output / f"{name}.png", png)
    console.print(f"Wrote report.html, results.csv and the figures to {args.output}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
