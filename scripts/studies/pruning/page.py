"""The curves, the figures 11 and 12 of the paper, and the page that the experiment ends in."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mbagent import files
from mbagent.evaluation.report import FIGURE_STYLE, format_number, render, to_png
from mbagent.evaluation.statistics import Interval, mean_interval
from studies import TEMPLATES
from studies.pruning.experiment import Key, Outcome, Settings, Way
from studies.pruning.measures import SizeRow
from studies.pruning.picture import draw_modules
from worlds.games import find_case, game_of

CURVES: dict[str, str] = {
    "returned": "normalised return",
    "marginal": "error of single variables (total variation)",
    "log_likelihood": "nats a transition lost",
    "connections": "connections left",
    "used": "µs for a next state, as used",
    "parents": "parents of a variable",
}
"""Fields of a row that are drawn against the pruned fraction."""

COLUMNS: dict[str, tuple[str, int]] = {
    "connections": ("Connections", 0),
    "returned": ("Normalised return", 3),
    "change": ("Change", 4),
    "half_width": ("±", 4),
    "log_likelihood": ("Nats lost", 4),
    "marginal": ("Error of single variables", 5),
    "full": ("µs, all asked", 2),
    "matrices": ("µs, matrices", 2),
    "connected": ("µs, connections", 2),
    "used": ("µs, as used", 2),
    "speed_up": ("Times the speed", 1),
    "variation": ("Total variation", 4),
    "parents": ("Parents", 1),
    "precision": ("Precision", 3),
    "recall": ("Recall", 3),
    "conditions_precision": ("of next variables: precision", 3),
    "conditions_recall": ("recall", 3),
    "modules": ("Modules found", 2),
    "seconds": ("Seconds", 1),
}
"""Fields of a row in the table, and what follows from several rows: title and digits."""

COLOURS: dict[Way, str] = {"by size": "#9aa5b1", "by evidence": "#0b6e4f"}

Cells = dict[str, float]


@dataclass(frozen=True)
class Section:
    """One game on the page.

    Attributes:
        title: of the game.
        seeds: number of repetitions.
        rows: for each share and way: these and the means over seeds, by column.
        others: microseconds of a next state by other networks, and how many times faster the best row is.
        pictures: (caption, picture) of the curves, the sums over paths and the modules, these of the first seed.
        modules, groups: of what the last map shows.
        shown: that share and way.
    """

    title: str
    seeds: int
    rows: list[tuple[Key, Cells]]
    others: dict[str, tuple[float, float]]
    pictures: dict[str, tuple[str, bytes]]
    modules: list[str]
    groups: list[str]
    shown: Key


def summary(outcomes: Sequence[Outcome]) -> list[tuple[Key, Cells]]:
    """Means over seeds for each share and way, the change of the return in the same episodes, and the speed-up."""
    result: list[tuple[Key, Cells]] = []
    rows = [row for outcome in outcomes for row in outcome.rows]
    first = rows[0].fraction, rows[0].way
    for key in dict.fromkeys((row.fraction, row.way) for row in rows):
        mine = [row for row in rows if (row.fraction, row.way) == key]
        cells = {name: float(np.mean([getattr(row, name) for row in mine])) for name in COLUMNS if hasattr(mine[0], name)}
        pairs = [outcome.returns[key] - outcome.returns[first] for outcome in outcomes if key in outcome.returns]
        change = mean_interval(np.concatenate(pairs)) if key != first else Interval(0.0, 0.0, 0.0)
        cells |= {"change": change.estimate, "half_width": change.high - change.estimate}
        whole = result[0][1]["full"] if result else cells["full"]
        result.append((key, {**cells, "speed_up": whole / cells["used"]}))
    return result


def summary_rows(outcomes: Sequence[Outcome]) -> list[dict[str, str | int | float]]:
    """The summary of each game as rows for a file."""
    rows: list[dict[str, str | int | float]] = []
    for game in dict.fromkeys(outcome.cell.game for outcome in outcomes):
        mine = [outcome for outcome in outcomes if outcome.cell.game == game]
        for (fraction, way), cells in summary(mine):
            rows.append({"game": game, "seeds": len(mine), "fraction": fraction, "way": way, **cells})
    return rows


def markdown_table(paths: Sequence[Path]) -> str:
    """The README's table, from files of ``summary_rows``."""
    titles = ["", "pruned", "connections", "return", "change", "nats lost", "µs", "precision", "recall", "modules"]
    lines = ["| " + " | ".join(titles) + " |", "| --- | --- |" + " ---: |" * (len(titles) - 2)]
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                fraction, cell = float(row["fraction"]), {k: float(v) for k, v in row.items() if k not in ("game", "way")}
                change = f"{format_number(cell['change'], 4)} ± {cell['half_width']:.4f}" if fraction else ""
                shown = [find_case(row["game"]).title, f"{fraction:.0%}, {row['way']}" if fraction else "no"]
                shown += [format_number(cell["connections"], 0), format_number(cell["returned"], 3), change]
                shown += [format_number(cell[name], digits) for name, digits in (("log_likelihood", 4), ("used", 2))]
                shown += [format_number(cell[name], 2) for name in ("precision", "recall", "modules")]
                lines.append("| " + " | ".join(shown) + " |")
    return "\n".join(lines)


def write_page(
    path: Path, outcomes: Sequence[Outcome], settings: Settings, command: str, sizes: Sequence[SizeRow] = ()
) -> dict[str, bytes]:
    """Writes the HTML page, pictures and all, into one file; returns the pictures as PNG by name."""
    sections: list[Section] = []
    pictures: dict[str, bytes] = {}
    for game in settings.games:
        mine = sorted((o for o in outcomes if o.cell.game == game), key=lambda o: o.cell.seed)
        if mine:
            sections.append(section_of(mine))
            pictures |= {f"{game}_{name}": png for name, (_, png) in sections[-1].pictures.items()}
    page = render(
        TEMPLATES / "pruning.html.jinja",
        sections=sections,
        columns=COLUMNS,
        settings=settings,
        command=command,
        sizes=sizes,
        exponents={name: exponent(sizes, name) for name in ("whole", "pruned")} if len({row.d for row in sizes}) > 1 else {},
    )
    files.write(path, page)
    return pictures


def exponent(rows: Sequence[SizeRow], name: str) -> float:
    """The power of d that a cost grows with: slope of the logarithms, by least squares."""
    return float(np.polyfit(np.log([row.d for row in rows]), np.log([getattr(row, name) for row in rows]), 1)[0])


def section_of(outcomes: Sequence[Outcome]) -> Section:
    """What the page says about one game."""
    rows, first = summary(outcomes), outcomes[0]
    whole, (shown, best) = rows[0][0], rows[-1]
    middle = next((key for key, _ in rows if key[0] >= 0.9), shown)
    pictures: dict[str, tuple[str, bytes]] = {"curves": ("What is left against the pruned fraction", draw_curves(rows))}
    for number, key in enumerate(dict.fromkeys((whole, middle, shown))):
        pictures[f"paths_{number}"] = (captioned(key), draw_paths(first, key, linked(first, shown)))
    if (game := game_of(find_case(first.cell.game))) is not None:
        picture = draw_modules(first.linked[shown], game.observation_space.shape)
        pictures["modules"] = (f"Modules, {captioned(shown)}", picture)
    others = {name: float(np.mean([o.others[name] for o in outcomes])) for name in first.others}
    title = find_case(first.cell.game).title
    ratios = {name: (cost, cost / best["used"]) for name, cost in others.items()}
    return Section(title, len(outcomes), rows, ratios, pictures, first.modules[shown], first.groups[shown], shown)


def captioned(key: Key) -> str:
    """What is said of a share and a way."""
    return f"{key[0]:.0%} of the connections removed, {key[1]}" if key[0] else "before pruning"


def draw_curves(rows: Sequence[tuple[Key, Cells]]) -> bytes:
    """Everything against the pruned fraction, a line for each way."""
    fractions = sorted({key[0] for key, _ in rows})
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(10, 4.8), layout="constrained")
        for axes, (name, label) in zip(figure.subplots(2, 3).flat, CURVES.items(), strict=True):
            for way in dict.fromkeys(key[1] for key, _ in rows):
                mine = [(fractions.index(key[0]), cells[name]) for key, cells in rows if key[1] == way or not key[0]]
                axes.plot(*zip(*mine, strict=True), color=COLOURS[way], marker="o", markersize=4, label=way)
            axes.set_xticks(range(len(fractions)), [f"{fraction:.0%}" for fraction in fractions])
            axes.set_title(label, loc="left")
            if name in ("connections", "log_likelihood", "used") and min(cells[name] for _, cells in rows) > 0:
                axes.set_yscale("log")
            axes.set_xlabel("pruned")
        figure.axes[0].legend(frameon=False)
        return to_png(figure)


def draw_paths(outcome: Outcome, key: Key, variables: Sequence[int]) -> bytes:
    """The paper's figures 11 and 12: sums of absolute weights over paths, from inputs (x) to outputs (y); darker is more."""
    found, some = outcome.influences[key], np.asarray(variables, dtype=np.int64)
    names = [short(outcome.names[i]) for i in some]
    rows = np.append(some, len(found.states) - 1)  # the end, too
    states, actions, others = found.states[np.ix_(rows, some)], found.actions[rows], found.others[np.ix_(rows, rows)]
    parts = (
        ("predictor: state and action → next state", np.concatenate([states, actions], axis=1), [*names, *outcome.actions]),
        ("conditioner: other next variables → next state", others, [*names, "end"]),
    )
    with mpl.rc_context(FIGURE_STYLE):
        size = max(6.0, 0.1 * len(names))
        figure = Figure(figsize=(2 * size, size), layout="constrained")
        for axes, (title, values, inputs) in zip(figure.subplots(1, 2), parts, strict=True):
            _draw_map(axes, values, inputs, [*names, "end"])
            axes.set_title(title, loc="left")
        return to_png(figure)


def linked(outcome: Outcome, key: Key) -> list[int]:
    """The state variables that lead to one or that something leads to; all if there are none."""
    found = outcome.influences[key]
    n = len(outcome.names)
    out = (found.states > 0.0).any(axis=0) | (found.conditions > 0.0).any(axis=0) | (found.others[:, :n] > 0.0).any(axis=0)
    into = [(part[:n] > 0.0).any(axis=1) for part in (found.states, found.actions, found.others, found.conditions)]
    some: list[int] = np.flatnonzero(out | np.any(into, axis=0)).tolist()
    return some or list(range(n))


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
