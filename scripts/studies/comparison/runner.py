"""Runs jobs in parallel processes, shows how far each is, and keeps what is done on disk."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from joblib import Parallel, delayed
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mbagent import files
from studies.comparison.jobs import Job, run_job
from studies.comparison.records import Record, read_records, write_records

_HEARTBEAT_SECONDS = 30.0


class JobsFailedError(RuntimeError):
    """Some jobs failed; what the others left is kept."""


@dataclass(frozen=True)
class _Outcome:
    job: Job
    records: list[Record]
    seconds: float
    error: str = ""


def run_jobs(jobs: Sequence[Job], folder: Path, *, workers: int, console: Console) -> list[Record]:
    """Runs all jobs whose records are not in ``folder`` yet, and returns the records of all.

    Args:
        jobs: what to do, the longest first.
        folder: where each job's records go as soon as it is done.
        workers: number of processes; 1 runs the jobs in this one.
        console: where progress is shown.

    Raises:
        JobsFailedError: jobs raised; the others were finished first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("*.progress"):
        stale.unlink()
    records = [r for job in jobs if _path(folder, job).exists() for r in read_records(_path(folder, job))]
    waiting = [job for job in jobs if not _path(folder, job).exists()]
    failures: list[_Outcome] = []
    board = _Board(folder, len(jobs), len(jobs) - len(waiting))
    with _shown(board, console):
        run = Parallel(n_jobs=workers, return_as="generator_unordered")
        for outcome in run(delayed(_work)(job, folder) for job in waiting):
            board.done += 1
            records.extend(outcome.records)
            if outcome.error:
                failures.append(outcome)
                reason = outcome.error.strip().splitlines()[-1]
                line = f"failed  {outcome.job.name}: {reason}"
                console.print(line, style="red", highlight=False, markup=False, soft_wrap=True)
            else:
                console.print(_line(board, outcome), highlight=False, soft_wrap=True)
    if failures:
        log = folder / "errors.log"
        files.write(log, "\n".join(f"{o.job.name}\n{o.error}" for o in failures))
        told = "\n".join(f"  {o.job.name}: {o.error.strip().splitlines()[-1]}" for o in failures)
        raise JobsFailedError(f"{len(failures)} of {len(jobs)} jobs failed; tracebacks are in {log}.\n{told}")
    return records


def _path(folder: Path, job: Job) -> Path:
    return folder / job.file_name


def _work(job: Job, folder: Path) -> _Outcome:
    """Runs one job in a worker process; its progress goes through a small file."""
    path = _path(folder, job)
    progress = path.with_suffix(".progress")
    start = time.perf_counter()
    progress.write_text(f"0 {job.name}", encoding="utf-8")
    told = start

    def report(share: float) -> None:
        nonlocal told
        now = time.perf_counter()
        if now - told > 0.5:
            told = now
            progress.write_text(f"{share:.3f} {job.name}", encoding="utf-8")

    try:
        records = run_job(job, report)
        write_records(path, records)
    except Exception:
        return _Outcome(job, [], time.perf_counter() - start, traceback.format_exc())
    finally:
        progress.unlink(missing_ok=True)
    return _Outcome(job, records, time.perf_counter() - start)


def _line(board: _Board, outcome: _Outcome) -> str:
    means = [f"{r.mean:.2f}" for r in outcome.records if r.goal == "default"]
    scored = f", mean return {means[0]}" if means else ""
    return f"[{board.done:>3}/{board.total}] {outcome.job.name}{scored} ({outcome.seconds:.0f} s)".replace("[", r"\[", 1)


class _Board:
    """What is going on: a bar over all jobs and one for each running job."""

    def __init__(self, folder: Path, total: int, done: int) -> None:
        self.folder = folder
        self.total = total
        self.done = done
        self.start = time.perf_counter()

    def running(self) -> list[tuple[float, str]]:
        """(share done, name) of each running job."""
        found = []
        for path in sorted(self.folder.glob("*.progress")):
            with contextlib.suppress(OSError, ValueError):  # it may end, or be half written, just now
                share, name = path.read_text(encoding="utf-8").split(" ", 1)
                found.append((float(share), name))
        return found

    @property
    def elapsed(self) -> str:
        """Minutes and seconds since the start."""
        return "{:d}:{:02d}".format(*divmod(int(time.perf_counter() - self.start), 60))

    def render(self) -> Group:
        """The board for a terminal."""
        table = Table.grid(padding=(0, 1))
        for share, name in self.running():
            table.add_row("  ", ProgressBar(total=1.0, completed=share, width=24), f"{share:>4.0%}", name)
        bar = ProgressBar(total=max(self.total, 1), completed=self.done, width=40)
        head = Table.grid(padding=(0, 1))
        head.add_row(bar, Text(f"{self.done} of {self.total} jobs, {self.elapsed} since the start"))
        return Group(head, table)


@contextlib.contextmanager
def _shown(board: _Board, console: Console) -> Iterator[None]:
    """Shows the board live in a terminal, or as a line now and then where there is none."""
    if console.is_terminal:
        with Live(get_renderable=board.render, console=console, refresh_per_second=2, transient=True):
            yield
        return
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(_HEARTBEAT_SECONDS):
            now = "; ".join(f"{name} {share:.0%}" for share, name in board.running())
            line = f"... {board.elapsed}, {board.done} of {board.total} jobs done; {now}"
            console.print(line, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
