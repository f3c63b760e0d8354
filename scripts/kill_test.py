"""Kills processes with SIGKILL at random times while they save, and checks that the last or the new file always loads.

python scripts/kill_test.py --kills 50
python scripts/kill_test.py --subjects folder --kills 200 --seed 7

Also: two processes that save at one path at once, and saving through a symbolic link. Exit code 1 if anything was lost.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import itertools
import multiprocessing
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

import mbagent
from mbagent.data import TransitionBatch, TransitionDataset

GAME = "mbagent/FlierCatcher-v0"
N_FACTORS = 120
METHOD = "forkserver"
"""Start method of processes: forked from a server that has already imported everything."""
Subject: TypeAlias = Literal["save", "save_transitions", "folder"]


@dataclass(frozen=True)
class Args:
    """Kill processes that save."""

    kills: int = 10
    """Number of kills per subject, plus a fifth as many through a symbolic link."""
    subjects: tuple[Subject, ...] = ("save", "save_transitions", "folder")
    """What to kill: agent.save, agent.save_transitions, or TransitionDataset(folder=...).append."""
    rows: int = 10_000
    """Transitions in a file, or in a call of append: more of them make a write longer."""
    seed: int = 0
    """Seed of the times of the kills."""


def rows_of(version: int, n: int) -> TransitionBatch:
    """``n`` transitions that encode the version of their file, and that compress poorly."""
    rng = np.random.default_rng(version)
    states, after = rng.integers(2, size=(2, n, N_FACTORS), dtype=np.uint8)
    number = np.full(n, version)
    return TransitionBatch(states, rng.integers(3, size=n), after, number < 0, number.astype(np.float64), number)


def version_of(rows: TransitionBatch, n: int) -> int:
    """The version encoded in rows.

    Raises:
        ValueError: they are not the complete rows of one version.
    """
    version = int(rows.episodes[0])
    expected = rows_of(version, n)
    if not all(np.array_equal(getattr(rows, name), getattr(expected, name)) for name in vars(expected)):
        raise ValueError(f"the rows are not those of version {version}")
    return version


def agent_with(version: int, n: int) -> mbagent.ModelLearningAgent:
    """Creates an agent with the transitions of a version."""
    agent = mbagent.ModelLearningAgent("MctsPolicy", gym.make(GAME), seed=0)
    agent.experience.dataset.append(rows_of(version, n))
    agent.num_timesteps = version
    return agent


def save_agent(path: Path, version: int, n: int) -> None:
    """Saves a version with its transitions."""
    agent_with(version, n).save(path, include=["transitions"])


def load_agent(path: Path, n: int) -> int:
    """The version in a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # loaded without an environment
        agent = mbagent.ModelLearningAgent.load(path)
    version = version_of(agent.experience.dataset.rows(), n)
    if agent.num_timesteps != version:
        raise ValueError(f"steps of version {agent.num_timesteps} with the transitions of version {version}")
    return version


def save_transitions(path: Path, version: int, n: int) -> None:
    """Saves a version's transitions."""
    agent_with(version, n).save_transitions(str(path))


def load_transitions(path: Path, n: int) -> int:
    """The version in a file."""
    return version_of(TransitionDataset.load(path).rows(), n)


def append(path: Path, version: int, n: int) -> None:
    """Appends a version's transitions to a folder; version 0 creates the folder."""
    if version:
        TransitionDataset((2,) * N_FACTORS, 3, path).append(rows_of(version, n))
    else:
        TransitionDataset((2,) * N_FACTORS, 3, path)


def load_folder(path: Path, n: int) -> int:
    """Number of versions in a folder, which must be consecutive."""
    rows = TransitionDataset((2,) * N_FACTORS, 3, path).rows()
    if len(rows) % n:
        raise ValueError(f"{len(rows)} rows are not a whole number of versions")
    last = len(rows) // n
    if last and (version_of(rows.select(slice(-n, None)), n) != last or rows.episodes[::n].tolist() != list(range(1, last + 1))):
        raise ValueError("versions are missing or out of order")
    return last


class Kind(NamedTuple):
    """Functions that write and read a subject, and its file name."""

    write: Callable[[Path, int, int], None]
    read: Callable[[Path, int], int]
    name: str


KINDS: dict[Subject, Kind] = {
    "save": Kind(save_agent, load_agent, "agent.zip"),
    "save_transitions": Kind(save_transitions, load_transitions, "transitions.npz"),
    "folder": Kind(append, load_folder, "transitions"),
}


def keep_saving(subject: Subject, path: Path, first: int, n: int, sender: Connection, most: int = sys.maxsize) -> None:
    """Saves one version after another, and sends the number of each saved version."""
    for version in itertools.islice(itertools.count(first), most):
        KINDS[subject].write(path, version, n)
        sender.send(version)


def start(subject: Subject, path: Path, first: int, n: int, most: int = sys.maxsize) -> tuple[BaseProcess, Connection]:
    """Starts a process that saves; returns it and the connection that receives the saved versions."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    context: Any = multiprocessing.get_context(METHOD)
    process = context.Process(target=keep_saving, args=(subject, path, first, n, sender, most))
    process.start()
    sender.close()
    return process, receiver


def last_received(receiver: Connection) -> int | None:
    """The last version received so far, without waiting."""
    version = None
    try:
        while receiver.poll():
            version = int(receiver.recv())
    except EOFError:
        pass
    return version


def leftovers(path: Path) -> list[Path]:
    """Temporary files in the folder of a file, or in a folder dataset."""
    return [p for p in path.resolve().parent.rglob("*") if p.is_file() and p.suffix in (".part", ".tmp")]


def kill_once(subject: Subject, path: Path, last: int, n: int, wait: Callable[[], None]) -> tuple[int, bool]:
    """Kills a process that saves after its first save; returns the version found, and whether a write was interrupted.

    Raises:
        Exception: the file contains neither the last version nor the next.
    """
    process, receiver = start(subject, path, last + 1, n)
    saved = int(receiver.recv())
    wait()
    process.kill()
    process.join()
    saved = last_received(receiver) or saved
    found = KINDS[subject].read(path, n)
    if found not in (saved, saved + 1):
        raise ValueError(f"version {found} was found after version {saved} had been saved")
    longer = subject == "folder" and (path / "states.bin").stat().st_size > found * n * N_FACTORS
    return found, longer or bool(leftovers(path))


def wait_for_write(path: Path, most: float, delay: float) -> None:
    """Waits until there is a temporary file, at most ``most`` seconds, and then another ``delay`` seconds."""
    until = time.perf_counter() + most
    while time.perf_counter() < until and not leftovers(path):
        time.sleep(0.0005)
    time.sleep(delay)


def kill(subject: Subject, path: Path, kills: int, args: Args, console: Console) -> int:
    """Kills a subject ``kills`` times; returns how often something was lost."""
    rng, kind, lost, cut, linked = np.random.default_rng(args.seed), KINDS[subject], 0, 0, path.is_symlink()
    kind.write(path, 0, args.rows)
    began, last = time.perf_counter(), 1
    kind.write(path, last, args.rows)
    seconds = time.perf_counter() - began
    for i in track(range(kills), subject, console=console, disable=not console.is_terminal):
        wait = partial(time.sleep, rng.uniform(0, 1.5 * seconds))
        if i % 2:  # every second kill is timed to the writing of the file, which may be a small part of a save
            wait = partial(wait_for_write, path, 1.5 * seconds, rng.uniform(0, 0.02))
        try:
            last, interrupted = kill_once(subject, path, last, args.rows, wait)
            cut += interrupted
        except Exception as error:  # any error means a loss
            say(console, f"lost: {error!r}", "red")
            lost += 1
            remove(path.resolve())
            last = 0 if subject == "folder" else last + 1
            kind.write(path, last, args.rows)
    kind.write(path, last + 1, args.rows)
    left = leftovers(path)
    if kind.read(path, args.rows) != last + 1 or left or path.is_symlink() != linked:
        say(console, f"after one more save there is {left or 'another version'}, or the link is gone", "red")
        lost += 1
    summary = f"{subject}{' through a link' * linked}: {kills} kills, {cut} of them during a write, {seconds:.2f} s per save"
    say(console, f"{summary}: {lost} losses", "red" if lost else None)
    return lost


def say(console: Console, text: str, style: str | None = None) -> None:
    """Prints a line without markup."""
    console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


def remove(path: Path) -> None:
    """Removes a damaged file, or the files of a damaged folder."""
    for part in path.iterdir() if path.is_dir() else [path]:
        part.unlink(missing_ok=True)


def write_together(subject: Subject, folder: Path, args: Args, console: Console) -> int:
    """Two processes save at one path, and this one loads; returns how often that failed."""
    path, kind, failures, loads = folder / "together" / KINDS[subject].name, KINDS[subject], 0, 0
    kind.write(path, 0, args.rows)
    begins = (1, 1_000_001)
    writers = [start(subject, path, first, args.rows, most=args.kills) for first in begins]
    while any(process.is_alive() for process, _ in writers):
        try:
            found = kind.read(path, args.rows)
            if not any(first <= found < first + args.kills for first in begins) and found != 0:
                raise ValueError(f"version {found} was never saved")
            loads += 1
        except Exception as error:  # any error means that a reader failed
            say(console, f"failed: {error!r}", "red")
            failures += 1
    failures += sum(process.exitcode != 0 for process, _ in writers) + len(leftovers(path))
    summary = f"{subject}: two processes with {args.kills} saves each at one path, loaded {loads} times meanwhile"
    say(console, f"{summary}: {failures} failures", "red" if failures else None)
    return failures


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__.splitlines()[0])
    console = Console()
    if args.kills < 1 or args.rows < 1:
        say(console, "--kills and --rows must be at least 1.", "red")
        return 1
    # Processes are forked from a server, which must import the same package as this process does.
    os.environ |= {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONSAFEPATH": "1"}
    multiprocessing.set_forkserver_preload(["mbagent"])
    lost = 0
    with tempfile.TemporaryDirectory() as folder:
        for subject in args.subjects:
            own = Path(folder) / subject
            link = own / "link" / KINDS[subject].name
            for name in ("plain", "link", "target", "together"):
                (own / name).mkdir(parents=True)
            link.symlink_to(own / "target" / link.name, target_is_directory=subject == "folder")
            lost += kill(subject, own / "plain" / link.name, args.kills, args, console)
            lost += kill(subject, link, max(1, args.kills // 5), args, console)
            if subject != "folder":  # a folder dataset refuses a second writer
                lost += write_together(subject, own, args, console)
    say(console, f"{lost} losses." if lost else "Nothing was lost.", "red" if lost else "green")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
