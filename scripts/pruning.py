"""Prunes learned networks to one share after another and shows what is left (the paper's section 5).

python scripts/pruning.py                    # quick: FlierCatcher, one seed
python scripts/pruning.py --full             # three games, 5 seeds, 100 episodes each
python scripts/pruning.py --networks paper   # the paper's own networks
"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import csv
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import tyro
from rich.console import Console

from mbagent.analysis.folders import set_aside
from mbagent.analysis.parallel import run_all
from mbagent.analysis.pruning.experiment import FRACTIONS, GAMES, Networks, Outcome, Row, Settings, plan, run_task
from mbagent.analysis.pruning.page import write_page


@dataclass(frozen=True)
class Args:
    """Prune networks and measure what is left."""

    full: bool = False
    """FlierCatcher, GeyserRunner and Maneuverer, 5 seeds and 100 episodes each."""
    games: tuple[str, ...] | None = None
    """Which games; by default flier_catcher, with --full geyser_high_cost and maneuverer, too."""
    fractions: tuple[float, ...] = FRACTIONS
    """Shares of the connections to remove."""
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
        networks=args.networks,
        timesteps=args.timesteps,
        seeds=args.seeds if args.seeds is not None else 5 if args.full else 1,
        first_seed=args.first_seed,
        episodes=args.episodes if args.episodes is not None else 100 if args.full else 10,
    )


def save(path: Path, rows: Sequence[Row]) -> None:
    """Writes a csv with a line for each."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        settings = settings_of(args)
        if args.workers < 1:
            raise ValueError(f"--workers must be at least 1 process, got {args.workers}.")
        if args.output.exists() and not args.output.is_dir():
            raise ValueError(f"--output must be a folder, and {args.output} is a file.")
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    args.output.mkdir(parents=True, exist_ok=True)
    if moved := set_aside(args.output):
        console.print(f"Moved earlier results to {moved}.", highlight=False, soft_wrap=True)
    outcomes: list[Outcome] = []
    command = shlex.join(["python", "scripts/pruning.py", *(sys.argv[1:] if argv is None else argv)])
    work = run_all(
        run_task, plan(settings), workers=args.workers, console=console, name=lambda o: f"{o.task.game}, seed {o.task.seed}"
    )
    for outcome in work:
        outcomes.append(outcome)
        save(args.output / "results.csv", [row for o in outcomes for row in o.rows])
        for name, png in write_page(args.output / "report.html", outcomes, settings, command).items():
            (args.output / f"{name}.png").write_bytes(png)
    console.print(f"Wrote report.html, results.csv and the figures to {args.output}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
