"""Report pages: tables and figures on one self-contained HTML page, and how numbers are written in them."""

from __future__ import annotations

import base64
import math
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from mbagent import files
from mbagent.evaluation.statistics import Interval

_TEMPLATES = Path(__file__).parent / "templates"
_SHOWN_VERSIONS = ("gymnasium", "stable-baselines3", "torch", "numpy", "numba")


@dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes:
        columns: titles.
        rows: cells, each row as long as ``columns``; the first cell names the row.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, Any]], shown: Callable[[Any], str]) -> Table:
        """Rows of equal keys as a table, each value as ``shown`` writes it."""
        return cls(list(rows[0]), [[shown(value) for value in row.values()] for row in rows])

    def markdown(self, names: int = 1) -> str:
        """The table as Markdown; all but the first ``names`` columns are set to the right."""
        titles, marks = "| " + " | ".join(self.columns) + " |", ["---"] * names + ["---:"] * (len(self.columns) - names)
        lines = [titles.replace("|  |", "| |"), "| " + " | ".join(marks) + " |"]
        return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in self.rows)])


@dataclass(frozen=True)
class Card:
    """One box of a page: a title, a figure, a table, notes and a list, each where there is one.

    Attributes:
        title: of the box.
        figure: PNG.
        about: what the figure shows, for who does not see it.
        table: below the figure.
        notes: paragraphs in small print; text between backticks is set as code.
        lines: set as code, one below another.
    """

    title: str = ""
    figure: bytes | None = None
    about: str = ""
    table: Table | None = None
    notes: Sequence[str] = ()
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Section:
    """A heading with the boxes below it."""

    title: str
    cards: Sequence[Card]


@dataclass(frozen=True)
class Page:
    """A page of results.

    Attributes:
        name: for the window.
        title: its heading.
        intro: first paragraph.
        sections: what was found.
        command: the command line that makes it again.
        methods: how it was measured: paragraphs by their headings.
    """

    name: str
    title: str
    intro: str
    sections: Sequence[Section]
    command: str
    methods: Mapping[str, str]

    def write(self, path: Path) -> None:
        """Writes the page, pictures and all, into one file."""
        files.write(path, render(_TEMPLATES / "page.html.jinja", {"inline": inline}, page=self))


def inline(text: str) -> Markup:
    """Text for HTML; what stands between backticks as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def render(template: Path, filters: dict[str, Callable[..., Any]] | None = None, **values: Any) -> str:
    """A page as one self-contained HTML text.

    Args:
        template: file of the template; it may extend ``base.html.jinja`` of this package.
        filters: further filters for it.
        **values: what it shows; ``versions``, ``python`` and ``date`` are there already.
    """
    environment = Environment(
        loader=FileSystemLoader([template.parent, _TEMPLATES]),
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
