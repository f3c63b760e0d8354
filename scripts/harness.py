"""What all studies share: folders of results that no later run overwrites, parallel processes, and the display of progress."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from joblib import Parallel, delayed
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mbagent import files

Task = TypeVar("Task")
Result = TypeVar("Result")


def set_aside(folder: Path) -> Path | None:
    """Moves the results of an earlier run in ``folder`` to a folder of their own inside it; None where there are none."""
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


def check_run(folder: Path, workers: int = 1) -> None:
    """Refuses what no run can begin with.

    Raises:
        ValueError: the folder of results is a file, or there are no processes to work.
    """
    if workers < 1:
        raise ValueError(f"--workers must be at least 1 process, got {workers}.")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--output must be a folder, and {folder} is a file.")


def open_folder(folder: Path, console: Console) -> None:
    """Makes a folder ready for a run; says where the results of an earlier one have gone."""
    folder.mkdir(parents=True, exist_ok=True)
    if moved := set_aside(folder):
        console.print(f"Moved earlier results to {moved}.", highlight=False, markup=False, soft_wrap=True)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Writes a csv with a line for each row; all rows have the keys ``columns``, or those of the first."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    files.write(path, text.getvalue())


def run_all(
    work: Callable[[Task], Result], tasks: Iterable[Task], *, workers: int, console: Console, name: Callable[[Result], str]
) -> Iterator[Result]:
    """Results in the order in which they are done.

    Args:
        work: does one task; runs in a process of its own unless ``workers`` is 1.
        tasks: what to do.
        workers: number of processes.
        console: a bar in a terminal, a line for each result elsewhere.
        name: what to show of a result.
    """
    todo = list(tasks)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    start = time.perf_counter()
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("", total=len(todo))
        run = Parallel(n_jobs=workers, return_as="generator_unordered")
        for done, result in enumerate(run(delayed(work)(task) for task in todo), start=1):
            progress.update(bar, advance=1, description=name(result))
            if not console.is_terminal:
                elapsed = "{:d}:{:02d}".format(*divmod(int(time.perf_counter() - start), 60))
                console.print(f"{elapsed} {done} of {len(todo)}: {name(result)}", highlight=False, soft_wrap=True)
            yield result
