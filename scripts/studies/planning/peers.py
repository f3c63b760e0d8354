"""Other packages' searches, run by a Python of their own (``pip install "mbagent[peers]"`` there, or the names in it)."""

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
"""The scripts that run them, in the source tree."""

PEERS = ("mctx_search", "lightzero_search", "gymcts_search")
"""Those that search table worlds."""

SLOW = {"gymcts_search": 1024}
"""Most simulations asked of a peer that would take minutes for more."""

SPEEDS = ((1, 256), (1, 1024), (16, 1024))
"""(roots, simulations) at which searches are timed."""


@dataclass(frozen=True)
class Speed:
    """How fast a search is.

    Attributes:
        roots: searched at once.
        simulations: for each root.
        seconds: processor time of a call, the median of several, on one core.
        simulations_per_second: over all roots.
        samples_per_second: next states drawn from the model, over all roots.
    """

    roots: int
    simulations: int
    seconds: float
    simulations_per_second: float
    samples_per_second: float


@dataclass(frozen=True)
class PeerResult:
    """What a peer did.

    Attributes:
        name: of the search.
        choices: budget -> actions int64 [seeds, R].
        speeds: what was timed.
    """

    name: str
    choices: dict[int, Ints]
    speeds: list[Speed]


class PeerError(RuntimeError):
    """A peer did not run; the message is the last line of what it said."""


def run_script(python: Path, script: str, arguments: Sequence[str], timeout: float = 3600.0) -> Any:
    """Runs a script of ``scripts/peers`` and returns the JSON it prints.

    Raises:
        PeerError: it failed.
    """
    # The scripts are all that the peers' Python is shown of this repository.
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
    """Lets a peer choose actions in a world, and times it.

    Args:
        python: of the environment that has the peer.
        script: one of ``PEERS``.
        world: what is searched; several worlds as ``side_by_side`` makes one of them.
        roots: int64 [R].
        budgets: simulations for each root.
        seeds: each budget is used once with each.
        speeds: (roots, simulations) to time.
        repetitions: timed calls of each, after one that may compile.

    Raises:
        PeerError: it failed.
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
        told = run_script(python, script, [str(path)])
    return [
        PeerResult(
            name,
            {int(n): np.array(actions, dtype=np.int64) for n, actions in result["choices"].items()},
            [Speed(**speed) for speed in result["speeds"]],
        )
        for name, result in told.items()
    ]
