"""Folders of results: nothing in them is lost by an interruption or by the next run."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from mbagent import files


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
