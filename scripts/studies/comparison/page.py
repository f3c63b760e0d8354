"""One self-contained HTML page that explains a comparison to a newcomer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gymnasium.error import DependencyNotInstalled

from mbagent import files
from mbagent.evaluation.baselines import BASELINE_SETTINGS
from mbagent.evaluation.report import render
from mbagent.evaluation.statistics import Interval
from studies import TEMPLATES
from studies.comparison.figures import colour_of, draw_curves, draw_game, draw_scores
from studies.comparison.plan import Settings
from studies.comparison.records import AGENT, LEARNED_REWARD
from studies.comparison.summary import CaseResult
from worlds.games import Case


def write_report(path: Path, results: Sequence[CaseResult], settings: Settings, *, command: str, minutes: float) -> None:
    """Writes the page with embedded pictures into one file.

    Args:
        path: the file.
        results: results of ``summarise``.
        settings: settings of the comparison.
        command: the command line that reproduces the page.
        minutes: wall time of the whole comparison.
    """
    page = render(
        TEMPLATES / "report.html.jinja",
        {"colour": colour_of},
        results=results,
        settings=settings,
        command=command,
        minutes=minutes,
        scores=draw_scores(results),
        curves=draw_curves(results) if any(result.curves for result in results) else None,
        pictures={result.case.key: _picture(result.case) for result in results},
        headline=_headline(results),
        baseline_settings={name: _words(options) for name, options in BASELINE_SETTINGS.items()},
        agents={"agent": AGENT, "learned_reward": LEARNED_REWARD},
        arguments={result.case.key: _words(result.case.world.kwargs) for result in results},
    )
    files.write(path, page)


def _picture(case: Case) -> bytes | None:
    """A picture of the case; None if drawing it needs a package that is not installed."""
    try:
        return draw_game(case)
    except DependencyNotInstalled:
        return None


def _words(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in options.items())


def _headline(results: Sequence[CaseResult]) -> list[tuple[str, Interval]]:
    """Each case with the score of this package's agent, with the given reward if the case allows it."""
    found = []
    for result in results:
        for name in (AGENT, LEARNED_REWARD):
            scores = [row.score for row in result.rows if row.agent == name]
            if scores:
                found.append((result.case.title, scores[0]))
                break
    return found
