"""Picture of the modules of variables."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mbagent.evaluation.figures import FIGURE_STYLE, to_png
from mbagent.models.neural.pruning import Influence, VariableGroup, dependent_groups, modules

ALONE = "#eceff2"
"""Colour of a variable that has no links with others."""


def draw_modules(found: Influence, shape: tuple[int, ...]) -> bytes:
    """Draws each variable in the colour of its module, with a frame, numbered by group, around dependent variables.

    Args:
        found: sums over paths.
        shape: shape of an observation; there is a picture for each of its planes [H, W], or one of a single row.
    """
    planes = (1,) * (3 - len(shape)) + shape if len(shape) < 3 else (int(np.prod(shape[:-2])), *shape[-2:])
    colours = _colours(modules(found), int(np.prod(shape)))
    groups = dependent_groups(found)
    with mpl.rc_context(FIGURE_STYLE):
        width = max(4.0, 0.42 * planes[2]) * planes[0]
        figure = Figure(figsize=(min(width, 14.0), max(1.4, 0.42 * planes[1] + 0.6)), layout="constrained")
        for plane, axes in enumerate(figure.subplots(1, planes[0], squeeze=False)[0]):
            _draw_plane(axes, plane, planes[1:], colours, groups)
            axes.set_title(f"variables of plane {plane}" if planes[0] > 1 else "variables", loc="left")
        return to_png(figure)


def _colours(found: Sequence[VariableGroup], n: int) -> list[str]:
    """A colour for each variable."""
    palette = mpl.colormaps["tab20"]
    colours = [ALONE] * (n + 1)
    for number, module in enumerate(found):
        for i in module.outputs:
            colours[i] = mpl.colors.to_hex(palette(number % 20))
    return colours


def _draw_plane(axes: Axes, plane: int, size: tuple[int, ...], colours: Sequence[str], groups: Sequence[VariableGroup]) -> None:
    height, width = size
    framed = {int(i): number for number, group in enumerate(groups) for i in group.outputs}
    for row in range(height):
        for column in range(width):
            i = (plane * height + row) * width + column
            edge, line = ("#1d2430", 1.6) if i in framed else ("white", 0.8)
            inset = 0.06 if i in framed else 0.0
            place = (column + inset, row + inset)
            side = 1.0 - 2 * inset
            axes.add_patch(mpl.patches.Rectangle(place, side, side, facecolor=colours[i], edgecolor=edge, linewidth=line))
            if i in framed:
                axes.text(column + 0.5, row + 0.5, str(framed[i] + 1), ha="center", va="center", fontsize=7, color="#1d2430")
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
