"""The page and the table of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from mbagent import files
from mbagent.evaluation.figures import FIGURE_STYLE, to_png
from mbagent.evaluation.report import render
from mbagent.evaluation.statistics import mean_interval
from studies import TEMPLATES
from studies.sampling_accuracy.experiment import Part, Settings
from studies.sampling_accuracy.results import Points
from studies.sampling_accuracy.samplers import CAUSAL, COMBINED, PREDICTOR
from studies.sampling_accuracy.scores import FEW_DRAWS, Draws, Score
from studies.sampling_accuracy.summary import MEASURES, Line, paper_parameters, statements, table, variant_table
from studies.sampling_accuracy.trials import SCALING, TRIALS, Trial, find_trial

_DRAWS: dict[Draws, str] = {"exact": "exact", "many": "independent", "c": "c", "c systematic": "c systematic"}


@dataclass(frozen=True)
class _Headline:
    trial: Trial
    predictor: float
    combined: float
    causal: float
    variation: float


def write_page(path: Path, scores: Mapping[Part, Sequence[Score]], points: Points, settings: Settings, command: str) -> None:
    """Writes the HTML page with its pictures into one file; parts without scores are skipped."""
    measured = scores["samplers"]
    tables = [(trial, table(measured, trial)) for trial in TRIALS if any(s.trial == trial.name for s in measured)]
    page = render(
        TEMPLATES / "accuracy.html.jinja",
        headline=[_headline(trial, lines) for trial, lines in tables],
        tables=tables,
        statements=statements(measured) if measured else [],
        scatter=draw_scatter(points) if points else None,
        variants=variant_table(scores["variants"]),
        varied=[find_trial(name) for name in dict.fromkeys(score.trial for score in scores["variants"])],
        scaling=draw_scaling(scores["scaling"]) if scores["scaling"] else None,
        seeds=lambda part, name: len({s.seed for s in scores[part] if s.trial == name}),
        weights={trial.name: paper_parameters(trial.options.d) for trial, _ in tables},
        measures=MEASURES,
        few_draws=FEW_DRAWS,
        draws=_DRAWS,
        settings=settings,
        command=command,
    )
    files.write(path, page)


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
    """Observed against inferred probabilities, one panel per trial."""
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


_CURVES: dict[str, tuple[Draws, str, str]] = {
    PREDICTOR: ("many", "D", "#b8bfc8"),
    COMBINED: ("many", "x", "#1f2630"),
    CAUSAL: ("exact", "o", "#00798c"),
}


def draw_scaling(scores: Sequence[Score]) -> bytes:
    """Error, cost per sample and number of weights against the number of variables d."""
    trials = [trial for trial in SCALING if any(score.trial == trial.name for score in scores)]
    sizes = [trial.options.d for trial in trials]
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(10.5, 3.4), layout="constrained")
        error, cost, weights = figure.subplots(1, 3)
        for sampler, (draws, marker, colour) in _CURVES.items():

            def mean(trial: Trial, field: str, draws: Draws, sampler: str = sampler) -> float:
                chosen = (s for s in scores if (s.trial, s.sampler, s.draws) == (trial.name, sampler, draws))
                return mean_interval(getattr(s, field) for s in chosen).estimate

            style = {"marker": marker, "color": colour, "label": sampler, "markersize": 5}
            error.plot(sizes, [mean(trial, "variation", draws) for trial in trials], **style)
            cost.plot(sizes, [mean(trial, "sample_microseconds", "many") for trial in trials], **style)
            weights.plot(sizes, [mean(trial, "parameters", draws) for trial in trials], **style)
        formula = [sum(paper_parameters(d)) for d in sizes]
        weights.plot(sizes, formula, color="#d1495b", linestyle=":", label="the paper's count, both networks")
        for axes, title in ((error, "Total variation"), (cost, "One draw, µs"), (weights, "Weights")):
            axes.set_title(title, loc="left")
            axes.set_xlabel("variables d")
            axes.set_xscale("log", base=2)
            axes.set_xticks(sizes, [str(d) for d in sizes])
        error.set_ylim(0.0, 1.0)
        cost.set_yscale("log")
        weights.set_yscale("log")
        weights.legend(fontsize=7)
        return to_png(figure)
