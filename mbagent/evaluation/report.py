"""What every report page shares: the template engine, how numbers are written, and how pictures are embedded."""

from __future__ import annotations

import base64
import io
import math
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from mbagent.evaluation.statistics import Interval

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
"""Settings for ``matplotlib.rc_context``: every figure of every page looks alike."""

_SHOWN_VERSIONS = ("gymnasium", "stable-baselines3", "torch", "numpy", "numba")


def render(template: Path, filters: dict[str, Callable[..., Any]] | None = None, **values: Any) -> str:
    """A page as one self-contained HTML text.

    Args:
        template: file of the template; it may extend ``base.html.jinja`` of this package.
        filters: further filters for it.
        **values: what it shows; ``versions``, ``python`` and ``date`` are there already.
    """
    environment = Environment(
        loader=ChoiceLoader([FileSystemLoader(template.parent), PackageLoader("mbagent.evaluation", "templates")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=format_number, interval=format_interval, embedded=embedded, **(filters or {}))
    return environment.get_template(template.name).render(
        versions={name: metadata.version(name) for name in _SHOWN_VERSIONS},
        python=platform.python_version(),
        date=datetime.now(tz=UTC).strftime("%Y-%m-%d"),
        **values,
    )


def format_number(value: float, digits: int = 2) -> str:
    """A number for a table: a true minus sign, an en dash for what was not measured."""
    if math.isnan(value):
        return "–"
    text = f"{value:,.{digits}f}"
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def format_interval(interval: Interval, digits: int = 2) -> str:
    """The ends of an interval for a table."""
    if math.isnan(interval.low):
        return ""
    return f"{format_number(interval.low, digits)} … {format_number(interval.high, digits)}"


def embedded(png: bytes) -> str:
    """A picture as a data address, so that the page needs no other file."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def to_png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=140, bbox_inches="tight", facecolor="white")
    return buffer.getvalue()
