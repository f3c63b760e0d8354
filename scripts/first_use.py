"""Processor time of the first use on a fresh installation, which compiles; and of the import.

python scripts/first_use.py                                # three environments, about two minutes
python scripts/first_use.py FrozenLake-v1 --repetitions 5

Each measurement is a new process with an empty folder for compiled functions. The import is compared with that of
Stable-Baselines3.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

ENVIRONMENTS = ("mbagent/GeyserRunner-v0", "FrozenLake-v1", "mbagent/FlierCatcher-v0")

LEARN = """
import time, warnings
warnings.simplefilter("ignore")
import gymnasium as gym
import mbagent
began = time.process_time()
env = gym.make({name!r})
agent = mbagent.ModelLearningAgent("MctsPolicy", env, seed=0).learn(1000, log_interval=None)
agent.predict(env.reset(seed=0)[0])
print(time.process_time() - began)
"""

IMPORT = "import time; began = time.process_time(); import {name}; print(time.process_time() - began)"


def seconds(code: str, folder: Path) -> float:
    """What a program prints last, run in a new process with one thread and a folder for compiled functions and bytecode."""
    compiled, bytecode = folder / "compiled", folder / "bytecode"
    compiled.mkdir(exist_ok=True)
    folders = {"NUMBA_CACHE_DIR": str(compiled), "PYTHONPYCACHEPREFIX": str(bytecode), "PYTHONDONTWRITEBYTECODE": ""}
    settings = {**os.environ, **folders, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=settings, cwd=folder, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def import_seconds(repetitions: int) -> tuple[float, float]:
    """Median processor seconds of importing this package and Stable-Baselines3, in turn, when their bytecode exists."""
    with tempfile.TemporaryDirectory() as folder:
        both = [
            tuple(seconds(IMPORT.format(name=name), Path(folder)) for name in ("mbagent", "stable_baselines3"))
            for _ in range(repetitions + 1)
        ][1:]  # the first one writes the bytecode
    ours, theirs = (statistics.median(times) for times in zip(*both, strict=True))
    return ours, theirs


def measure(name: str) -> float:
    """Processor seconds of ``learn(1000)`` and ``predict`` in an environment, with an empty folder for compiled functions."""
    with tempfile.TemporaryDirectory() as folder:
        return seconds(LEARN.format(name=name), Path(folder))


def main(environments: Annotated[tuple[str, ...], tyro.conf.Positional] = ENVIRONMENTS, repetitions: int = 1) -> None:
    """Measures the first use and the import.

    Args:
        environments: ids of Gymnasium environments.
        repetitions: measurements of each, but at least 5 of the import; the median is printed.
    """
    ours, theirs = import_seconds(max(repetitions, 5))
    console = Console()
    console.print(f"import mbagent: {ours:.2f} s, import stable_baselines3: {theirs:.2f} s", highlight=False)
    for name in environments:
        console.print(f"{name}: {statistics.median(measure(name) for _ in range(repetitions)):.1f} s", highlight=False)


if __name__ == "__main__":
    tyro.cli(main)
