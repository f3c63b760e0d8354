"""Checks what continuous integration leaves out: other versions of Python and of the dependencies, all extras, all studies.

python scripts/full_check.py                                 # all parts; many hours
python scripts/full_check.py --parts oldest
python scripts/full_check.py --parts studies --studies forecast pruning

Each step runs in a process of its own and writes its output to a file in ``--output``. Exit code 1 if any step failed.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import tyro
from rich.console import Console

ROOT = Path(__file__).parents[1]

Part: TypeAlias = Literal["extras", "oldest", "studies"]

EXTRAS = "dev,yardsticks,minatar,rddl,minigrid"
"""All extras but the peers, which need an environment of their own."""

STUDIES = (
    "compare_agents",
    "sampling_accuracy",
    "forecast",
    "pruning",
    "benchmark_planner",
    "model_accuracy",
    "exploration",
    "external_benchmark",
    "learning_curves",
    "first_use",
    "kill_test",
)
"""Scripts that are run in their quick form, which is the default of each."""

KEPT = ("torch",)
"""Dependencies that are not replaced by their oldest versions, whose packages have gigabytes."""


@dataclass(frozen=True)
class Step:
    """A series of commands, each of which must succeed.

    Attributes:
        name: name of the file with their output.
        commands: the commands.
    """

    name: str
    commands: Sequence[Sequence[str]]


def oldest() -> list[str]:
    """The oldest supported version of each dependency, as requirements."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    found = (re.match(r"([\w-]+)>=([\d.]+)", requirement) for requirement in declared)
    return [f"{match[1]}=={match[2]}.*" for match in found if match and match[1] not in KEPT]


def in_new_environment(name: str, python: str, folder: Path, extras: str, more: Sequence[str] = ()) -> Step:
    """The tests in a new virtual environment."""
    bin_folder = folder / name / "bin"
    pip = [str(bin_folder / "python"), "-m", "pip", "install", "--quiet"]
    return Step(
        name,
        [
            [python, "-m", "venv", "--clear", str(folder / name)],
            [*pip, "-c", str(ROOT / "constraints.txt"), "-e", f"{ROOT}[{extras}]"],
            *([[*pip, *more]] if more else []),
            [str(bin_folder / "python"), "-m", "pytest", "--numprocesses=auto", "--dist=loadfile", str(ROOT / "tests")],
        ],
    )


def steps(parts: Sequence[Part], studies: Sequence[str], pythons: Sequence[str], output: Path) -> Iterator[Step]:
    """All steps of the chosen parts; versions of Python that are not installed are skipped."""
    if "extras" in parts:
        for python in pythons:
            if shutil.which(python):
                yield in_new_environment(f"extras-{python}", python, output, EXTRAS)
    if "oldest" in parts:
        yield in_new_environment("oldest", sys.executable, output, "dev", oldest())
    if "studies" in parts:
        for study in studies:
            yield Step(study, [[sys.executable, str(ROOT / "scripts" / f"{study}.py")]])


def run(step: Step, output: Path) -> bool:
    """Runs a step; returns whether all commands succeeded."""
    with (output / f"{step.name}.txt").open("w") as file:
        return all(
            subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False).returncode == 0
            for command in step.commands
        )


def main(
    parts: tuple[Part, ...] = ("extras", "oldest", "studies"),
    studies: tuple[str, ...] = STUDIES,
    pythons: tuple[str, ...] = ("python3.11", "python3.12", "python3.13"),
    output: Path = ROOT / "results" / "full_check",
) -> None:
    """Runs all steps.

    Args:
        parts: extras: the tests with all extras, on each version of Python; oldest: the tests with the oldest supported
            dependencies; studies: all studies in their quick form.
        studies: names of scripts.
        pythons: interpreters for ``extras``; missing ones are skipped.
        output: folder for environments and outputs.
    """
    output.mkdir(parents=True, exist_ok=True)
    console, failed = Console(), []
    for step in steps(parts, studies, pythons, output):
        began = time.monotonic()
        good = run(step, output)
        console.print(f"{step.name}: {'passed' if good else 'failed'}, {(time.monotonic() - began) / 60:.0f} minutes")
        failed += [] if good else [step.name]
    if failed:
        console.print(f"Failed, see {output}: {', '.join(failed)}")
        raise SystemExit(1)


if __name__ == "__main__":
    tyro.cli(main)
