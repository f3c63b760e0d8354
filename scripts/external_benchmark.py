"""Compares the agent on environments of other packages with the exact optimum, its planner on the true rules, PPO and DQN.

python scripts/external_benchmark.py                                # quick: one seed, 30 episodes
python scripts/external_benchmark.py --full                         # 5 seeds, 100 episodes
python scripts/external_benchmark.py --worlds Taxi SysAdmin --agents mbagent PPO --seeds 2

RDDL domains need pip install "mbagent[rddl]", MiniGrid pip install "mbagent[minigrid]"; without them these are skipped.

"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: work is parallel over processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field
from pathlib import Path

from harness import Run, check_known, run_cells, run_command
from studies.external import AGENTS, TRUE, Cell, run_cell, show
from worlds.registry import WORLDS, find_world


@dataclass(frozen=True)
class Args:
    """Compare the agent on environments of other packages."""

    full: bool = False
    """5 seeds, 100 episodes."""
    worlds: tuple[str, ...] = tuple(world.name for world in WORLDS)
    """Environments; "CartPole, binned" and "MountainCar, binned" are the examples of docs/environments.md."""
    agents: tuple[str, ...] = AGENTS
    """Which agents."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = 0
    """Seed of the first repetition."""
    episodes: int | None = None
    """Episodes after each training; by default 30, with --full 100."""
    steps: int | None = None
    """Environment steps for learning; by default 20,000, FrozenLake 8x8 50,000, Inventory and DeepSea 3,000."""
    baseline_steps: int | None = None
    """Steps for PPO and DQN; by default the same."""
    reward_scale: float | None = None
    """Factor of the rewards in the training of PPO and DQN; by default 1 for PPO and 0.1 for DQN."""
    output: Path = Path("results/external")
    """Folder for results.csv; results of an earlier run are moved to a subfolder."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def cells(args: Args, run: Run | None = None) -> list[Cell]:
    """The cells to run.

    Raises:
        ValueError: unknown world or agent, or a number out of range.
    """
    check_known("agent", args.agents, AGENTS)
    seeds = args.seeds if args.seeds is not None else 5 if args.full else 1
    episodes = args.episodes if args.episodes is not None else 100 if args.full else 30
    numbers = {"seeds": seeds, "episodes": episodes}
    numbers |= {name: n for name in ("steps", "baseline_steps") if (n := getattr(args, name)) is not None}
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {number}.")
    if args.reward_scale is not None and not 0.0 < args.reward_scale < float("inf"):
        raise ValueError(f"--reward-scale must be a positive number, got {args.reward_scale}.")
    worlds = [find_world(name) for name in args.worlds]
    missing = {world.missing for world in worlds if world.missing is not None}
    if run is not None:
        for extra in sorted(missing):
            run.say(f'Skipped environments that need pip install "mbagent[{extra}]".')
    return [
        Cell(world, agent, args.first_seed + i, steps, episodes, args.baseline_steps or steps, args.reward_scale)
        for world in worlds
        for steps in [args.steps or world.steps]
        for agent in args.agents
        if world.missing is None and not (agent == TRUE and world.kind in ("binned", "minatar", "planes"))
        for i in range(seeds)
    ]


def execute(args: Args, todo: list[Cell], run: Run) -> None:
    """Runs the cells and prints the means."""
    rows = [row for result in run_cells(run_cell, todo, run) for row in result.rows]
    if rows:
        show(rows, run)
        run.say(f"Wrote results.csv to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("external_benchmark", __doc__, Args, cells, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
