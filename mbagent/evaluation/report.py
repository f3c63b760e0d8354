"""Report pages (tables and figures in one self-contained HTML file) and the formatting of numbers."""

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
        columns: column titles.
        rows: cells of each row, one for each column; the first cell is the row's name.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, Any]], shown: Callable[[Any], str]) -> Table:
        """A table from rows with the same keys (the columns); ``shown`` formats each value."""
        return cls(list(rows[0]), [[shown(value) for value in row.values()] for row in rows])

    def markdown(self, names: int = 1) -> str:
        """The table as Markdown; all but the first ``names`` columns are right-aligned."""
        titles, marks = "| " + " | ".join(self.columns) + " |", ["---"] * names + ["---:"] * (len(self.columns) - names)
        lines = [titles.replace("|  |", "| |"), "| " + " | ".join(marks) + " |"]
        return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in self.rows)])


@dataclass(frozen=True)
class Card:
    """One box of a page: a title, a figure, a table, notes and code lines, all optional.

    Attributes:
        title: title of the box.
        figure: PNG.
        about: alternative text of the figure.
        table: table below the figure.
        notes: paragraphs in small print; text between backticks is shown as code.
        lines: lines of code.
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
        name: window title.
        title: main heading.
        intro: first paragraph.
        sections: the results.
        command: the command line that reproduces the page.
        methods: paragraphs about the methods, keyed by their headings.
    """

    name: str
    title: str
    intro: str
    sections: Sequence[Section]
    command: str
    methods: Mapping[str, str]

    def write(self, path: Path) -> None:
        """Writes the page with embedded pictures into one file."""
        files.write(path, render(_TEMPLATES / "page.html.jinja", {"inline": inline}, page=self))


def inline(text: str) -> Markup:
    """Escapes text for HTML; text between backticks becomes code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def render(template: Path, filters: dict[str, Callable[..., Any]] | None = None, **values: Any) -> str:
    """Renders a page from a template as self-contained HTML.

    Args:
        template: template file, which may extend this package's ``base.html.jinja``.
        filters: additional Jinja filters.
        **values: variables for the template; ``versions``, ``python`` and ``date`` are always defined.
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
    """Formats a number for a table, with a typographic minus sign; NaN (missing) becomes an en dash."""
    if math.isnan(value):
        return "–"
    text = f"{value:,.{digits}f}"
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def format_interval(interval: Interval, digits: int = 2) -> str:
    """Formats the ends of an interval for a table."""
    if math.isnan(interval.low):
        return ""
    return f"{format_number(interval.low, digits)} … {format_number(interval.high, digits)}"


def embedded(png: bytes) -> str:
    """A picture as a data URL, so that the page needs no other file."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
