"""The curves, figures 11 and 12 of the paper, and the page of the experiment."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mbagent.evaluation.figures import FIGURE_STYLE, Line, Panel, draw_panels, to_png
from mbagent.evaluation.report import Card, Page, Section, Table, format_number
from mbagent.evaluation.statistics import Interval, mean_interval
from studies.pruning.experiment import Key, Outcome, Settings, Way
from studies.pruning.measures import SizeRow
from studies.pruning.picture import draw_modules
from worlds.games import find_case

CURVES: dict[str, str] = {
    "returned": "normalised return",
    "marginal": "error of single variables (total variation)",
    "log_likelihood": "nats lost per transition",
    "connections": "connections left",
    "used": "µs per next state, as used",
    "parents": "parents of a variable",
}
"""Fields of a row that are plotted against the pruned fraction."""

COLUMNS: dict[str, tuple[str, int]] = {
    "connections": ("Connections", 0),
    "returned": ("Normalised return", 3),
    "change": ("Change", 4),
    "half_width": ("±", 4),
    "log_likelihood": ("Nats lost", 4),
    "marginal": ("Error of single variables", 5),
    "full": ("µs, all asked", 2),
    "matrices": ("µs, matrices", 2),
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
"""Fields of a row, and values derived from several rows, in the table: title and digits."""

COLOURS: dict[Way, str] = {"by size": "#9aa5b1", "by evidence": "#0b6e4f"}

Cells = dict[str, float]


def summary(outcomes: Sequence[Outcome]) -> list[tuple[Key, Cells]]:
    """Means over seeds for each share and method, the change of the return in the same episodes, and the speed-up."""
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
    titles = ["", "pruned", "connections", "return", "change", "nats lost", "speed", "precision", "recall", "modules"]
    lines = []
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                fraction, cell = float(row["fraction"]), {k: float(v) for k, v in row.items() if k not in ("game", "way")}
                change = f"{format_number(cell['change'], 4)} ± {cell['half_width']:.4f}" if fraction else ""
                shown = [find_case(row["game"]).title, f"{fraction:.0%}, {row['way']}" if fraction else "no"]
                shown += [format_number(cell["connections"], 0), format_number(cell["returned"], 3), change]
                shown += [format_number(cell[name], digits) for name, digits in (("log_likelihood", 4), ("speed_up", 1))]
                shown += [format_number(cell[name], 2) for name in ("precision", "recall", "modules")]
                lines.append(shown)
    return Table(titles, lines).markdown(names=2)


def write_page(
    path: Path, outcomes: Sequence[Outcome], settings: Settings, command: str, sizes: Sequence[SizeRow] = ()
) -> dict[str, bytes]:
    """Writes the HTML page with its pictures into one file; returns the pictures as PNG by name."""
    sections: list[Section] = []
    pictures: dict[str, bytes] = {}
    for game in settings.games:
        mine = sorted((o for o in outcomes if o.cell.game == game), key=lambda o: o.cell.seed)
        if mine:
            section, drawn = section_of(mine)
            sections.append(section)
            pictures |= {f"{game}_{name}": png for name, png in drawn.items()}
    if sizes:
        sections.append(_sizes(sizes))
    Page("Pruning", "Networks after pruning", _intro(settings), sections, command, METHODS).write(path)
    return pictures


METHODS = {
    "Figures 11 and 12": "Sums of absolute weights over all paths from an input (x) to an output (y), on a square root scale, "
    "first seed; without variables that have no links after pruning."
}

NOTE = (
    "Means over {} seed(s). Change: of the return in the same episodes, with the half-width of its 95% interval over episodes. "
    "Nats lost: difference to the true model's log-likelihood per transition, on unseen play. Error of single variables: "
    "total variation between 200 samples of the model and of the game, which sampling noise alone makes larger than 0. "
    "µs: processor time of one next state in a batch of 1,024; all asked: every variable with a group in the conditioner "
    "is sampled from it; matrices: without those of which the predictor is certain; as used: tables, if no variable has too many "
    "parents for one. Times the speed: of the unpruned networks, all asked. Total variation: between tables and whole "
    "matrices, upper 95% limit. Parents: state variables that a variable depends on. Precision and recall: of these against the "
    "true dependencies. Modules found: share of the true ones, found exactly."
)


def _intro(settings: Settings) -> str:
    own = ", the paper's own" if settings.networks == "paper" else ""
    plays = f" and plays the same {settings.episodes} episodes each time" if settings.episodes else ""
    return (
        "The smallest weights of predictor and conditioner are removed, a few at a time, while training of the others continues "
        f"(section 5 of Braylan and Miikkulainen 2015). Networks on flat variables{own}, learned from {settings.timesteps:,} "
        f"steps of random play; the same learned agent is pruned to each share{plays}. By size: exactly this share. By "
        "evidence, the default of `agent.prune`: also the connections that the transitions do not support."
    )


def _sizes(sizes: Sequence[SizeRow]) -> Section:
    """Cost against the number of variables."""
    columns = ("d", "Seed", "Connections left", "µs before pruning", "µs after")
    rows = [
        [str(row.d), str(row.seed), format_number(row.connections, 0), format_number(row.whole, 3), format_number(row.pruned, 3)]
        for row in sizes
    ]
    note = "Synthetic DBNs of d bits of which at most eight are ever random, 90% removed."
    if len({row.d for row in sizes}) > 1:
        whole, pruned = (format_number(exponent(sizes, name), 2) for name in ("whole", "pruned"))
        note += f" Cost grows as d to the power of {whole} before pruning and {pruned} after."
    return Section("Cost against the number of variables", [Card(table=Table(columns, rows), notes=[note])])


def exponent(rows: Sequence[SizeRow], name: str) -> float:
    """Exponent of d in the growth of a cost: slope of the logarithms, by least squares."""
    return float(np.polyfit(np.log([row.d for row in rows]), np.log([getattr(row, name) for row in rows]), 1)[0])


def section_of(outcomes: Sequence[Outcome]) -> tuple[Section, dict[str, bytes]]:
    """The page's section on one game, and its pictures by name; sums over paths and modules are those of the first seed."""
    rows, first = summary(outcomes), outcomes[0]
    whole, (shown, best) = rows[0][0], rows[-1]
    middle = next((key for key, _ in rows if key[0] >= 0.9), shown)
    pictures = {"curves": draw_curves(rows)}
    notes = [NOTE.format(len(outcomes))]
    if others := {name: float(np.mean([o.others[name] for o in outcomes])) for name in first.others}:
        costs = [f"{name} {cost:.1f} µs, {cost / best['used']:.0f} times that of the last row" for name, cost in others.items()]
        notes.append(f"In the same run: {'; '.join(costs)}.")
    cards = [Card(figure=pictures["curves"], about="Measures against the pruned fraction", table=_table(rows), notes=notes)]
    for number, key in enumerate(dict.fromkeys((whole, middle, shown))):
        pictures[f"paths_{number}"] = draw_paths(first, key, linked(first, shown))
        caption = captioned(key)
        cards.append(Card(caption[0].upper() + caption[1:], pictures[f"paths_{number}"]))
    if (game := find_case(first.cell.game).game) is not None:
        pictures["modules"] = draw_modules(first.linked[shown], game.observation_space.shape)
        cards.append(Card(f"Modules, {captioned(shown)}", pictures["modules"]))
    about = "Variables that influence each other in one step, and their inputs."
    cards.append(Card(f"Modules, {100 * shown[0]:.0f}% removed", notes=[about], lines=first.modules[shown] or ["None."]))
    about = "Variables that are dependent given state and action: numbered frames in the picture."
    cards.append(Card("Drawn together", notes=[about], lines=first.groups[shown] or ["None."]))
    return Section(find_case(first.cell.game).title, cards), pictures


def _table(rows: Sequence[tuple[Key, Cells]]) -> Table:
    """The summary as text."""
    lines = [
        [
            f"{key[0]:.0%}",
            key[1] if key[0] else "",
            *(format_number(cells[name], digits) for name, (_, digits) in COLUMNS.items()),
        ]
        for key, cells in rows
    ]
    return Table(["Pruned", "", *(title for title, _ in COLUMNS.values())], lines)


def captioned(key: Key) -> str:
    """Caption for a share and a method."""
    return f"{key[0]:.0%} of the connections removed, {key[1]}" if key[0] else "before pruning"


def draw_curves(rows: Sequence[tuple[Key, Cells]]) -> bytes:
    """Plots all measures against the pruned fraction, with a line for each method."""
    fractions = sorted({key[0] for key, _ in rows})
    ticks: dict[float, str] = {i: f"{fraction:.0%}" for i, fraction in enumerate(fractions)}
    panels = []
    for name, label in CURVES.items():
        lines = []
        for way in dict.fromkeys(key[1] for key, _ in rows):
            mine = [(fractions.index(key[0]), cells[name]) for key, cells in rows if key[1] == way or not key[0]]
            lines.append(Line([x for x, _ in mine], [y for _, y in mine], COLOURS[way], way))
        logarithmic = name in ("connections", "log_likelihood", "used") and min(cells[name] for _, cells in rows) > 0
        panels.append(Panel(label, lines, "pruned", y_scale="log" if logarithmic else "linear", x_ticks=ticks))
    return draw_panels(panels, size=(3.4, 2.4), columns=3)


def draw_paths(outcome: Outcome, key: Key, variables: Sequence[int]) -> bytes:
    """The paper's figures 11 and 12: sums of absolute weights over paths, from inputs (x) to outputs (y); darker is larger."""
    found, some = outcome.influences[key], np.asarray(variables, dtype=np.int64)
    names = [short(outcome.names[i]) for i in some]
    rows = np.append(some, len(found.states) - 1)  # with termination
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
    """The state variables that have links; all if there are none."""
    found = outcome.influences[key]
    n = len(outcome.names)
    out = (found.states > 0.0).any(axis=0) | (found.conditions > 0.0).any(axis=0) | (found.others[:, :n] > 0.0).any(axis=0)
    into = [(part[:n] > 0.0).any(axis=1) for part in (found.states, found.actions, found.others, found.conditions)]
    some: list[int] = np.flatnonzero(out | np.any(into, axis=0)).tolist()
    return some or list(range(n))


def _draw_map(axes: Axes, values: np.ndarray, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Draws a map; darkness grows with the square root, so that weak connections are visible."""
    axes.imshow(np.sqrt(values / max(values.max(), 1e-12)), cmap="Greys", vmin=0.0, vmax=1.0, interpolation="nearest")
    size = float(np.clip(520 / len(outputs), 2.6, 8.0))
    axes.set_xticks(range(len(inputs)), inputs, rotation=90, fontsize=size)
    axes.set_yticks(range(len(outputs)), outputs, fontsize=size)
    axes.tick_params(length=0)


def short(name: str) -> str:
    """A variable's name without the part that all names share."""
    return name.removeprefix("observation")
