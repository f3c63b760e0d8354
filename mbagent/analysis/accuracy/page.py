"""The page and the table that the experiment ends in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from mbagent.analysis.accuracy.experiment import Draws, Score, Settings
from mbagent.analysis.accuracy.results import Points
from mbagent.analysis.accuracy.samplers import CAUSAL, COMBINED, PREDICTOR
from mbagent.analysis.accuracy.summary import MEASURES, Line, paper_parameters, statements, table
from mbagent.analysis.accuracy.trials import TRIALS, Trial
from mbagent.analysis.pages import FIGURE_STYLE, render, to_png

_DRAWS: dict[Draws, str] = {"exact": "exact", "many": "independent", "c": "c", "c systematic": "c systematic"}


@dataclass(frozen=True)
class _Headline:
    trial: Trial
    predictor: float
    combined: float
    causal: float
    variation: float


def write_page(path: Path, scores: Sequence[Score], points: Points, settings: Settings, command: str) -> None:
    """Writes the HTML page, pictures and all, into one file."""
    tables = [(trial, table(scores, trial)) for trial in TRIALS if any(s.trial == trial.name for s in scores)]
    page = render(
        "accuracy.html.jinja",
        headline=[_headline(trial, lines) for trial, lines in tables],
        tables=tables,
        statements=statements(scores),
        scatter=draw_scatter(points),
        weights={trial.name: paper_parameters(trial.options.d) for trial, _ in tables},
        measures=MEASURES,
        draws=_DRAWS,
        settings=settings,
        command=command,
    )
    path.write_text(page, encoding="utf-8")


def _headline(trial: Trial, lines: Sequence[Line]) -> _Headline:
    def read(sampler: str, draws: Draws, measure: str) -> float:
        found = [line.cells[measure].interval.estimate for line in lines if (line.sampler, line.draws) == (sampler, draws)]
        return found[0] if found else float("nan")

    return _Headline(
        trial,
        read(PREDICTOR, "many", "union"),
        read(COMBINED, "many", "union"),
        read(CAUSAL, "exact", "full"),
        read(CAUSAL, "exact", "variation"),
    )


def draw_scatter(points: Points) -> bytes:
    """Observed against inferred probabilities, one panel a trial."""
    names = [trial.name for trial in TRIALS if (trial.name, PREDICTOR) in points]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(3.4 * columns, 3.2 * rows), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat[len(names) :]:
            axes.set_visible(False)
        for axes, name in zip(grid.flat, names, strict=False):
            for sampler, marker, colour in ((PREDICTOR, "D", "#b8bfc8"), (COMBINED, "x", "#1f2630")):
                p, q = points[name, sampler].T
                axes.scatter(p, q, s=12, marker=marker, color=colour, linewidths=0.8, alpha=0.8)
            axes.plot([0, 1], [0, 1], color="#d1495b", linewidth=0.8, zorder=0)
            axes.set_title(f"Trial {name}", loc="left")
            axes.set_xlabel("observed")
            axes.set_ylabel("inferred")
        return to_png(figure)
