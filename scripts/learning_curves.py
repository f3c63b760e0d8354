"""Draws the return of the agent, PPO and DQN against environment steps.

python scripts/learning_curves.py                                   # quick: Breakout, 5,000 steps
python scripts/learning_curves.py --full                            # Breakout and Asterix, up to 100,000 steps

MinAtar games need pip install "mbagent[minatar]".

"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from harness import check_run, open_folder, run_all, write_csv
from mbagent import files
from studies.learning.curves import PLAYERS, Course, Row, draw_curves, run_course
from worlds.environments import find_world

QUICK, FULL = (1000, 5000), (10_000, 30_000, 100_000)


@dataclass(frozen=True)
class Args:
    """Learning curves."""

    full: bool = False
    """Breakout and Asterix, up to 100,000 steps, 20 episodes each time (an hour or more)."""
    worlds: tuple[str, ...] | None = None
    """Which environments, by the names of scripts/external_benchmark.py, "MinAtar Breakout" and "MinAtar Asterix"."""
    agents: tuple[str, ...] = PLAYERS
    """Which agents."""
    marks: tuple[int, ...] | None = None
    """Environment steps after which to play."""
    episodes: int | None = None
    """Episodes each time; by default 5, with --full 20."""
    seeds: int = 1
    """Repetitions."""
    output: Path = Path("results/curves")
    """Folder for curves.csv and curves.png."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def plan(args: Args) -> list[Course]:
    """All that is to be done.

    Raises:
        ValueError: there is no such world or agent, a world needs an extra, or a number is out of range.
    """
    unknown = [agent for agent in args.agents if agent not in PLAYERS]
    if unknown:
        raise ValueError(f"There is no agent {unknown[0]!r}; choose from {', '.join(map(repr, PLAYERS))}.")
    marks = args.marks or (FULL if args.full else QUICK)
    episodes = args.episodes if args.episodes is not None else 20 if args.full else 5
    if min(args.seeds, episodes, *marks) < 1 or list(marks) != sorted(set(marks)):
        raise ValueError("--seeds and --episodes must be at least 1, and --marks ascending numbers of steps.")
    names = args.worlds or (("MinAtar Breakout", "MinAtar Asterix") if args.full else ("MinAtar Breakout",))
    worlds = [find_world(name) for name in names]
    for world in worlds:
        if world.missing:
            raise ValueError(f'{world.name} needs pip install "mbagent[{world.missing}]".')
    return [
        Course(world, agent, seed, marks, episodes) for seed in range(args.seeds) for agent in args.agents for world in worlds
    ]


def show(rows: list[Row], console: Console) -> None:
    """Prints means over seeds."""
    table = Table("world", "agent", "steps", "return", "standard error", "learning, s", title="Learning curves")
    for key in sorted({(row["world"], row["agent"], row["steps"]) for row in rows}):
        own = [row for row in rows if (row["world"], row["agent"], row["steps"]) == key]
        value, error, seconds = (float(np.mean([row[name] for row in own])) for name in ("return", "error", "learn_seconds"))
        table.add_row(key[0], key[1], f"{key[2]:,}", f"{value:.2f}", f"{error:.2f}", f"{seconds:.0f}")
    console.print(table)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        check_run(args.output, args.workers)
        courses = plan(args)
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    open_folder(args.output, console)
    rows: list[Row] = []

    def line(result: list[Row]) -> str:
        last = result[-1]
        return f"{last['world']}, {last['agent']}, seed {last['seed']}: {last['return']:.2f} after {last['steps']:,} steps"

    for result in run_all(run_course, courses, workers=args.workers, console=console, name=line):
        rows += result
        write_csv(args.output / "curves.csv", rows)
    files.write(args.output / "curves.png", draw_curves(rows))
    show(rows, console)
    console.print(f"Wrote curves.csv and curves.png to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
