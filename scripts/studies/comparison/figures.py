"""The report's pictures: learning curves, bars of normalised returns, and one picture of each game."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mbagent.evaluation.figures import FIGURE_STYLE, Line, Panel, draw_panels, to_png
from mbagent_envs.references import reference_policy
from studies.comparison.records import AGENT, LEARNED_REWARD, RANDOM, TRUE_MODEL
from studies.comparison.summary import CaseResult
from worlds.games import Case

COLOURS = {
    AGENT: "#0b6e4f",
    LEARNED_REWARD: "#58b368",
    TRUE_MODEL: "#9aa5b1",
    "PPO": "#d1495b",
    "DQN": "#edae49",
    "A2C": "#3b7ea1",
    RANDOM: "#c9ced6",
}
"""Colour of each agent in all pictures."""


def colour_of(agent: str) -> str:
    """The colour of an agent; any text after a comma in its name is ignored."""
    return COLOURS.get(agent) or next((colour for name, colour in COLOURS.items() if agent.startswith(name + ",")), "#555555")


def draw_scores(results: Sequence[CaseResult]) -> bytes:
    """Bars of the normalised return of each agent on each case, with 95% intervals."""
    agents = [name for name in COLOURS if any(row.agent == name for result in results for row in result.rows)]
    agents = [name for name in agents if name != RANDOM]  # zero by definition
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(max(6.5, 1.9 * len(results)), 3.6))
        axes = figure.subplots()
        width = 0.84 / max(len(agents), 1)
        for place, name in enumerate(agents):
            for column, result in enumerate(results):
                for row in result.rows:
                    if row.agent == name:
                        x = column + (place - (len(agents) - 1) / 2) * width
                        _draw_bar(axes, x, width, row.score.estimate, row.score.low, row.score.high, COLOURS[name])
        _lines_of_the_scale(axes)
        axes.set_xticks(range(len(results)), [result.case.title.replace(", ", "\n") for result in results])
        axes.tick_params(axis="x", length=0)
        axes.set_ylabel("normalised return")
        axes.set_ylim(-0.15, 1.12)
        handles = [mpl.patches.Patch(color=COLOURS[name], label=name) for name in agents]
        figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=3, frameon=False)
        return to_png(figure)


def _draw_bar(axes: Axes, x: float, width: float, height: float, low: float, high: float, colour: str) -> None:
    shown = float(np.clip(height, -0.15, None))
    axes.bar(x, shown, width=0.9 * width, color=colour)
    axes.plot([x, x], [low, high], color="#2b323b", linewidth=1, clip_on=True)


def _lines_of_the_scale(axes: Axes) -> None:
    """Draws lines for random play at 0 and the reference at 1."""
    axes.axhline(0, color="#b8bfc8", linewidth=1)
    axes.axhline(1, color="#b8bfc8", linewidth=1, linestyle=(0, (4, 3)))


def draw_curves(results: Sequence[CaseResult]) -> bytes:
    """Normalised return against environment steps for each case; bands extend from the worst to the best seed."""
    panels = []
    for number, result in enumerate(results):
        lines = [Line((), [0.0], "#b8bfc8"), Line((), [1.0], "#b8bfc8", style="--")]
        for agent, points in sorted(result.curves, key=lambda curve: list(COLOURS).index(curve[0])):
            steps, mean, low, high = zip(*points, strict=True)
            thousands, marker = [n / 1000 for n in steps], "o" if agent in (AGENT, LEARNED_REWARD) else ""
            lines.append(Line(thousands, mean, colour_of(agent), agent, band=(low, high), marker=marker))
        y_label = "" if number % 3 else "normalised return"
        panels.append(Panel(result.case.title, lines, "environment steps, thousands", y_label, y_limits=(-0.2, 1.12)))
    return draw_panels(panels, size=(3.6, 2.7), columns=3)


def draw_game(case: Case, steps: int = 25, seed: int = 3) -> bytes:
    """A picture of a case after the reference player has played for some steps."""
    env = case.make_env(render_mode="rgb_array")
    game = case.game
    policy = None if game is None else reference_policy(game)
    env.action_space.seed(seed)
    obs, _ = env.reset(seed=seed)
    for _ in range(steps if policy is not None else 0):
        assert policy is not None
        obs, _, terminated, truncated, _ = env.step(int(policy(obs[None])[0]))
        if terminated or truncated:
            obs, _ = env.reset()
    picture: Any = env.render()
    env.close()
    return picture_to_png(np.asarray(picture, dtype=np.uint8))


def picture_to_png(picture: NDArray[np.uint8]) -> bytes:
    """Pixels uint8 [H, W, 3] as the bytes of a PNG file."""
    buffer = io.BytesIO()
    mpl.image.imsave(buffer, picture, format="png")
    return buffer.getvalue()
