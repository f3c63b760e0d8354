"""Line plots in panels, in a style shared by all pages."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

FIGURE_STYLE: Any = {
    "font.size": 9.5,
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#b8bfc8",
    "axes.labelcolor": "#4a5361",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "xtick.color": "#4a5361",
    "ytick.color": "#4a5361",
    "svg.hashsalt": "mbagent",
}
"""Settings for ``matplotlib.rc_context``, shared by the figures of all pages."""


_PLACES: Any = {"above": "outside upper center", "below": "outside lower center"}


@dataclass(frozen=True)
class Line:
    """One line of a panel.

    Attributes:
        x: x coordinates [N]; empty for a horizontal line across the whole panel.
        y: y coordinates [N]; a single one for a horizontal line.
        colour: colour of the line.
        label: name of the line in the legend; lines with equal labels share one entry, and lines labelled "" have none.
        error: half-lengths of error bars [N], or None.
        band: lower and upper ends [N] of a shaded band, or None.
        marker: marker of the points.
        style: "-" (solid), "--" or ":".
    """

    x: Sequence[float]
    y: Sequence[float]
    colour: str
    label: str = ""
    error: Sequence[float] | None = None
    band: tuple[Sequence[float], Sequence[float]] | None = None
    marker: str = "o"
    style: Literal["-", "--", ":"] = "-"


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: title above the panel.
        lines: the lines.
        x_label, y_label: labels of the axes.
        x_scale, y_scale: "linear" or "log"; x_scale may also be "log2".
        y_limits: lower and upper limit; each is fitted to the lines if None.
        x_ticks: tick labels by position; None for matplotlib's own ticks.
    """

    title: str
    lines: Sequence[Line]
    x_label: str = ""
    y_label: str = ""
    x_scale: Literal["linear", "log", "log2"] = "linear"
    y_scale: Literal["linear", "log"] = "linear"
    y_limits: tuple[float | None, float | None] = (None, None)
    x_ticks: Mapping[float, str] | None = None


def draw_panels(
    panels: Sequence[Panel],
    *,
    size: tuple[float, float] = (3.6, 2.9),
    columns: int | None = None,
    legend: Literal["above", "below"] = "above",
) -> bytes:
    """Draws panels with a shared legend.

    Args:
        panels: in reading order.
        size: width and height of each panel, inches.
        columns: panels per row; None for all in one row.
        legend: position of the legend.

    Returns:
        A PNG.
    """
    columns = min(columns or len(panels), len(panels))
    rows = -(-len(panels) // columns)
    entries = {line.label: line for panel in panels for line in panel.lines if line.label}
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(size[0] * columns, size[1] * rows + 0.3), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw_panel(axes, panel)
        handles = [
            mpl.lines.Line2D([], [], color=line.colour, label=label, linewidth=2, linestyle=line.style)
            for label, line in entries.items()
        ]
        if handles:
            figure.legend(handles=handles, loc=_PLACES[legend], ncols=min(3 * columns, len(handles)), frameon=False)
        return to_png(figure)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for line in panel.lines:
        _draw_line(axes, line)
    if panel.x_scale == "log2":
        axes.set_xscale("log", base=2)
    else:
        axes.set_xscale(panel.x_scale)
    axes.set_yscale(panel.y_scale)
    if panel.x_ticks is not None:
        axes.set_xticks(list(panel.x_ticks), list(panel.x_ticks.values()))
        axes.xaxis.set_minor_locator(NullLocator())
    bottom, top = panel.y_limits
    if bottom is not None or top is not None:
        axes.set_ylim(bottom, top)
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)


def _draw_line(axes: Axes, line: Line) -> None:
    if not len(line.x):
        axes.axhline(line.y[0], color=line.colour, linestyle=line.style, linewidth=1)
        return
    if line.error is not None:
        axes.errorbar(line.x, line.y, yerr=line.error, fmt="none", ecolor=line.colour, elinewidth=1.0, capsize=2)
    axes.plot(line.x, line.y, color=line.colour, linestyle=line.style, marker=line.marker, markersize=4, linewidth=1.6)
    if line.band is not None:
        low, high = (np.asarray(end, dtype=np.float64) for end in line.band)
        axes.fill_between(np.asarray(line.x, dtype=np.float64), low, high, color=line.colour, alpha=0.15, linewidth=0)


def to_png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=140, bbox_inches="tight", facecolor="white")
    return buffer.getvalue()
