"""Common code of the scripts that run other packages: input, timing and output.

They run in a separate Python environment, so nothing here may import mbagent.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

Search: TypeAlias = "Callable[[Array, int, int], tuple[Array, int]]"
"""(roots int [R], simulations, seed) -> (actions int [R], total number of sampled next states)."""


@dataclass(frozen=True)
class Task:
    """The task of a script; see ``studies.planning.peers``.

    Attributes:
        arrays: arrays of the MDP.
        roots: roots, int [R].
        simulations: budgets for choosing actions.
        seeds: each budget is used once with each seed.
        speeds: (roots, simulations) to time, int [N, 2].
        repetitions: timed calls of each.
    """

    arrays: dict[str, Array]
    roots: Array
    simulations: list[int]
    seeds: list[int]
    speeds: list[tuple[int, int]]
    repetitions: int


def read_task(path: Path) -> Task:
    """Reads the .npz file written by the main script."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return Task(
        arrays,
        arrays.pop("roots"),
        [int(n) for n in arrays.pop("simulations")],
        [int(seed) for seed in arrays.pop("seeds")],
        [(int(r), int(n)) for r, n in arrays.pop("speeds")],
        int(arrays.pop("repetitions")),
    )


def stay_on_one_core() -> None:
    """Restricts this process to one core and one thread; must be called before packages that start threads are imported."""
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def run(task: Task, searches: dict[str, Search]) -> None:
    """Lets each search choose actions, times it, and prints one JSON text."""
    results = {}
    for name, search in searches.items():
        choices = {str(n): [np.asarray(search(task.roots, n, seed)[0]).tolist() for seed in task.seeds] for n in task.simulations}
        results[name] = {"choices": choices, "speeds": [_speed(task, search, r, n) for r, n in task.speeds]}
    json.dump(results, sys.stdout)


def _speed(task: Task, search: Search, n_roots: int, simulations: int) -> dict[str, float]:
    """Median processor time of a call; the first call, which may compile, is excluded."""
    roots = np.resize(task.roots, n_roots)
    _, samples = search(roots, simulations, 0)
    seconds = []
    for repetition in range(task.repetitions):
        began = time.process_time()
        search(roots, simulations, 1 + repetition)
        seconds.append(time.process_time() - began)
    median = max(float(np.median(seconds)), 1e-9)
    done = n_roots * simulations
    return {
        "roots": n_roots,
        "simulations": simulations,
        "seconds": median,
        "simulations_per_second": done / median,
        "samples_per_second": samples / median,
    }
