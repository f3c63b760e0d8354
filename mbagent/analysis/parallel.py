"""Independent pieces of work in parallel processes, with a line or a bar that shows how far they are."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from joblib import Parallel, delayed
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

Task = TypeVar("Task")
Result = TypeVar("Result")


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
