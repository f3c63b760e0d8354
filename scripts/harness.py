"""Common code of all studies.

A study is a list of cells, each of which yields rows of tables: ``run_cells`` runs them in parallel processes, saves the tables
as csv files and shows progress. ``run_command`` is the command line: options, error messages, the folder of results.
"""

from __future__ import annotations

import contextlib
import csv
import io
import shlex
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

import tyro
from joblib import Parallel, delayed
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mbagent import files

Row: TypeAlias = dict[str, Any]
"""A row of a table: names, seeds and numbers by column."""

Tables: TypeAlias = dict[str, list[Row]]
"""Rows by the name of their table."""

Cell = TypeVar("Cell")
Outcome = TypeVar("Outcome")
Known = TypeVar("Known")

_HEARTBEAT_SECONDS = 30.0


class Options(Protocol):
    """Options of a command that writes to a folder; ``workers`` is optional."""

    @property
    def output(self) -> Path:
        """Folder of the results."""
        ...


Args = TypeVar("Args", bound=Options)
Plan = TypeVar("Plan")


@dataclass(frozen=True)
class Result(Generic[Cell]):
    """Result of a cell.

    Attributes:
        cell: the cell.
        tables: rows by the name of their table; all rows of a table have the same columns.
        label: text shown when the cell is done.
        arrays: data for pictures that is not in the tables.
    """

    cell: Cell
    tables: Tables
    label: str
    arrays: dict[Any, Any] = field(default_factory=dict)

    @property
    def rows(self) -> list[Row]:
        """Rows of the first table."""
        return next(iter(self.tables.values()))


@dataclass(frozen=True)
class Run:
    """One run of a command.

    Attributes:
        folder: folder of the results.
        workers: number of processes, each with one thread.
        console: console for progress.
        command: the command line that reproduces the results.
    """

    folder: Path
    workers: int
    console: Console
    command: str

    def say(self, text: str) -> None:
        """Prints a line of plain text."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def refuse(self, error: Exception) -> None:
        """Prints the reason why the run is refused."""
        self.console.print(f"{error}", style="red", highlight=False, markup=False, soft_wrap=True)

    def write(self, tables: Tables) -> None:
        """Writes each table that has rows as a csv file."""
        for name, rows in tables.items():
            if rows:
                write_csv(self.folder / f"{name.replace(' ', '_')}.csv", rows)

    def write_pictures(self, pictures: Mapping[str, bytes]) -> None:
        """Writes pictures, given as PNG bytes by name."""
        for name, png in pictures.items():
            files.write(self.folder / f"{name}.png", png)

    def show(self, title: str, columns: Iterable[str], rows: Iterable[Sequence[str]], width: int = 0) -> None:
        """Prints a table, at least ``width`` characters wide."""
        table = Table(*columns, title=title)
        for row in rows:
            table.add_row(*row)
        (Console(width=width) if width > self.console.width else self.console).print(table)


def run_command(
    script: str,
    description: str | None,
    args_type: type[Args],
    prepare: Callable[[Args, Run], Plan],
    execute: Callable[[Args, Plan, Run], None],
    argv: Sequence[str] | None = None,
    *,
    opens: bool = True,
) -> int:
    """Runs a command line and returns its exit code.

    Args:
        script: name of the file, without its extension.
        description: its docstring, whose first line ``--help`` shows.
        args_type: dataclass of the options.
        prepare: returns the work to do; raises ValueError, with a message for the user, if there is none, or CellsFailedError.
        execute: does the work.
        argv: the options; None for those of this process.
        opens: whether the folder is emptied for the run by moving earlier results to a subfolder.
    """
    args = tyro.cli(args_type, args=argv, description=(description or "").splitlines()[0])
    given = sys.argv[1:] if argv is None else argv
    command = shlex.join(["python", f"scripts/{script}.py", *given])
    run = Run(args.output, getattr(args, "workers", 1), Console(), command)
    try:
        check_run(run.folder, run.workers)
        plan = prepare(args, run)
    except (ValueError, CellsFailedError) as error:
        run.refuse(error)
        return 1
    if opens:
        open_folder(run.folder, run.console)
    execute(args, plan, run)
    return 0


def run_cells(
    work: Callable[[Cell], Result[Cell]],
    cells: Iterable[Cell],
    run: Run,
    *,
    kept: Tables | None = None,
    order: Callable[[Cell], Any] | None = None,
    each: Callable[[list[Result[Cell]]], None] | None = None,
) -> list[Result[Cell]]:
    """Runs cells in parallel and saves all tables after each.

    Args:
        work: runs one cell, in a separate process.
        cells: the cells to run.
        run: the run whose folder gets the tables.
        kept: rows of an earlier run, placed before the new ones.
        order: sort key of the new rows; None for the order of completion.
        each: called after each cell with all results so far.

    Returns:
        The results in the order of completion.
    """
    results: list[Result[Cell]] = []
    for result in run_all(work, cells, workers=run.workers, console=run.console, name=lambda result: result.label):
        results.append(result)
        whole = joined(results if order is None else sorted(results, key=lambda result: order(result.cell)), kept)
        run.write({name: whole[name] for name in result.tables})
        if each is not None:
            each(results)
    return results


def joined(results: Iterable[Result[Any]], kept: Tables | None = None) -> Tables:
    """Rows of all results by table, after those in ``kept``."""
    tables: Tables = {name: list(rows) for name, rows in (kept or {}).items()}
    for result in results:
        for name, rows in result.tables.items():
            tables.setdefault(name, []).extend(rows)
    return tables


def run_all(
    work: Callable[[Cell], Outcome], cells: Iterable[Cell], *, workers: int, console: Console, name: Callable[[Outcome], str]
) -> Iterator[Outcome]:
    """Yields outcomes in the order of completion.

    Args:
        work: runs one cell, in a separate process unless ``workers`` is 1.
        cells: the cells to run.
        workers: number of processes.
        console: shows a progress bar in a terminal, otherwise one line per outcome.
        name: text shown for an outcome.
    """
    todo = list(cells)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    start = time.perf_counter()
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("", total=len(todo))
        run = Parallel(n_jobs=workers, return_as="generator_unordered")
        for done, outcome in enumerate(run(delayed(work)(cell) for cell in todo), start=1):
            progress.update(bar, advance=1, description=name(outcome))
            if not console.is_terminal:
                elapsed = "{:d}:{:02d}".format(*divmod(int(time.perf_counter() - start), 60))
                console.print(f"{elapsed} {done} of {len(todo)}: {name(outcome)}", highlight=False, soft_wrap=True)
            yield outcome


class CellsFailedError(RuntimeError):
    """Some cells failed; the results of the others are saved."""


class Recorded(Protocol):
    """A cell whose outcome is saved in a separate file."""

    @property
    def name(self) -> str:
        """Name shown in progress messages."""
        ...

    @property
    def file_name(self) -> str:
        """File name in the folder of records."""
        ...


Job = TypeVar("Job", bound=Recorded)


@dataclass(frozen=True)
class Recorder(Generic[Job, Outcome]):
    """Functions that run cells with records.

    Attributes:
        work: runs a cell, and regularly calls its second argument with the share done, 0 ... 1.
        write: saves the outcomes of a cell atomically.
        read: reads the files of ``write``.
        shown: summary of the outcomes for progress messages.
    """

    work: Callable[[Job, Callable[[float], None]], list[Outcome]]
    write: Callable[[Path, Sequence[Outcome]], None]
    read: Callable[[Path], list[Outcome]]
    shown: Callable[[Sequence[Outcome]], str]


@dataclass(frozen=True)
class _Done(Generic[Job, Outcome]):
    job: Job
    outcomes: list[Outcome]
    seconds: float
    error: str = ""


def run_recorded(
    recorder: Recorder[Job, Outcome], jobs: Sequence[Job], folder: Path, *, workers: int, console: Console
) -> list[Outcome]:
    """Runs all cells without records in ``folder``, and returns the outcomes of all cells.

    Args:
        recorder: functions that run, write and read.
        jobs: the cells, longest first.
        folder: folder in which each cell's records are saved as soon as it is done.
        workers: number of processes; 1 runs the cells in this one.
        console: console for progress.

    Raises:
        CellsFailedError: some cells raised an exception; the others were completed first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("*.progress"):
        stale.unlink()
    outcomes = [found for job in jobs if (folder / job.file_name).exists() for found in recorder.read(folder / job.file_name)]
    waiting = [job for job in jobs if not (folder / job.file_name).exists()]
    failures: list[_Done[Job, Outcome]] = []
    board = _Board(folder, len(jobs), len(jobs) - len(waiting))
    with _shown(board, console):
        run = Parallel(n_jobs=workers, return_as="generator_unordered")
        for done in run(delayed(_record)(recorder, job, folder) for job in waiting):
            board.done += 1
            outcomes.extend(done.outcomes)
            if done.error:
                failures.append(done)
                line = f"failed  {done.job.name}: {done.error.strip().splitlines()[-1]}"
                console.print(line, style="red", highlight=False, markup=False, soft_wrap=True)
            else:
                line = f"[{board.done:>3}/{board.total}] {done.job.name}{recorder.shown(done.outcomes)} ({done.seconds:.0f} s)"
                console.print(line, highlight=False, markup=False, soft_wrap=True)
    if failures:
        log = folder / "errors.log"
        files.write(log, "\n".join(f"{failed.job.name}\n{failed.error}" for failed in failures))
        reasons = "\n".join(f"  {failed.job.name}: {failed.error.strip().splitlines()[-1]}" for failed in failures)
        raise CellsFailedError(f"{len(failures)} of {len(jobs)} jobs failed; tracebacks are in {log}.\n{reasons}")
    return outcomes


def _record(recorder: Recorder[Job, Outcome], job: Job, folder: Path) -> _Done[Job, Outcome]:
    """Runs one cell in a worker process, which reports progress through a small file."""
    path = folder / job.file_name
    progress = path.with_suffix(".progress")
    start = time.perf_counter()
    progress.write_text(f"0 {job.name}", encoding="utf-8")
    last = start

    def report(share: float) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last > 0.5:
            last = now
            progress.write_text(f"{share:.3f} {job.name}", encoding="utf-8")

    try:
        outcomes = recorder.work(job, report)
        recorder.write(path, outcomes)
    except Exception:
        return _Done(job, [], time.perf_counter() - start, traceback.format_exc())
    finally:
        progress.unlink(missing_ok=True)
    return _Done(job, outcomes, time.perf_counter() - start)


class _Board:
    """Progress display: one bar for all jobs and one for each running job."""

    def __init__(self, folder: Path, total: int, done: int) -> None:
        self.folder = folder
        self.total = total
        self.done = done
        self.start = time.perf_counter()

    def running(self) -> list[tuple[float, str]]:
        """(share done, name) of each running job."""
        found = []
        for path in sorted(self.folder.glob("*.progress")):
            with contextlib.suppress(OSError, ValueError):  # the file may be deleted or incomplete at this moment
                share, name = path.read_text(encoding="utf-8").split(" ", 1)
                found.append((float(share), name))
        return found

    @property
    def elapsed(self) -> str:
        """Minutes and seconds since the start."""
        return "{:d}:{:02d}".format(*divmod(int(time.perf_counter() - self.start), 60))

    def render(self) -> Group:
        """Renders the board for a terminal."""
        table = Table.grid(padding=(0, 1))
        for share, name in self.running():
            table.add_row("  ", ProgressBar(total=1.0, completed=share, width=24), f"{share:>4.0%}", name)
        bar = ProgressBar(total=max(self.total, 1), completed=self.done, width=40)
        head = Table.grid(padding=(0, 1))
        head.add_row(bar, Text(f"{self.done} of {self.total} jobs, {self.elapsed} since the start"))
        return Group(head, table)


@contextlib.contextmanager
def _shown(board: _Board, console: Console) -> Iterator[None]:
    """Shows the board live in a terminal; without a terminal, prints a line from time to time."""
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


def grouped(rows: Iterable[Row], keys: Sequence[str]) -> dict[tuple[Any, ...], list[Row]]:
    """Groups rows by their values in some columns, in order of first occurrence."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def find(kind: str, name: str, known: Mapping[str, Known]) -> Known:
    """The entry called ``name``.

    Raises:
        ValueError: there is none; the message lists the known names.
    """
    check_known(kind, [name], known)
    return known[name]


def check_known(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuses unknown names.

    Raises:
        ValueError: for the first unknown name; the message lists the known ones, quoted if one has spaces.
    """
    listed = list(known)
    for name in names:
        if name not in listed:
            shown = map(repr, listed) if any(" " in other for other in listed) else listed
            raise ValueError(f"There is no {kind} {name!r}; choose from {', '.join(shown)}.")


def check_at_least(given: object, **least: int) -> None:
    """Refuses numbers that are too small.

    Args:
        given: settings.
        **least: smallest allowed value of each named attribute.

    Raises:
        ValueError: an attribute is smaller.
    """
    for name, bound in least.items():
        if (value := getattr(given, name)) < bound:
            raise ValueError(f"{name} must be at least {bound}, got {value}.")


def check_run(folder: Path, workers: int = 1) -> None:
    """Refuses options with which no run can start.

    Raises:
        ValueError: the folder of results is a file, or the number of processes is below 1.
    """
    if workers < 1:
        raise ValueError(f"--workers must be at least 1 process, got {workers}.")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--output must be a folder, and {folder} is a file.")


def open_folder(folder: Path, console: Console) -> None:
    """Prepares a folder for a run; prints where results of an earlier run were moved."""
    folder.mkdir(parents=True, exist_ok=True)
    if moved := set_aside(folder):
        console.print(f"Moved earlier results to {moved}.", highlight=False, markup=False, soft_wrap=True)


def set_aside(folder: Path) -> Path | None:
    """Moves the results of an earlier run in ``folder`` to a subfolder and returns it; None if there are none."""
    old = [path for path in sorted(folder.iterdir()) if path.is_file()]
    if not old:
        return None
    n = 1
    while (folder / f"earlier-{n}").exists():
        n += 1
    target = folder / f"earlier-{n}"
    target.mkdir()
    for path in old:
        path.rename(target / path.name)
    return target


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Writes a csv file with one line per row; all rows have the keys ``columns``, or those of the first row."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    files.write(path, text.getvalue())
