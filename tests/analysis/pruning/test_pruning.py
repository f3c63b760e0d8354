"""The pruning experiment: what it compares with, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest

from mbagent.analysis.pruning.experiment import Outcome, Row, Settings, Task
from mbagent.analysis.pruning.page import write_page
from mbagent.analysis.pruning.truth import agreement, flier_catcher_dependencies
from mbagent.models.modules import Influence
from mbagent_envs import FlierCatcher
from scripts.pruning import main


def perfect(game: FlierCatcher) -> Influence:
    states, others = flier_catcher_dependencies(game)
    n = len(states)
    padded = np.zeros((n + 1, n + 1))
    padded[:n, :n] = others
    return Influence(np.vstack([states, np.zeros((1, n))]).astype(float), np.zeros((n + 1, 3)), padded, np.zeros((n + 1, n)))


def test_the_true_dependencies_are_those_that_the_rules_show() -> None:
    game, rng = FlierCatcher(height=3, width=4, spawn_rate=0.0), np.random.default_rng(0)
    states, _ = flier_catcher_dependencies(game)
    obs = game.initial(np.arange(20, dtype=np.uint64))
    obs[:, 1] = rng.integers(2, size=obs[:, 1].shape)
    keys = np.arange(20, dtype=np.uint64)
    for place in range(12, 24):  # fliers: every bit may be either
        other = obs.copy()
        other.reshape(20, -1)[:, place] ^= 1
        for action in range(3):
            actions = np.full(20, action)
            changed = game.transition(obs, actions, keys) != game.transition(other, actions, keys)
            assert np.array_equal(changed.reshape(20, -1).any(axis=0), states[:, place])


def test_a_perfect_model_agrees_with_the_truth() -> None:
    game = FlierCatcher()
    found = agreement(game, perfect(game))
    assert found[1:] == (1.0, 1.0, 1.0, 1.0)


def test_the_page_names_variables_and_modules(tmp_path: Path) -> None:
    settings, game = Settings(episodes=0, fractions=(0.0, 0.9)), FlierCatcher()
    names = tuple(f"observation[{i}]" for i in range(120))
    rows = [Row("flier_catcher", 1, share, 10, *([0.5] * 11)) for share in settings.fractions]
    maps = {share: perfect(game) for share in settings.fractions}
    lines = {share: [f"at {share}"] for share in settings.fractions}
    outcome = Outcome(Task("flier_catcher", 1, settings), names, game.action_names, rows, maps, lines, lines)
    pictures = write_page(tmp_path / "report.html", [outcome], settings, "command")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "at 0.9" in page
    assert "90% of the connections removed" in page
    assert {"flier_catcher_curves", "flier_catcher_paths_0", "flier_catcher_paths_1"} == set(pictures)


def test_mistakes_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--fractions", "1.0", "--output", str(tmp_path)]) == 1
    assert "up to but not 1" in capsys.readouterr().out
    assert main(["--games", "frozen_lake", "--output", str(tmp_path)]) == 1
    assert "none of this package's games" in capsys.readouterr().out
