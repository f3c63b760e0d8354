"""The table of results that the documentation shows."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mbagent.evaluation.report import format_number
from mbagent.evaluation.statistics import interquartile_mean
from studies.external.experiment import AGENTS, OURS
from worlds.environments import WORLDS


def markdown_table(paths: Sequence[Path]) -> str:
    """From files of rows as ``run_task`` makes them; where a world and an agent are in several, the last one counts.

    Normalised return as interquartile mean over trainings; where the optimum is not known, the share of episodes with a return
    above 0; seconds and milliseconds as medians, as the first training compiles and a single one may plan in another way.
    """
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            new: dict[tuple[str, str], list[dict[str, str]]] = {}
            for row in csv.DictReader(file):
                new.setdefault((row["world"], row["agent"]), []).append(row)
        found |= new
    agents = [agent for agent in AGENTS if any(agent == other for _, other in found)]
    lines = ["| | " + " | ".join([*agents, "learning, s", "decision, ms"]) + " |", "| --- |" + " ---: |" * (len(agents) + 2)]
    for world in WORLDS:
        groups = {agent: found.get((world.name, agent), []) for agent in agents}
        if any(groups.values()):
            ours = [_median(groups.get(OURS, []), name, digits) for name, digits in (("learn_seconds", 1), ("milliseconds", 2))]
            lines.append(f"| {world.name} | " + " | ".join([*(_score(group) for group in groups.values()), *ours]) + " |")
    return "\n".join(lines)


def _score(rows: Sequence[dict[str, str]]) -> str:
    if not rows:
        return "–"
    values = np.array([float(row["normalised"]) for row in rows])
    if np.isfinite(values).all():
        return format_number(float(interquartile_mean(values)), 3)
    return f"{100 * np.mean([float(row['positive']) for row in rows]):.3g}%"


def _median(rows: Sequence[dict[str, str]], name: str, digits: int) -> str:
    return format_number(float(np.median([float(row[name]) for row in rows])), digits) if rows else "–"
