"""Plots the return of the agent, PPO and DQN against environment steps.

python scripts/learning_curves.py                                   # quick: Breakout, 5,000 steps
python scripts/learning_curves.py --full                            # Breakout and Asterix, up to 100,000 steps

MinAtar games need pip install "mbagent[minatar]".

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path

from harness import Run, check_known, run_cells, run_command
from studies.learning.curves import PLAYERS, Cell, draw_curves, run_cell, show
from worlds.registry import find_world

QUICK, FULL = (1000, 5000), (10_000, 30_000, 100_000)


@dataclass(frozen=True)
class Args:
    """Learning curves."""

    full: bool = False
    """Breakout and Asterix, up to 100,000 steps, 20 episodes per mark (an hour or more)."""
    worlds: tuple[str, ...] | None = None
    """Environments, by the names of scripts/external_benchmark.py, "MinAtar Breakout" and "MinAtar Asterix"."""
    agents: tuple[str, ...] = PLAYERS
    """Which agents."""
    marks: tuple[int, ...] | None = None
    """Environment steps after which episodes are played."""
    episodes: int | None = None
    """Episodes per mark; by default 5, with --full 20."""
    seeds: int = 1
    """Repetitions."""
    output: Path = Path("results/curves")
    """Folder for curves.csv and curves.png."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def cells(args: Args, run: Run | None = None) -> list[Cell]:
    """The cells to run.

    Raises:
        ValueError: unknown world or agent, a world that needs an extra, or a number out of range.
    """
    check_known("agent", args.agents, PLAYERS)
    marks = args.marks or (FULL if args.full else QUICK)
    episodes = args.episodes if args.episodes is not None else 20 if args.full else 5
    if min(args.seeds, episodes, *marks) < 1 or list(marks) != sorted(set(marks)):
        raise ValueError("--seeds and --episodes must be at least 1, and --marks ascending numbers of steps.")
    names = args.worlds or (("MinAtar Breakout", "MinAtar Asterix") if args.full else ("MinAtar Breakout",))
    worlds = [find_world(name) for name in names]
    for world in worlds:
        if world.missing:
            raise ValueError(f'{world.name} needs pip install "mbagent[{world.missing}]".')
    return [Cell(world, agent, seed, marks, episodes) for seed in range(args.seeds) for agent in args.agents for world in worlds]


def execute(args: Args, todo: list[Cell], run: Run) -> None:
    """Learns and plays, plots the curves and prints the means."""
    rows = [row for result in run_cells(run_cell, todo, run) for row in result.rows]
    run.write_pictures({"curves": draw_curves(rows)})
    show(rows, run)
    run.say(f"Wrote curves.csv and curves.png to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("learning_curves", __doc__, Args, cells, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
