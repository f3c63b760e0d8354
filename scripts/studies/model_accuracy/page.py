"""The tables and pictures that the studies end in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from mbagent.evaluation.report import FIGURE_STYLE, Card, Page, Section, Table, format_number, to_png
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
"""Columns that tell rows of a study apart; all others are figures."""


def averaged(study: str, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Means over seeds of each figure."""
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
    """A cell of a table."""
    if isinstance(value, float):
        return format_number(value, 4 if abs(value) < 10 else 1)
    return f"{value:,}" if isinstance(value, int) else str(value)


def slope(rows: Sequence[Row], name: str) -> float:
    """Exponent of a figure in d, by least squares in logarithms."""
    return float(np.polyfit(np.log([row["d"] for row in rows]), np.log([row[name] for row in rows]), 1)[0])


def write_page(path: Path, results: Mapping[str, Sequence[Row]], accuracy: Sequence[Row], command: str) -> dict[str, bytes]:
    """Writes the page with everything measured; returns its pictures by name."""
    tables = {study: averaged(study, rows) for study, rows in results.items() if rows}
    pictures = {study: draw(tables[study]) for study, draw in _PICTURES.items() if study in tables}
    sections = [_exact_states(accuracy)] if accuracy else []
    for study, rows in tables.items():
        title = (STUDIES[study].__doc__ or "").splitlines()[0]
        card = Card(figure=pictures.get(study), table=Table.of(rows, shown), notes=_exponents(rows) if study == "cost" else ())
        sections.append(Section(title, [card]))
    intro = "Models learn worlds from random play and are tested on new random play, on layouts that they have not seen."
    Page("Models", "How exactly models predict", intro, sections, command, {}).write(path)
    return pictures


def _exact_states(accuracy: Sequence[Row]) -> Section:
    note = (
        "Means over seeds. Likeliest and sampled: share of transitions whose certain factors are all predicted; transitions to a "
        "new layout do not count."
    )
    return Section("Exact next states", [Card(table=Table.of(accuracy, shown), notes=[note])])


def _exponents(rows: Sequence[Row]) -> list[str]:
    fit, draw = (format_number(slope(rows, name), 2) for name in ("fit seconds", "sample microseconds"))
    return [f"Exponents of d: fit {fit}, one sampled state {draw}."]


def draw_changes(rows: Sequence[Row]) -> bytes:
    """Exactness against steps after a change, one panel a change."""
    names = list(dict.fromkeys(row["change"] for row in rows))
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(3.6 * len(names), 3.0), layout="constrained")
        for axes, name in zip(figure.subplots(1, len(names), squeeze=False).flat, names, strict=True):
            mine = [row for row in rows if row["change"] == name]
            for way, colour in (("continued", "#00798c"), ("from scratch", "#d1495b")):
                axes.plot([row["steps after it"] for row in mine], [row[way] for row in mine], "o-", color=colour, label=way)
            axes.set_title(name, loc="left")
            axes.set_xlabel("steps after the change")
            axes.set_ylim(0.0, 1.03)
        axes.legend(frameon=False, loc="lower right")
        return to_png(figure)


def draw_cost(rows: Sequence[Row]) -> bytes:
    """Times against d, both on logarithmic scales."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        for axes, name in zip(figure.subplots(1, 2), ("fit seconds", "sample microseconds"), strict=True):
            d, times = (np.array([row[key] for row in rows], dtype=np.float64) for key in ("d", name))
            axes.loglog(d, times, "o-", color="#00798c")
            axes.loglog(d, times[0] * (d / d[0]) ** 1.2, "--", color="#9aa3ad", label="d to the power of 1.2")
            axes.xaxis.set_major_locator(FixedLocator(list(d)))
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set_title(f"{name}: exponent {slope(rows, name):.2f}", loc="left")
            axes.set_xlabel("variables d")
            axes.legend(frameon=False)
        return to_png(figure)


def draw_trust(rows: Sequence[Row]) -> bytes:
    """How often predictions were wrong against the estimate of it."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(4.4, 3.6), layout="constrained")
        axes: Axes = figure.subplots()
        for name in dict.fromkeys(row["world"] for row in rows):
            mine = sorted((row["estimate"], row["rate"]) for row in rows if row["world"] == name and row["bin"] != "all")
            axes.plot(*zip(*mine, strict=True), "o-", label=name, markersize=4)
        axes.plot([0, 1], [0, 1], "--", color="#9aa3ad")
        axes.set_xlabel("estimated probability of a wrong prediction")
        axes.set_ylabel("share that was wrong")
        axes.legend(frameon=False, fontsize=8)
        return to_png(figure)


_PICTURES = {"changes": draw_changes, "cost": draw_cost, "trust": draw_trust}
