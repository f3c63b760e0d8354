"""The tables and pictures of the studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mbagent.evaluation.figures import Line, Panel, draw_panels
from mbagent.evaluation.report import Card, Page, Section, Table, format_number
from studies.model_accuracy.studies import STUDIES

Row: TypeAlias = Mapping[str, Any]
KEYS = {
    "changes": ("change", "steps after it"),
    "alarms": ("world", "steps"),
    "transfer": ("size",),
    "cost": ("d", "size"),
    "parents": ("world", "steps"),
    "trust": ("world", "steps", "bin"),
    "agents": ("game",),
    "minatar": ("game", "sticky", "history", "steps"),
}
"""Columns that identify the rows of a study; all others are measures."""


def averaged(study: str, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Means over seeds of each measure."""
    keys, found = [key for key in KEYS[study] if rows and key in rows[0]], []
    for label in dict.fromkeys(tuple(row[key] for key in keys) for row in rows):
        same = [row for row in rows if tuple(row[key] for key in keys) == label]
        figures = [name for name in same[0] if name not in keys]
        means = {name: _mean([row[name] for row in same]) for name in figures}
        found.append({**dict(zip(keys, label, strict=True)), **means, "seeds": len(same)})
    return found


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def shown(value: Any) -> str:
    """Formats a cell of a table."""
    if isinstance(value, float):
        return format_number(value, 4 if abs(value) < 10 else 1)
    return f"{value:,}" if isinstance(value, int) else str(value)


def slope(rows: Sequence[Row], name: str) -> float:
    """Exponent of d in a power law for a measure, by least squares on logarithms."""
    return float(np.polyfit(np.log([row["d"] for row in rows]), np.log([row[name] for row in rows]), 1)[0])


def write_page(path: Path, results: Mapping[str, Sequence[Row]], accuracy: Sequence[Row], command: str) -> dict[str, bytes]:
    """Writes the page with all results; returns its pictures by name."""
    tables = {study: averaged(study, rows) for study, rows in results.items() if rows}
    pictures = {study: draw(tables[study]) for study, draw in _PICTURES.items() if study in tables}
    sections = [_exact_states(accuracy)] if accuracy else []
    for study, rows in tables.items():
        title = (STUDIES[study].__doc__ or "").splitlines()[0]
        card = Card(figure=pictures.get(study), table=Table.of(rows, shown), notes=_exponents(rows) if study == "cost" else ())
        sections.append(Section(title, [card]))
    intro = "Models learn worlds from random play and are tested on new random play, on unseen layouts."
    Page("Models", "Accuracy of learned models", intro, sections, command, {}).write(path)
    return pictures


def _exact_states(accuracy: Sequence[Row]) -> Section:
    note = (
        "Means over seeds. Likeliest and sampled: share of transitions whose certain factors are all predicted correctly, "
        "without transitions to a new layout."
    )
    return Section("Exact next states", [Card(table=Table.of(accuracy, shown), notes=[note])])


def _exponents(rows: Sequence[Row]) -> list[str]:
    fit, draw = (format_number(slope(rows, name), 2) for name in ("fit seconds", "sample microseconds"))
    return [f"Exponents of d: fit {fit}, one sampled state {draw}."]


def draw_changes(rows: Sequence[Row]) -> bytes:
    """Exactness against steps after a change, one panel per change."""
    panels = []
    for name in dict.fromkeys(row["change"] for row in rows):
        mine = [row for row in rows if row["change"] == name]
        lines = [
            Line([row["steps after it"] for row in mine], [row[way] for row in mine], colour, way)
            for way, colour in (("continued", "#00798c"), ("from scratch", "#d1495b"))
        ]
        panels.append(Panel(name, lines, "steps after the change", y_limits=(0.0, 1.03)))
    return draw_panels(panels)


def draw_cost(rows: Sequence[Row]) -> bytes:
    """Times against d, on logarithmic scales."""
    d, panels = [row["d"] for row in rows], []
    for name in ("fit seconds", "sample microseconds"):
        times = [row[name] for row in rows]
        power = [times[0] * (n / d[0]) ** 1.2 for n in d]
        lines = [Line(d, times, "#00798c"), Line(d, power, "#9aa3ad", "d to the power of 1.2", marker="", style="--")]
        title, ticks = f"{name}: exponent {slope(rows, name):.2f}", {n: f"{n:g}" for n in d}
        panels.append(Panel(title, lines, "variables d", x_scale="log", y_scale="log", x_ticks=ticks))
    return draw_panels(panels)


def draw_trust(rows: Sequence[Row]) -> bytes:
    """Frequency of wrong predictions against its estimate."""
    lines = [Line([0, 1], [0, 1], "#9aa3ad", marker="", style="--")]
    for number, name in enumerate(dict.fromkeys(row["world"] for row in rows)):
        mine = sorted((row["estimate"], row["rate"]) for row in rows if row["world"] == name and row["bin"] != "all")
        estimates, rates = zip(*mine, strict=True)
        lines.append(Line(estimates, rates, f"C{number}", name))
    panel = Panel("", lines, "estimated probability of a wrong prediction", "observed share of wrong predictions")
    return draw_panels([panel], size=(4.4, 3.6))


_PICTURES = {"changes": draw_changes, "cost": draw_cost, "trust": draw_trust}
