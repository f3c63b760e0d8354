"""Plots coverage of exploration and model error against steps: the agent's default compared with random actions.

python scripts/exploration.py                                       # quick: three worlds, one seed
python scripts/exploration.py --worlds SysAdmin Navigation --seeds 3
python scripts/exploration.py --worlds "maze 12x12, 10 lights" "grid 30x30"

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path

from harness import Run, check_known, find, run_cells, run_command
from mbagent.exploration.strategies import EXPLORATIONS
from studies.learning.coverage import Cell, draw_coverage, run_cell, show
from worlds.distractors import DISTRACTORS, DistractorWorld
from worlds.known_rules import exact_world
from worlds.registry import REGISTRY, World


@dataclass(frozen=True)
class Args:
    """Compare explorations."""

    worlds: tuple[str, ...] = ("FrozenLake 8x8", "CliffWalking", "Taxi")
    """Environments: those of the benchmark with known rules, or constructed ones (worlds.distractors)."""
    explorations: tuple[str, ...] = ("random", "auto")
    """Which explorations."""
    marks: tuple[int, ...] = (500, 1000, 2000, 5000, 10_000, 20_000)
    """Environment steps after which the model is fitted and measured."""
    seeds: int = 1
    """Repetitions."""
    output: Path = Path("results/exploration")
    """Folder for coverage.csv and coverage.png."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def cells(args: Args, run: Run | None = None) -> list[Cell]:
    """The cells to run.

    Raises:
        ValueError: unknown world or exploration, a world without known rules, or a number out of range.
    """
    check_known("exploration", args.explorations, EXPLORATIONS)
    if min(args.seeds, *args.marks) < 1 or list(args.marks) != sorted(set(args.marks)):
        raise ValueError("--seeds must be at least 1, and --marks ascending numbers of steps.")
    known: dict[str, World | DistractorWorld] = {**REGISTRY, **{world.name: world for world in DISTRACTORS}}
    worlds = [find("world", name, known) for name in args.worlds]
    for world in worlds:
        if isinstance(world, DistractorWorld):
            continue
        if world.missing:
            raise ValueError(f'{world.name} needs pip install "mbagent[{world.missing}]".')
        if exact_world(world) is None:
            raise ValueError(f"The true rules of {world.name} are not available.")
    return [Cell(world, name, seed, args.marks) for world in worlds for name in args.explorations for seed in range(args.seeds)]


def execute(args: Args, todo: list[Cell], run: Run) -> None:
    """Explores, plots coverage and model error, and prints the means."""
    rows = [row for result in run_cells(run_cell, todo, run) for row in result.rows]
    run.write_pictures({"coverage": draw_coverage(rows)})
    show(rows, run)
    run.say(f"Wrote coverage.csv and coverage.png to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("exploration", __doc__, Args, cells, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
