"""Plays environments that are not the agent's own, beside the exact optimum, its planner on the true rules, PPO and DQN.

python scripts/external_benchmark.py                                # quick: one seed, 30 episodes
python scripts/external_benchmark.py --full                         # 5 seeds, 100 episodes
python scripts/external_benchmark.py --worlds Taxi SysAdmin --agents mbagent PPO --seeds 2

RDDL domains need pip install "mbagent[rddl]", MiniGrid pip install "mbagent[minigrid]"; without them these are left out.

"""

from __future__ import annotations

import os

# Before NumPy and torch are imported: parallel work is done by processes, each with one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from harness import check_run, open_folder, run_all, write_csv
from mbagent.evaluation.statistics import interquartile_interval
from studies.external.experiment import AGENTS, TRUE, Row, Task, run_task
from worlds.environments import ARCADE, CONTINUOUS, WORLDS, find_world


@dataclass(frozen=True)
class Args:
    """Play environments that are not the agent's own."""

    full: bool = False
    """5 seeds, 100 episodes."""
    worlds: tuple[str, ...] = tuple(world.name for world in WORLDS)
    """Which environments; "CartPole, binned" and "MountainCar, binned" are the examples of docs/environments.md."""
    agents: tuple[str, ...] = AGENTS
    """Which agents."""
    seeds: int | None = None
    """Repetitions; by default 1, with --full 5."""
    first_seed: int = 0
    """Seed of the first."""
    episodes: int | None = None
    """Episodes after each learning; by default 30, with --full 100."""
    steps: int | None = None
    """Environment steps for learning; by default 20,000, FrozenLake 8x8 50,000, Inventory and DeepSea 3,000."""
    baseline_steps: int | None = None
    """Steps for PPO and DQN; by default the same."""
    reward_scale: float | None = None
    """What rewards are multiplied with where PPO and DQN are trained; by default 1 for PPO and 0.1 for DQN."""
    output: Path = Path("results/external")
    """Folder for results.csv; results of an earlier run there are moved to a folder of their own inside it."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of processes, each with one thread."""


def plan(args: Args) -> list[Task]:
    """All that is to be done.

    Raises:
        ValueError: there is no such world or agent, or a number is below 1.
    """
    unknown = [agent for agent in args.agents if agent not in AGENTS]
    if unknown:
        raise ValueError(f"There is no agent {unknown[0]!r}; choose from {', '.join(map(repr, AGENTS))}.")
    seeds = args.seeds if args.seeds is not None else 5 if args.full else 1
    episodes = args.episodes if args.episodes is not None else 100 if args.full else 30
    numbers = {"seeds": seeds, "episodes": episodes, "workers": args.workers}
    numbers |= {name: n for name in ("steps", "baseline_steps") if (n := getattr(args, name)) is not None}
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {number}.")
    if args.reward_scale is not None and not 0.0 < args.reward_scale < float("inf"):
        raise ValueError(f"--reward-scale must be a positive number, got {args.reward_scale}.")
    tasks = []
    for world in map(find_world, args.worlds):
        steps = args.steps or world.steps
        for agent in args.agents:
            if world.missing is None and not (agent == TRUE and world.kind in ("binned", "minatar", "planes")):
                more = [
                    Task(world, agent, args.first_seed + i, steps, episodes, args.baseline_steps or steps, args.reward_scale)
                    for i in range(seeds)
                ]
                tasks += more
    return tasks


def show(rows: Sequence[Row], console: Console) -> None:
    """Prints each agent in each world: normalised return as interquartile mean over seeds, the rest as means."""
    names = (
        "world",
        "agent",
        "steps",
        "return",
        "exact",
        "optimum",
        "normalised",
        "95%",
        "return > 0",
        "learning, s",
        "decision, ms",
    )
    table = Table(*names, title="Environments that are not the agent's own")
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["world"], row["agent"]), []).append(row)
    order = {name: i for i, name in enumerate(AGENTS)}
    places = {world.name: i for i, world in enumerate((*WORLDS, *CONTINUOUS, *ARCADE))}
    for (world, agent), group in sorted(groups.items(), key=lambda item: (places[item[0][0]], order[item[0][1]])):
        mean = {name: float(np.mean([row[name] for row in group])) for name in group[0] if name not in ("world", "agent")}
        known = np.isfinite(mean["normalised"])
        interval = interquartile_interval(np.array([[row["normalised"]] for row in group])) if known else None
        ends = f"{interval.low:.3f} to {interval.high:.3f}" if interval and len(group) > 1 else "–"
        figures: list[Any] = [f"{mean['steps']:,.0f}", *(f"{mean[name]:.3f}" for name in ("return", "exact", "optimum"))]
        figures += [f"{interval.estimate:.3f}" if interval else "–", ends, f"{100 * mean['positive']:.1f}%"]
        figures += [f"{mean['learn_seconds']:.1f}", f"{mean['milliseconds']:.2f}"]
        table.add_row(world, agent, *("–" if figure == "nan" else figure for figure in figures))
    Console(width=max(console.width, 150)).print(table)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    try:
        check_run(args.output, args.workers)
        tasks = plan(args)
    except ValueError as error:
        console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    for extra in sorted({world.missing or "" for world in map(find_world, args.worlds)} - {""}):
        console.print(f'Left out what needs pip install "mbagent[{extra}]".', highlight=False, markup=False, soft_wrap=True)
    open_folder(args.output, console)
    rows: list[Row] = []

    def line(row: Row) -> str:
        return f"{row['world']}, {row['agent']}, seed {row['seed']}: {row['return']:.3f} (normalised {row['normalised']:.3f})"

    for row in run_all(run_task, tasks, workers=args.workers, console=console, name=line):
        rows.append(row)
        write_csv(args.output / "results.csv", rows)
    if rows:
        show(rows, console)
        console.print(f"Wrote results.csv to {args.output}.", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
