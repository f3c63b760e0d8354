"""Folders of results: nothing in them is lost by an interruption or by the next run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when all is written: an interruption loses nothing."""
    temporary = path.with_name(path.name + ".part")
    yield temporary
    temporary.replace(path)


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
