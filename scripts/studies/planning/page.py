"""The tables and the picture of the planning benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from mbagent.evaluation.figures import Line, Panel, draw_panels
from mbagent.evaluation.report import Card, Page, Section, Table, format_number

Row: TypeAlias = Mapping[str, Any]

TITLES = {
    "quality": "How well agents play with the default settings",
    "crowds": "Many noisy variables, too large to solve",
    "decisions": "Cost of a decision compared with a forward pass of PPO",
    "start": "The first decision of a new process",
    "memory": "Memory over many decisions",
    "regret": "Regret of searches against the number of simulations",
    "speed": "Speed of searches in tabular MDPs",
    "naive": "One sampled next state: the naive procedure and the compiled samplers",
    "short cut": "Resampling of the uncertain variables only",
    "networks": "Searches with learned networks",
    "equal regret": "Searches with learned networks: processor time to the same regret as mctx",
}
"""Titles of the tables."""

NOTES = {
    "quality": "Normalised return: 0 is random play, 1 the optimum or the best known player; interquartile mean over agents and "
    "episodes, with its bootstrap interval. For tabular MDPs, the exact value of the agent's policy.",
    "crowds": "Return of 40 steps, true rules, mean over 16 episodes with its standard error; lookahead: the default planner "
    "without fitted leaf values. Work done once per goal is timed separately.",
    "decisions": "Median processor time on one core for single, distinct observations. The reward is the game's own, or an "
    "equivalent plain Python function; work done once per goal (the reachable MDP, if it is small) is timed separately.",
    "start": "Processor time in a new process, after imports, with everything compiled by an earlier one. The first decision "
    "includes the work done once per goal.",
    "memory": "Memory of the process after a tenth of the decisions and at the end.",
    "regret": "Random MDPs with 25 states, 4 actions and known exact values; all searches get the same crude leaf values (exact "
    "values plus noise of the same standard deviation), except the default of mbagent, which solves the MDP, and those with "
    "random play at leaves. 1 is the regret of a random action, "
    "0 is perfect; error: standard error over MDPs. The depth in mctx is at most 15 steps.",
    "speed": "Processor time of a decision on one core, the median of several calls. Only ratios within one run are meaningful. "
    "mbagent solves an MDP of this size once for each goal, and then simulates nothing. A simulation of its search continues "
    "until an unexpanded state or 20 steps, with random play at leaves always to the horizon; a peer's ends at the leaf of its "
    "tree. In Stochastic MuZero, a chance node takes a simulation of its own.",
    "naive": "Microseconds of processor time per state. Naive: a full forward pass of predictor and conditioner in torch for "
    "every variable. bar: the required ratio.",
    "short cut": "Full: all variables are resampled in every sweep; short: only those with predicted probabilities between 2% "
    "and 98%, and others with random numbers so extreme that the conditioner could matter. begun: the initial work of both. "
    "uncertain: variables between 2% and 98%; (d + 1) / uncertain bounds the possible speed-up. Total variation between "
    "the two is at most same_luck, the share of whole next states that differ with the same random numbers; bound: its 95% "
    "limit. joint and pairs: estimates from frequencies with other random numbers; floor: the same estimate for two runs of the "
    "full sweep, whose total variation is 0. Means over inputs.",
    "networks": "GeyserRunner with 30 bits, learned: the same predictor and causal conditioner for both. Regret against exact "
    "values of the true game: with its own goal, and with random rewards of the columns (mean over goals); 1 is the regret of a "
    "random action. Times per decision, for one root and for 16 at once. mctx samples a next state in every simulation; mbagent "
    "keeps the expanded successors of a state and searches in them. Pruned: the same networks without at least nine in ten "
    "connections, compiled to truth tables.",
    "equal regret": "The cheapest effort of mbagent with no more regret than mctx with a given budget, under the random goals.",
}
"""Explanations of the tables."""

COLOURS = ("#0b6e4f", "#58b368", "#d1495b", "#edae49", "#3b7ea1", "#9aa5b1")
"""Sort key that places the library's own searches first."""


def shown(value: Any) -> str:
    """Formats a cell of a table."""
    if isinstance(value, float):
        return format_number(value, 4 if abs(value) < 1 else 2 if abs(value) < 100 else 0)
    return f"{value:,}" if isinstance(value, int) else str(value)


def draw_regret(rows: Sequence[Row]) -> bytes:
    """Plots regret against simulations for each search, with a panel for each kind of MDP."""
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
    """Writes the page with all results; returns its pictures by name.

    Args:
        path: path of the page.
        tables: rows by name, see ``TITLES``; empty ones are skipped.
        command: the command line that was run.
    """
    full = {name: list(tables[name]) for name in TITLES if tables.get(name)}
    pictures = {"regret": draw_regret(full["regret"])} if "regret" in full else {}
    sections = [
        Section(TITLES[name], [Card(figure=pictures.get(name), table=Table.of(rows, shown), notes=[NOTES[name]])])
        for name, rows in full.items()
    ]
    intro = "The values of each table are from one run on one machine."
    Page("Planning", "Speed and quality of planning and sampling", intro, sections, command, {}).write(path)
    return pictures
