"""Writes the README's tables of results from the files of the comparison, sampling accuracy and pruning studies.

python scripts/results_table.py --results results/compare/results.csv --accuracy results/sampling_accuracy/results.csv
"""

from __future__ import annotations

import csv
import re
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from mbagent import files
from mbagent.evaluation.report import Table
from mbagent.evaluation.statistics import interquartile_mean
from studies.comparison.records import AGENT, LEARNED_REWARD, TRUE_MODEL
from studies.external import markdown_table as external_table
from studies.pruning.page import markdown_table as pruning_table
from studies.sampling_accuracy.results import load_scores
from studies.sampling_accuracy.summary import markdown_table
from worlds.games import CASES

COLUMNS = {"learned model": AGENT, "reward learned too": LEARNED_REWARD, "true model": TRUE_MODEL}
BASELINES = ("PPO", "DQN", "A2C")


@dataclass(frozen=True)
class Args:
    """Write the README's tables of results; a table whose file does not exist is not changed."""

    results: Path = Path("results/compare/results.csv")
    """Results of scripts/compare_agents.py."""
    accuracy: Path = Path("results/sampling_accuracy/results.csv")
    """Results of scripts/sampling_accuracy.py."""
    pruning: tuple[Path, ...] = (Path("results/pruning/summary.csv"),)
    """Results of scripts/pruning.py, in one or more files."""
    external: tuple[Path, ...] = (Path("results/external/results.csv"),)
    """Results of scripts/external_benchmark.py; the last file with a world and an agent is used for them."""
    baselines: Path | None = None
    """File with the baselines' rows, if separate."""
    readme: Path = Path("README.md")
    """File in which the tables are placed between the marks <!-- results -->, <!-- accuracy --> and <!-- pruning -->."""
    environments: Path = Path("docs/environments.md")
    """Likewise <!-- external -->."""


Scores = dict[tuple[str, str, str], list[float]]


def read(path: Path) -> Scores:
    """Normalised return of each training by (case, agent, goal), without points of learning curves and longer trainings."""
    scores: Scores = defaultdict(list)
    steps: dict[tuple[str, str, str], int] = {}
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            key, n = (row["case"], row["agent"], row["goal"]), int(row["environment_steps"])
            if row["curve_point"] in ("1", "True") or n > steps.setdefault(key, n):
                continue
            scores[key].append(float(row["normalised_return"]))
    return scores


def score(values: Sequence[float]) -> str:
    """Interquartile mean over trainings, to two digits."""
    return f"{float(interquartile_mean(values)):.2f}" if values else "–"


def new_goals(scores: Scores, case: str) -> str:
    """Mean score of the learned model as a share of the true model's; the lowest over the new goals of a case."""
    goals = {goal for found, agent, goal in scores if found == case and agent == TRUE_MODEL and goal != "default"}
    shares = [statistics.fmean(scores[case, AGENT, goal]) / statistics.fmean(scores[case, TRUE_MODEL, goal]) for goal in goals]
    return f"{min(shares):.2f}" if shares else "–"


def table(scores: Scores, others: Scores) -> str:
    """The table, as Markdown."""
    names = [*COLUMNS, *BASELINES, "worst new goal"]
    lines = []
    for case in CASES:
        cells = [score(scores.get((case.key, agent, "default"), [])) for agent in COLUMNS.values()]
        cells += [score(others.get((case.key, agent, "default"), [])) for agent in BASELINES]
        lines.append([case.title, *cells, new_goals(scores, case.key)])
    return Table(["", *names], lines).markdown()


def _fill(document: Path, tables: Mapping[str, str]) -> None:
    """Replaces the text between the marks of each table."""
    text = document.read_text(encoding="utf-8")
    for name, filled in tables.items():
        mark = f"<!-- {name} -->"
        text = re.sub(f"{mark}.*{mark}", f"{mark}\n{filled}\n{mark}", text, flags=re.DOTALL)
    files.write(document, text)


def main(args: Args) -> None:
    """Writes the tables to the documents."""
    tables = {}
    if args.results.exists():
        scores = read(args.results)
        tables["results"] = table(scores, read(args.baselines) if args.baselines else scores)
    if args.accuracy.exists():
        tables["accuracy"] = markdown_table(load_scores(args.accuracy))
    if all(path.exists() for path in args.pruning):
        tables["pruning"] = pruning_table(args.pruning)
    _fill(args.readme, tables)
    if all(path.exists() for path in args.external):
        _fill(args.environments, {"external": external_table(args.external)})
        tables["external"] = ""
    Console().print(f"Wrote {' and '.join(tables) or 'nothing: no file exists'} to the documents.")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
