"""The figure and the page of the experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness import Row, Tables
from mbagent.evaluation.figures import Line as Curve
from mbagent.evaluation.figures import Panel, draw_panels
from mbagent.evaluation.report import Card, Page, Section, format_interval, format_number
from mbagent.evaluation.report import Table as TextTable
from mbagent.evaluation.statistics import Interval, mean_interval
from studies.forecasting.experiment import CASES, Method, Settings

MEASURES: dict[str, str] = {
    "joint": "total variation of the joint distribution",
    "inexact": "share of draws that are not the next state",
    "marginal": "total variation of single variables",
}
"""Fields of a score, the most informative first."""

_LOOKS: dict[Method, tuple[str, str, str]] = {
    "iterated": ("one-step model, iterated", "#00798c", "o"),
    "direct": ("a model for each n", "#d1495b", "s"),
    "true again": ("a second set of true draws", "#9aa3ad", ""),
}


@dataclass(frozen=True)
class Line:
    """Errors at n steps by method, in the case's measure and for single variables, and the direct model's fit time in seconds."""

    n: int
    errors: dict[Method, Interval]
    marginals: dict[Method, Interval]
    fit_seconds: float


@dataclass(frozen=True)
class Table:
    """One game's errors."""

    name: str
    measure: str
    lines: list[Line]
    seeds: int
    returns: dict[str, Interval]


def tables(scores: Sequence[Row], returns: Sequence[Row]) -> list[Table]:
    """A table for each measured game."""
    found = []
    for case in CASES:
        mine = [score for score in scores if score["case"] == case.name]
        if not mine:
            continue
        measure = next(name for name in MEASURES if all(np.isfinite(score[name]) for score in mine))
        lines = [_line([score for score in mine if score["n"] == n], n, measure) for n in sorted({score["n"] for score in mine})]
        played = [row for row in returns if row["case"] == case.name]
        means = {
            kind: mean_interval(row["value"] for row in played if row["forecasts"] == kind) for kind in ("iterated", "direct")
        }
        found.append(Table(case.name, measure, lines, len({score["seed"] for score in mine}), means if played else {}))
    return found


def _line(scores: Sequence[Row], n: int, measure: str) -> Line:
    def mean(method: Method, field: str) -> Interval:
        return mean_interval(score[field] for score in scores if score["method"] == method)

    errors = {method: mean(method, measure) for method in _LOOKS}
    marginals = {method: mean(method, "marginal") for method in _LOOKS}
    return Line(n, errors, marginals, mean("direct", "fit_seconds").estimate)


def write_page(path: Path, results: Tables, settings: Settings, command: str) -> bytes:
    """Writes the HTML page with its picture into one file; returns the picture as PNG."""
    found = tables(results["results"], results.get("returns", []))
    figure = draw_errors(found)
    about = "Error of both forecasting methods against the number of steps, one panel for each game"
    note = (
        "Means over seeds with 95% t intervals. Total variation of the joint distribution is exact, over all states of the "
        f"game. If there are too many states, it is the share of {settings.n_draws} samples that miss the only possible state, "
        "or, if there is never only one, the total variation of single variables between "
        f"{settings.n_draws} samples and as many true ones, compared with that of two sets of true samples."
    )
    cards = [Card(figure=figure, about=about, notes=[note]), *(_card(table, settings) for table in found)]
    section = Section("Error against the number of steps", cards)
    Page(
        "Forecasts", "How far ahead models predict", INTRO.format(settings.timesteps), [section], command, _methods(settings)
    ).write(path)
    return figure


INTRO = (
    "An iterated one-step model accumulates errors. Section 4.2 of Braylan and Miikkulainen 2015 proposes an alternative: "
    "a separate model for each number of steps n, with a string of n actions as input. Its errors do not accumulate, but it is "
    "harder to learn. Both kinds learned from the same {:,} steps of random play and forecast the same strings of random "
    "actions, from states of other random play; the games themselves give the true distributions."
)


def _methods(settings: Settings) -> dict[str, str]:
    return {
        "Models": 'The networks (`model="networks"`): predictor and causal conditioner on flat variables; on planes, weights '
        "shared over positions, with one block of layers for each action of the string. Each action has its own group of "
        "inputs.",
        "Cases": f"{settings.n_starts} states of random play; seeds {settings.first_seed} and up.",
    }


def _card(table: Table, settings: Settings) -> Card:
    """One game's errors as text."""
    columns = ("n", "Iterated", "A model for n", "Single variables: iterated", "a model for n", "true draws", "Its fit, seconds")
    rows = []
    for line in table.lines:
        errors = [line.errors[method] for method in ("iterated", "direct")]
        cells = [f"{format_number(error.estimate, 4)} ({format_interval(error, 4)})".replace(" ()", "") for error in errors]
        cells += [format_number(line.marginals[method].estimate, 4) for method in _LOOKS]
        rows.append([str(line.n), *cells, format_number(line.fit_seconds, 1)])
    note = f"First two columns: {MEASURES[table.measure]}. {table.seeds} seed(s)."
    if table.returns:
        iterated, direct = (format_number(table.returns[kind].estimate, 1) for kind in ("iterated", "direct"))
        note += (
            f" Mean return of flat Monte Carlo over {settings.episodes} episodes a seed: {iterated} with the iterated model, "
            f"{direct} with a model for each n "
            '(`policy_kwargs={"forecasts": "direct"}`).'
        )
    return Card(table.name, table=TextTable(columns, rows), notes=[note])


def draw_errors(found: Sequence[Table]) -> bytes:
    """Error against the number of steps, one panel a game."""
    return draw_panels([_panel(table) for table in found], size=(4.8, 3.2), columns=2)


def _panel(table: Table) -> Panel:
    steps, lines = [line.n for line in table.lines], []
    for method, (label, colour, marker) in _LOOKS.items():
        if method == "true again" and table.measure != "marginal":
            continue  # zero by definition
        cells = [line.errors[method] for line in table.lines]
        band = [max(c.low, 0.0) for c in cells], [min(c.high, 1.0) for c in cells]  # all measures are shares
        lines.append(Curve(steps, [c.estimate for c in cells], colour, label, band=band, marker=marker))
    return Panel(table.name, lines, "steps ahead n", MEASURES[table.measure], y_limits=(0.0, None))
