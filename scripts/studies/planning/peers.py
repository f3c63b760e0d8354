"""Searches of other packages, run by a separate Python (with ``pip install "mbagent[peers]"``, or the packages in it)."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbagent.types import Ints
from worlds.random_mdps import RandomMDP, save_mdp

SCRIPTS = Path(__file__).parents[2] / "peers"
"""Folder of the scripts that run them, in the source tree."""

PEERS = ("mctx_search", "lightzero_search", "gymcts_search")
"""Scripts that search in tabular MDPs."""

SLOW = {"gymcts_search": 1024}
"""Largest budget of a peer that would take minutes for more."""

SPEEDS = ((1, 256), (1, 1024), (16, 1024))
"""(roots, simulations) with which searches are timed."""


@dataclass(frozen=True)
class Speed:
    """Speed of a search.

    Attributes:
        roots: number of roots searched at once.
        simulations: simulations for each root.
        seconds: median processor time per call, on one core.
        simulations_per_second: simulations over all roots.
        samples_per_second: next states sampled from the model, over all roots.
    """

    roots: int
    simulations: int
    seconds: float
    simulations_per_second: float
    samples_per_second: float


@dataclass(frozen=True)
class PeerResult:
    """Results of a peer.

    Attributes:
        name: name of the search.
        choices: budget -> actions int64 [seeds, R].
        speeds: measured speeds.
    """

    name: str
    choices: dict[int, Ints]
    speeds: list[Speed]


class PeerError(RuntimeError):
    """A peer failed; the message is the last line of its output."""


def run_script(python: Path, script: str, arguments: Sequence[str], timeout: float = 3600.0) -> Any:
    """Runs a script of ``scripts/peers`` and returns the JSON it prints.

    Raises:
        PeerError: the script failed.
    """
    # The peers' Python sees only these scripts of this repository.
    environment = {**os.environ, "PYTHONPATH": str(SCRIPTS.parent)}
    command = [str(python), str(SCRIPTS / f"{script}.py"), *arguments]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=timeout)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PeerError(f"{script}: {error}") from error
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise PeerError(f"{script}: {said[-1]}")
    return json.loads(done.stdout)


def run_peer(
    python: Path,
    script: str,
    world: RandomMDP,
    roots: Ints,
    budgets: Sequence[int],
    seeds: Sequence[int],
    speeds: Sequence[tuple[int, int]] = (),
    repetitions: int = 5,
) -> list[PeerResult]:
    """Lets a peer choose actions in an MDP, and times it.

    Args:
        python: Python interpreter of the peer's environment.
        script: one of ``PEERS``.
        world: the MDP; several are combined by ``side_by_side``.
        roots: roots, int64 [R].
        budgets: simulations for each root.
        seeds: each budget is used once with each seed.
        speeds: (roots, simulations) to time.
        repetitions: timed calls of each, after a first one that may compile.

    Raises:
        PeerError: the script failed.
    """
    most = SLOW.get(script, max(budgets, default=0))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.npz"
        save_mdp(
            path,
            world,
            roots=roots,
            simulations=np.array([n for n in budgets if n <= most], dtype=np.int64),
            seeds=np.array(seeds, dtype=np.int64),
            speeds=np.array(speeds, dtype=np.int64).reshape(-1, 2),
            repetitions=np.array(repetitions),
        )
        output = run_script(python, script, [str(path)])
    return [
        PeerResult(
            name,
            {int(n): np.array(actions, dtype=np.int64) for n, actions in result["choices"].items()},
            [Speed(**speed) for speed in result["speeds"]],
        )
        for name, result in output.items()
    ]
