"""Draws what exploration has tried, and how wrong the model is by then, against steps: the agent's default beside random steps.

python scripts/exploration.py                                       # quick: three worlds, one seed
python scripts/exploration.py --worlds SysAdmin Navigation --seeds 3
python scripts/exploration.py --worlds "maze 12x12, 10 lights" "grid 30x30"

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
from mbagent.exploration import EXPLORATIONS
from studies.learning.coverage import Row, Study, draw_coverage, run_study
from worlds.distractors import BESIDES, BesideWorld
from worlds.environments import exact_world, find_world


@dataclass(frozen=True)
class Args:
    """Compare explorations."""

    worlds: tuple[str, ...] = ("FrozenLake 8x8", "CliffWalking", "Taxi")
    """Which environments: those of the benchmark whose rules are known, or made-up ones (worlds.distractors)."""
    explorations: tuple[str, ...] = ("random", "auto")
    """Which explorations."""
    marks: tuple[int, ...] = (500, 1000, 2000, 5000, 10_000, 20_000)
    """Environment steps after which to fit the model and measure."""
    seeds: int = 1
    """Repetitions."""
    output: Path = Path("results/exploration")
    """Folder for coverage.csv and coverage.png."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def plan(args: Args) -> list[Study]:
    """All that is to be done.

    Raises:
        ValueError: there is no such world or exploration, a world's rules are unknown, or a number is out of range.
    """
    unknown = [name for name in args.explorations if name not in EXPLORATIONS]
    if unknown:
        raise ValueError(f"There is no exploration {unknown[0]!r}; choose from {', '.join(map(repr, EXPLORATIONS))}.")
    if min(args.seeds, args.workers, *args.marks) < 1 or list(args.marks) != sorted(set(args.marks)):
        raise ValueError("--seeds and --workers must be at least 1, and --marks ascending numbers of steps.")
    made_up = {world.name: world for world in BESIDES}
    worlds = [made_up[name] if name in made_up else find_world(name) for name in args.worlds]
    for world in worlds:
        if isinstance(world, BesideWorld):
            continue
        if world.missing:
            raise ValueError(f'{world.name} needs pip install "mbagent[{world.missing}]".')
        if exact_world(world) is None:
            raise ValueError(f"The true rules of {world.name} are not at hand.")
    return [Study(world, name, seed, args.marks) for world in worlds for name in args.explorations for seed in range(args.seeds)]


def show(rows: list[Row], console: Console) -> None:
    """Prints means over seeds."""
    table = Table("world", "exploration", "steps", "tried", "model error", "normalised return", title="Exploration")
    keys = list(dict.fromkeys((row["world"], row["exploration"], row["steps"]) for row in rows))
    for key in sorted(keys, key=lambda key: (key[0], key[2], key[1])):
        own = [row for row in rows if (row["world"], row["exploration"], row["steps"]) == key]
        tried, error, value = (float(np.mean([row[name] for row in own])) for name in ("tried", "error", "normalised"))
        table.add_row(key[0], key[1], f"{key[2]:,}", f"{100 * tried:.1f}%", f"{error:.4f}", f"{value:.3f}")
    console.print(table)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        check_run(args.output, args.workers)
        studies = plan(args)
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    open_folder(args.output, console)
    rows: list[Row] = []

    def line(result: list[Row]) -> str:
        last = result[-1]
        return f"{last['world']}, {last['exploration']}, seed {last['seed']}: {100 * last['tried']:.1f}% tried"

    for result in run_all(run_study, studies, workers=args.workers, console=console, name=line):
        rows += result
        write_csv(args.output / "coverage.csv", rows)
    files.write(args.output / "coverage.png", draw_coverage(rows))
    show(rows, console)
    console.print(f"Wrote coverage.csv and coverage.png to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
