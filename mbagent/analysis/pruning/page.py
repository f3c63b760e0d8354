"""The curves, the figures 11 and 12 of the paper, and the page that the experiment ends in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mbagent.analysis.cases import find_case
from mbagent.analysis.pages import FIGURE_STYLE, render, to_png
from mbagent.analysis.pruning.experiment import Outcome, Row, Settings

CURVES: dict[str, str] = {
    "returned": "normalised return",
    "marginal": "error of single variables (total variation)",
    "log_likelihood": "nats a transition lost",
    "connections": "connections left",
    "full": "µs for a next state, full sweep",
    "parents": "parents of a variable",
}
"""Fields of a row that are drawn against the pruned fraction."""

COLUMNS: dict[str, tuple[str, int]] = {
    "connections": ("Connections", 0),
    "returned": ("Normalised return", 3),
    "log_likelihood": ("Nats lost", 4),
    "marginal": ("Error of single variables", 5),
    "full": ("µs, full sweep", 2),
    "short": ("µs, as used", 2),
    "parents": ("Parents", 1),
    "precision": ("Precision", 3),
    "recall": ("Recall", 3),
    "conditions_precision": ("of next variables: precision", 3),
    "conditions_recall": ("recall", 3),
}
"""Fields of a row in the table: title and digits."""


@dataclass(frozen=True)
class Section:
    """One game on the page.

    Attributes:
        title: of the game.
        seeds: number of repetitions.
        rows: for each share: the share and the means over seeds, by field.
        curves: picture of the curves.
        maps: (caption, picture) of the sums over paths, from the first seed.
        modules, groups: of the share that the last map shows.
        shown: that share.
    """

    title: str
    seeds: int
    rows: list[tuple[float, dict[str, float]]]
    curves: bytes
    maps: list[tuple[str, bytes]]
    modules: list[str]
    groups: list[str]
    shown: float


def means(rows: Sequence[Row]) -> list[tuple[float, dict[str, float]]]:
    """Means over seeds for each share; nan where it was not measured."""
    result = []
    for fraction in sorted({row.fraction for row in rows}):
        mine = [row for row in rows if row.fraction == fraction]
        result.append((fraction, {name: float(np.mean([getattr(row, name) for row in mine])) for name in COLUMNS}))
    return result


def write_page(path: Path, outcomes: Sequence[Outcome], settings: Settings, command: str) -> dict[str, bytes]:
    """Writes the HTML page, pictures and all, into one file; returns the pictures as PNG by name."""
    sections, pictures = [], {}
    for game in settings.games:
        mine = sorted((o for o in outcomes if o.task.game == game), key=lambda o: o.task.seed)
        if not mine:
            continue
        section = section_of(mine)
        sections.append(section)
        pictures[f"{game}_curves"] = section.curves
        pictures |= {f"{game}_paths_{number}": png for number, (_, png) in enumerate(section.maps)}
    page = render("pruning.html.jinja", sections=sections, columns=COLUMNS, settings=settings, command=command)
    path.write_text(page, encoding="utf-8")
    return pictures


def section_of(outcomes: Sequence[Outcome]) -> Section:
    """What the page says about one game."""
    rows, first = means([row for outcome in outcomes for row in outcome.rows]), outcomes[0]
    shown = max((f for f in first.influences if f <= 0.99), default=0.0)
    maps = []
    for fraction in sorted({min(first.influences), min((f for f in first.influences if f >= 0.9), default=shown), shown}):
        caption = f"{fraction:.0%} of the connections removed" if fraction else "Before pruning"
        maps.append((caption, draw_paths(first, fraction)))
    title = find_case(first.task.game).title
    return Section(title, len(outcomes), rows, draw_curves(rows), maps, first.modules[shown], first.groups[shown], shown)


def draw_curves(rows: Sequence[tuple[float, dict[str, float]]]) -> bytes:
    """Everything against the pruned fraction."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(10, 4.8), layout="constrained")
        for axes, (name, label) in zip(figure.subplots(2, 3).flat, CURVES.items(), strict=True):
            values = [cells[name] for _, cells in rows]
            axes.plot(range(len(rows)), values, color="#0b6e4f", marker="o", markersize=4)
            axes.set_xticks(range(len(rows)), [f"{fraction:.0%}" for fraction, _ in rows])
            axes.set_title(label, loc="left")
            if name in ("connections", "log_likelihood", "full") and min(values) > 0:
                axes.set_yscale("log")
            axes.set_xlabel("pruned")
        return to_png(figure)


def draw_paths(outcome: Outcome, fraction: float) -> bytes:
    """The paper's figures 11 and 12: sums of absolute weights over paths, from inputs (x) to outputs (y); darker is more."""
    found, names = outcome.influences[fraction], [short(name) for name in outcome.names]
    parts = (
        (
            "predictor: state and action → next state",
            np.concatenate([found.states, found.actions], axis=1),
            [*names, *outcome.actions],
        ),
        ("conditioner: other next variables → next state", found.others, [*names, "end"]),
    )
    with mpl.rc_context(FIGURE_STYLE):
        size = max(6.0, 0.085 * len(names))
        figure = Figure(figsize=(2 * size, size), layout="constrained")
        for axes, (title, values, inputs) in zip(figure.subplots(1, 2), parts, strict=True):
            _draw_map(axes, values, inputs, [*names, "end"])
            axes.set_title(title, loc="left")
        return to_png(figure)


def _draw_map(axes: Axes, values: np.ndarray, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Darkness grows with the square root, so that weak connections are seen, too."""
    axes.imshow(np.sqrt(values / max(values.max(), 1e-12)), cmap="Greys", vmin=0.0, vmax=1.0, interpolation="nearest")
    size = float(np.clip(520 / len(outputs), 2.6, 8.0))
    axes.set_xticks(range(len(inputs)), inputs, rotation=90, fontsize=size)
    axes.set_yticks(range(len(outputs)), outputs, fontsize=size)
    axes.tick_params(length=0)


def short(name: str) -> str:
    """A variable's name without what all have in common."""
    return name.removeprefix("observation")
