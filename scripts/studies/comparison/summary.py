"""Summary of the records of single trainings in tables and learning curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mbagent.evaluation.statistics import Interval, interquartile_interval, normalised, ratio_interval
from studies.comparison.jobs import all_goals
from studies.comparison.plan import BASELINES, Settings
from studies.comparison.records import AGENT, LEARNED_REWARD, RANDOM, REFERENCE, TRUE_MODEL, Record, write_csv
from worlds.games import Case, find_case
from worlds.known_rules import Scale


@dataclass(frozen=True)
class Row:
    """One agent's row in the table of a case, over all its seeds.

    Attributes:
        agent: its name, with the steps if they differ from those of the case.
        steps: environment steps used for learning.
        score: interquartile mean of the normalised return, with its interval.
        mean_return: mean of the undiscounted return.
        learn_seconds: mean wall time of learning.
        decision_ms: median milliseconds per decision.
        seeds: number of trainings.
        episodes: evaluation episodes over all of them.
    """

    agent: str
    steps: int
    score: Interval
    mean_return: float
    learn_seconds: float
    decision_ms: float
    seeds: int
    episodes: int


@dataclass(frozen=True)
class GoalRow:
    """One goal's row in the change-of-goal table.

    Attributes:
        goal: its name.
        random: mean return of random play.
        learned: mean return of the agent with its learned model.
        true_model: mean return of the same planner with the true model.
        reference: mean return of the reference player, NaN if there is none.
        ratio: (learned - random) / (true_model - random).
        weights_unchanged: whether the model's weights are byte for byte the same as before the goal was given.
        weights: hash of the weights of the first seed.
        seeds: number of trainings.
        episodes: evaluation episodes over all of them.
    """

    goal: str
    random: float
    learned: float
    true_model: float
    reference: float
    ratio: Interval
    weights_unchanged: bool
    weights: str
    seeds: int
    episodes: int


@dataclass(frozen=True)
class CaseResult:
    """All results of a case.

    Attributes:
        case: the case.
        scale: returns that correspond to 0 and 1.
        rows: its table, one row for each agent.
        curves: learning curves [(agent, [(steps, mean, lowest, highest normalised return)])].
        goals: its change-of-goal table; empty if the experiment was not run.
    """

    case: Case
    scale: Scale
    rows: list[Row]
    curves: list[tuple[str, list[tuple[int, float, float, float]]]]
    goals: list[GoalRow]


def summarise(records: Sequence[Record], settings: Settings) -> list[CaseResult]:
    """Summarises records in tables and curves, case by case."""
    results = []
    for case in map(find_case, settings.cases):
        mine = [r for r in records if r.case == case.key]
        scale = _best_scale(case, mine, _measured(mine, "default"))
        steps = case.steps(settings.steps)
        rows = [row for name in _order() for row in _rows(name, mine, scale, steps)]
        results.append(CaseResult(case, scale, rows, _curves(mine, scale), _goal_rows(case, mine)))
    return results


def _order() -> tuple[str, ...]:
    return (AGENT, LEARNED_REWARD, TRUE_MODEL, *BASELINES, RANDOM)


def _measured(records: Sequence[Record], goal: str) -> Scale:
    """The scale measured by the comparison for a goal."""
    record = next(r for r in records if r.agent == REFERENCE and r.goal == goal)
    return Scale(record.extra["random"], record.mean)


def _best_scale(case: Case, records: Sequence[Record], scale: Scale) -> Scale:
    """If the reference is not a proven optimum, the planner on the true model replaces it if it is better."""
    planned = [r.mean for r in records if r.agent == TRUE_MODEL and r.goal == "default"]
    if case.exact or not planned:
        return scale
    return Scale(scale.random, max(scale.reference, float(np.mean(planned))))


def _final(records: Sequence[Record], agent: str, goal: str = "default") -> dict[int, list[Record]]:
    """The records of one agent and goal by environment steps, seeds in order."""
    found: dict[int, list[Record]] = {}
    for r in sorted(records, key=lambda r: (r.steps, r.seed)):
        if r.agent == agent and r.goal == goal and not r.curve_point:
            found.setdefault(r.steps, []).append(r)
    return found


def _rows(agent: str, records: Sequence[Record], scale: Scale, steps: int) -> list[Row]:
    rows = []
    for used, group in _final(records, agent).items():
        scores = normalised([r.returns for r in group], scale.random, scale.reference)
        rows.append(
            Row(
                agent=f"{agent}, {used / steps:.0f} times the steps" if used > 1.5 * steps else agent,
                steps=used,
                score=interquartile_interval(scores),
                mean_return=float(np.mean([r.mean for r in group])),
                learn_seconds=float(np.mean([r.learn_seconds for r in group])),
                decision_ms=float(np.median([r.decision_ms for r in group])),
                seeds=len(group),
                episodes=scores.size,
            )
        )
    return rows


def _curves(records: Sequence[Record], scale: Scale) -> list[tuple[str, list[tuple[int, float, float, float]]]]:
    curves = []
    for agent in (AGENT, LEARNED_REWARD, *BASELINES):
        points: dict[int, list[float]] = {}
        mine = [r for r in records if r.agent == agent and r.goal == "default"]
        longest = max((r.steps for r in mine if r.curve), default=0)
        for r in mine:
            if r.curve and r.steps == longest:
                for steps, mean in r.curve:
                    points.setdefault(steps, []).append(mean)
            elif not r.curve and agent not in BASELINES:
                points.setdefault(r.steps, []).append(r.mean)
        scaled = [(steps, normalised(means, scale.random, scale.reference)) for steps, means in sorted(points.items())]
        if len(scaled) > 1:  # a single point is not a curve
            curves.append((agent, [(s, float(v.mean()), float(v.min()), float(v.max())) for s, v in scaled]))
    return curves


def _goal_rows(case: Case, records: Sequence[Record]) -> list[GoalRow]:
    rows = []
    for goal in all_goals(case)[1:]:
        learned, true_model = (_final_all(records, name, goal) for name in (AGENT, TRUE_MODEL))
        if not learned or not true_model:
            continue
        scale = _measured(records, goal)
        top = float(np.mean([r.mean for r in true_model]))
        hashes = {r.seed: r.weights_before for r in _final_all(records, AGENT)}
        rows.append(
            GoalRow(
                goal=goal,
                random=scale.random,
                learned=float(np.mean([r.mean for r in learned])),
                true_model=top,
                reference=scale.reference,
                ratio=_ratio(learned, true_model, scale.random),
                weights_unchanged=all(r.weights_before == r.weights_after == hashes[r.seed] for r in learned),
                weights=learned[0].weights_after,
                seeds=len(learned),
                episodes=sum(len(r.returns) for r in learned),
            )
        )
    return rows


def _ratio(learned: Sequence[Record], true_model: Sequence[Record], random: float) -> Interval:
    """(learned - random) / (true model - random), over the seeds of both; their episodes use the same random numbers."""
    against = {r.seed: r.returns for r in true_model}
    pairs = [(r.returns, against[r.seed]) for r in learned if r.seed in against]
    if not pairs or not np.mean([theirs for _, theirs in pairs]) > random:
        return Interval(math.nan, math.nan, math.nan)
    ours, theirs = zip(*pairs, strict=True)
    return ratio_interval(ours, theirs, random)


def _final_all(records: Sequence[Record], agent: str, goal: str = "default") -> list[Record]:
    """The records of one agent on one goal, without points of learning curves."""
    return [r for group in _final(records, agent, goal).values() for r in group]


def save_csv(path: Path, records: Sequence[Record], results: Sequence[CaseResult]) -> None:
    """Writes ``results.csv`` with a line for each record; new goals are normalised by the planner on the true model."""
    scales: dict[tuple[str, str], tuple[float, float]] = {}
    for result in results:
        scales[result.case.key, "default"] = (result.scale.random, result.scale.reference)
        for row in result.goals:
            scales[result.case.key, row.goal] = (row.random, row.true_model)
    write_csv(path, [r for r in records if r.agent != REFERENCE], scales)
