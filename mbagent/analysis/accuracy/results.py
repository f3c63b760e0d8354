"""What an experiment leaves on disk, so that the page can be written again without measuring again."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TypeAlias, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mbagent.analysis.accuracy.experiment import Outcome
from mbagent.analysis.accuracy.scores import Score

Points: TypeAlias = dict[tuple[str, str], NDArray[np.float64]]
"""(trial, sampler) -> pairs (observed, inferred) [M, 2] of one data set."""

MOST_POINTS = 4000


def first_points(outcomes: Sequence[Outcome]) -> Points:
    """The points of each trial's first data set, thinned out where they are too many to draw."""
    points: Points = {}
    for outcome in sorted(outcomes, key=lambda o: o.task.seed, reverse=True):
        for sampler, pairs in outcome.points.items():
            points[outcome.task.trial, sampler] = pairs[:: max(1, len(pairs) // MOST_POINTS)]
    return points


def save_points(path: Path, points: Points) -> None:
    """Writes points as ``.npz``."""
    np.savez_compressed(path, allow_pickle=False, **{"|".join(key): value for key, value in points.items()})


def load_points(path: Path) -> Points:
    """Reads what ``save_points`` wrote; nothing where there is no such file."""
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as archive:
        pairs = {name: archive[name] for name in archive}
    return {(name.partition("|")[0], name.partition("|")[2]): value for name, value in pairs.items()}


def save_scores(path: Path, scores: Sequence[Score]) -> None:
    """Writes a csv with a line for each sampler and data set."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Score)])
        writer.writeheader()
        writer.writerows(asdict(score) for score in scores)


def load_scores(path: Path) -> list[Score]:
    """Reads what ``save_scores`` wrote; nothing where there is no such file."""
    if not path.exists():
        return []
    kinds = get_type_hints(Score)
    readers = {name: {int: int, float: float}.get(kind, str) for name, kind in kinds.items()}
    with path.open(newline="", encoding="utf-8") as file:
        return [Score(**{name: readers[name](value) for name, value in row.items()}) for row in csv.DictReader(file)]
