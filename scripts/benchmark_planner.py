"""Compares planning and sampling with other packages: regret and speed in the same environments.

python scripts/benchmark_planner.py                                        # without other packages
python scripts/benchmark_planner.py --peers-python peers/bin/python        # with mctx, LightZero and gymcts
python scripts/benchmark_planner.py --parts naive "short cut"

The peers need a Python environment of their own; pyproject.toml, extra "peers", describes how to create it.
"""

from __future__ import annotations

import os

# Set before NumPy and torch are imported: everything is timed on one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import torch

from harness import Row, Run, Tables, check_known, run_command
from studies.planning.coupled import compare_values
from studies.planning.latency import SETTINGS, steady
from studies.planning.latency import measure as measure_latency
from studies.planning.network_search import EFFORTS, measure_own, ratios, rows_of_mctx
from studies.planning.networks import build_task, pruned, run_networks_in_mctx
from studies.planning.page import TITLES, shown, write_page
from studies.planning.peers import PeerError
from studies.planning.quality import TOY_TEXT, play_game, play_table, scales, summary
from studies.planning.regret import Settings, compare
from studies.planning.sampling import compare_short_cut, compare_with_naive
from studies.planning.start import GAMES, first_decisions
from worlds.coupled import COUPLED
from worlds.synthetic_dbn import Sampler, trained

Say = Callable[[str], None]
PRUNED = 0.9
"""Smallest share of connections removed from the pruned networks."""

PARTS = ("quality", "crowds", "decisions", "start", "memory", "regret", "naive", "short cut", "networks")


@dataclass(frozen=True)
class Args:
    """Measure planning and sampling."""

    parts: tuple[str, ...] = PARTS
    """Parts to measure: quality of play (crowds: with many noisy variables), cost of decisions, start of a process, memory,
    regret (and speed of searches), naive, short cut, networks."""
    full: bool = False
    """5 agents of each kind, with learned and true models, instead of 1 with the true model."""
    peers_python: Path | None = None
    """Python interpreter of the peers' environment; without it the peers are skipped."""
    worlds: int = Settings.worlds
    """Random MDPs of each kind."""
    roots: int = Settings.roots
    """Roots in each MDP."""
    seeds: int = Settings.seeds
    """Searches per root and budget."""
    budgets: tuple[int, ...] = Settings.budgets
    """Simulations."""
    first_seed: int = 0
    """Of everything random."""
    draws: int = 4000
    """Samples per input with which full sweeps and the short cut are compared."""
    output: Path = Path("results/planning")
    """Folder for the tables and report.html; results of an earlier run are moved to a subfolder."""


def measure_quality(args: Args, say: Say) -> Tables:
    """Play with true models and, with ``--full``, with learned ones, compared with the best known policy."""
    seeds, rows = range(args.first_seed + 1000, args.first_seed + 1000 + (5 if args.full else 1)), []
    for name in TOY_TEXT:
        rows.append(summary([play_table(name, seed) for seed in seeds]))
    for key, scale in scales(say).items():
        for learned in (False, True) if args.full else (False,):
            say(f"{key}, {'learned' if learned else 'true'} model")
            rows.append(summary([play_game(key, seed, learned, scale) for seed in seeds]))
    return {"quality": rows}


def measure_crowds(args: Args, say: Say) -> Tables:
    """Planning with many noisy variables, without and with a fitted value function."""
    rows: list[Row] = []
    for make in COUPLED:
        world = make()
        say(f"crowds: {world.name}")
        rows += compare_values(world, args.first_seed + 1000)
    return {"crowds": rows}


def measure_decisions(args: Args, say: Say) -> Tables:
    """Milliseconds per decision, compared with PPO."""
    found, rows = scales(say), []
    for setting in SETTINGS:
        say(f"decisions: {setting.key}")
        rows += measure_latency(setting, args.first_seed + 1000, found[setting.key], 50 if args.full else 10)
    return {"decisions": rows}


def measure_start(args: Args, say: Say) -> Tables:
    """The first decision of a new process."""
    rows: list[Row] = []
    for key in GAMES:
        say(f"start: {key}")
        rows += first_decisions(key, args.first_seed + 1000)
    return {"start": rows}


def measure_memory(args: Args, say: Say) -> Tables:
    """Memory over many decisions."""
    rows = []
    for setting in SETTINGS[2:]:
        say(f"memory: {setting.key}")
        rows.append(steady(setting, args.first_seed + 1000, 100_000 if args.full else 10_000))
    return {"memory": rows}


def measure_regret(args: Args, say: Say) -> Tables:
    """Regret and speed of searches in tabular MDPs."""
    settings = Settings(args.worlds, args.roots, args.seeds, args.first_seed, args.budgets, args.peers_python)
    regrets, speeds = compare(settings, say=say)
    return {"regret": [asdict(row) for row in regrets], "speed": [asdict(row) for row in speeds]}


def measure_naive(args: Args, say: Say) -> Tables:
    """The compiled samplers compared with the naive procedure."""
    rows: list[Row] = []
    for sampler in get_args(Sampler):
        say(f"naive: {sampler}")
        model = trained(sampler, 32, args.first_seed)
        rows += [asdict(row) for row in compare_with_naive(model, sampler, (1, 64, 4096), args.first_seed)]
    return {"naive": rows}


def measure_short_cut(args: Args, say: Say) -> Tables:
    """Sweeps over the uncertain variables only, compared with sweeps over all."""
    rows: list[Row] = []
    for d in (32, 128):
        say(f"short cut: {d} bits")
        model = trained("sweeps", d, args.first_seed)
        rows += [asdict(compare_short_cut(model, sweeps, args.first_seed, 8, args.draws)) for sweeps in (1, 5)]
    return {"short cut": rows}


def measure_networks(args: Args, say: Say) -> Tables:
    """Searches with learned networks, full and pruned."""
    say("networks: learning the game")
    task = build_task(args.first_seed)
    tasks, own = (task, pruned(task, PRUNED, args.first_seed)), []
    for one in tasks:
        for effort in EFFORTS:
            say(f"networks: {effort.of(one)}, {effort.simulations} simulations")
            own.append(measure_own(one, effort))
    if args.peers_python is None:
        say("Networks in mctx are left out: --peers-python is not given.")
        return {"networks": [asdict(row) for row in own]}
    say("networks: mctx, Gumbel MuZero")
    try:
        peer = rows_of_mctx(task, run_networks_in_mctx(args.peers_python, task))
    except PeerError as error:
        say(f"Left out: {error}")
        return {"networks": [asdict(row) for row in own]}
    whole, less = own[: len(EFFORTS)], own[len(EFFORTS) :]
    return {
        "networks": [asdict(row) for row in (*own, *peer)],
        "equal regret": [asdict(row) for mine in (whole, less) for row in ratios(mine, peer)],
    }


_MEASURES: dict[str, Callable[[Args, Say], Tables]] = {
    "quality": measure_quality,
    "crowds": measure_crowds,
    "decisions": measure_decisions,
    "start": measure_start,
    "memory": measure_memory,
    "regret": measure_regret,
    "naive": measure_naive,
    "short cut": measure_short_cut,
    "networks": measure_networks,
}


def check(args: Args, run: Run | None = None) -> tuple[str, ...]:
    """The parts to measure.

    Raises:
        ValueError: an option is invalid.
    """
    check_known("part", args.parts, PARTS)
    if min(args.worlds, args.roots, args.seeds, *args.budgets) < 1:
        raise ValueError("All numbers must be at least 1.")
    return args.parts


def execute(args: Args, parts: tuple[str, ...], run: Run) -> None:
    """Measures the parts one after another in this process, since they are timed."""
    torch.set_num_threads(1)
    tables: Tables = {}
    for part in parts:
        tables |= {name: rows for name, rows in _MEASURES[part](args, run.say).items() if rows}
        run.write(tables)
    run.write_pictures(write_page(args.output / "report.html", tables, run.command))
    for name, rows in tables.items():
        run.show(TITLES[name], rows[0], [[shown(value) for value in row.values()] for row in rows], width=140)
    run.say(f"Wrote report.html and the tables to {args.output}.")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return run_command("benchmark_planner", __doc__, Args, check, execute, argv)


if __name__ == "__main__":
    sys.exit(main())
