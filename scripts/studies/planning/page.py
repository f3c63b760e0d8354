"""The tables and the picture that the benchmark of planning ends in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from mbagent.evaluation.figures import Line, Panel, draw_panels
from mbagent.evaluation.report import Card, Page, Section, Table, format_number

Row: TypeAlias = Mapping[str, Any]

TITLES = {
    "quality": "How well agents play with the default settings",
    "crowds": "Worlds of many noisy variables, too large to solve",
    "decisions": "What a decision costs beside a forward pass of PPO",
    "start": "The first decision of a new process",
    "memory": "Memory over many decisions",
    "regret": "What searches lose, against the number of simulations",
    "speed": "Speed of searches on a table",
    "naive": "One sampled next state: the naive procedure and the compiled samplers",
    "short cut": "Resampling only what is uncertain",
    "networks": "Searches through learned networks",
    "equal regret": "Searches through learned networks: processor time to regret as low as mctx's",
}
"""What each table is called."""

NOTES = {
    "quality": "Normalised return: 0 random play, 1 the optimum or the best player known; interquartile mean over agents and "
    "episodes, with its bootstrap interval. Of tables the exact value of what the agent does.",
    "crowds": "Return of 40 steps, true rules, mean over 16 episodes with its standard error; lookahead: the default planner "
    "without learned values. What is done once for a goal is timed apart.",
    "decisions": "Median processor time on one core about single observations, none met twice. The reward is the game's own, or "
    "the same as a plain Python function; what is done once for a goal (the reachable machine, if it is small) is timed apart.",
    "start": "Processor time in a new process, after imports, with everything compiled by an earlier one. The first decision "
    "holds what is done once for a goal.",
    "memory": "Memory that the process holds after a tenth of the decisions and in the end.",
    "regret": "Random worlds of 25 states and 4 actions with exact values known; every search gets the same crude leaf values "
    "(exact value plus noise as large as the values' spread), but for searches by random play. 1 is what a random action loses, "
    "0 is perfect; error: standard error over worlds. At most 15 steps deep in mctx.",
    "speed": "Processor time on one core, the median of several calls. Only ratios within one run mean something. A "
    "simulation of mbagent's search on a known machine is at most 3 steps, with the machine's own probabilities; with random "
    "play it goes on to the horizon; a peer's ends where its tree does. A node of "
    "chance is a simulation of its own in Stochastic MuZero.",
    "naive": "Microseconds of processor time for one state. Naive: a full forward pass of predictor and conditioner in torch for "
    "every variable. bar: the ratio asked for.",
    "short cut": "Full: all variables redrawn in every sweep; short: those to which the predictor gives between 2% and 98%, and "
    "of the others those whose random number lies so far out that the conditioner could matter. begun: what both begin with. "
    "uncertain: variables between 2% and 98%; (d + 1) / uncertain is the most that could be saved. Total variation between "
    "the two is at most same_luck, the share of whole next states that differ under the same random numbers; bound: its 95% "
    "limit. joint and pairs: estimates from frequencies with other random numbers; floor: the same estimate for two runs of the "
    "full sweep, whose total variation is 0. Means over inputs.",
    "networks": "GeyserRunner with 30 bits, learned: the same predictor and causal conditioner for both. Regret against exact "
    "values of the true game: with its own goal, and with a random income in each column (mean over goals); 1 is what a random "
    "action loses. Times of a decision, from one root and from 16 at once. mctx draws a next state in every simulation; mbagent "
    "keeps what it has imagined of a state, and searches on in it. Pruned: the same networks, at least nine in ten "
    "connections gone, compiled to what is left.",
    "equal regret": "The cheapest effort of mbagent that loses no more than mctx with a budget under the random goals.",
}
"""What each table's figures mean."""

COLOURS = ("#0b6e4f", "#58b368", "#d1495b", "#edae49", "#3b7ea1", "#9aa5b1")
"""The library's own searches come first."""


def shown(value: Any) -> str:
    """A cell of a table."""
    if isinstance(value, float):
        return format_number(value, 4 if abs(value) < 1 else 2 if abs(value) < 100 else 0)
    return f"{value:,}" if isinstance(value, int) else str(value)


def draw_regret(rows: Sequence[Row]) -> bytes:
    """Regret against simulations for each search, a panel for each kind of world."""
    searches = list(dict.fromkeys(row["search"] for row in rows))
    ticks = {n: f"{n}" for n in sorted({row["simulations"] for row in rows})}
    panels: list[Panel] = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        lines = []
        for i, search in enumerate(searches):
            own = [row for row in rows if (row["kind"], row["search"]) == (kind, search)]
            x, y, error = ([row[name] for row in own] for name in ("simulations", "regret", "error"))
            lines.append(Line(x, y, COLOURS[i % len(COLOURS)], search, error))
        y_label = "" if panels else "regret (random action: 1)"
        panels.append(Panel(f"{kind} rewards", lines, "simulations", y_label, "log2", y_limits=(0.0, None), x_ticks=ticks))
    return draw_panels(panels, size=(4.2, 2.9))


def write_page(path: Path, tables: Mapping[str, Sequence[Row]], command: str) -> dict[str, bytes]:
    """Writes the page with everything measured; returns its pictures by name.

    Args:
        path: of the page.
        tables: rows by name, see ``TITLES``; empty ones are left out.
        command: that was run.
    """
    full = {name: list(tables[name]) for name in TITLES if tables.get(name)}
    pictures = {"regret": draw_regret(full["regret"])} if "regret" in full else {}
    sections = [
        Section(TITLES[name], [Card(figure=pictures.get(name), table=Table.of(rows, shown), notes=[NOTES[name]])])
        for name, rows in full.items()
    ]
    intro = "Every table is of one run on one machine."
    Page("Planning", "Speed and quality of planning and sampling", intro, sections, command, {}).write(path)
    return pictures
