"""Results of the experiment on disk, from which the page can be rewritten without new measurements."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias, get_type_hints
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from harness import Result
from mbagent import files
from studies.sampling_accuracy.experiment import Cell, Settings
from studies.sampling_accuracy.samplers import FitOptions
from studies.sampling_accuracy.scores import Score
from studies.sampling_accuracy.trials import find_trial

Points: TypeAlias = dict[tuple[str, str], NDArray[np.float64]]
"""(trial, sampler) -> pairs (observed, inferred) [M, 2] of one data set."""

MOST_POINTS = 4000


def first_points(results: Sequence[Result[Cell]]) -> Points:
    """The points of each trial's first data set, thinned out if there are too many to plot."""
    points: Points = {}
    for result in sorted(results, key=lambda result: result.cell.seed, reverse=True):
        for sampler, pairs in result.arrays.items():
            points[result.cell.trial, sampler] = pairs[:: max(1, len(pairs) // MOST_POINTS)]
    return points


def save_points(path: Path, points: Points) -> None:
    """Writes points as ``.npz``."""
    with files.replaced(path) as file:
        files.write_arrays(file, {"|".join(key): value for key, value in points.items()}, compressed=True)


def load_points(path: Path) -> Points:
    """Reads a file of ``save_points``; empty if there is no such file.

    Raises:
        ValueError: the file is damaged.
    """
    if not path.exists():
        return {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            pairs = {name: archive[name] for name in archive}
    except (OSError, EOFError, ValueError, BadZipFile) as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it, or measure again without --resume.") from error
    return {(name.partition("|")[0], name.partition("|")[2]): value for name, value in pairs.items()}


def load_scores(path: Path) -> list[Score]:
    """Reads a table of scores; empty if there is no such file.

    Raises:
        ValueError: the file is damaged; the message names the line.
    """
    if not path.exists():
        return []
    kinds = get_type_hints(Score)
    readers = {name: {int: int, float: float}.get(kind, str) for name, kind in kinds.items()}
    scores: list[Score] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if set(row) != set(readers) or None in row.values():
                    raise ValueError("its columns are not those of a score")
                scores.append(Score(**{name: readers[name](value) for name, value in row.items()}))
                find_trial(scores[-1].trial)
    except ValueError as error:
        line = len(scores) + 2
        raise ValueError(f"{path} cannot be read (line {line}: {error}); repair or delete it, or measure again.") from error
    return scores


def save_settings(path: Path, settings: Settings) -> None:
    """Writes the settings as JSON."""
    files.write(path, json.dumps(asdict(settings), indent=1))


def load_settings(path: Path) -> Settings:
    """Reads a file of ``save_settings``.

    Raises:
        ValueError: there is no such file, or it is damaged.
    """
    if not path.exists():
        raise ValueError(f"There are no results in {path.parent}: measure first.")
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        given: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in kept.items()}
        return Settings(**{**given, "fit": FitOptions(**kept["fit"])})
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} cannot be read ({error}); measure again without --resume.") from error
