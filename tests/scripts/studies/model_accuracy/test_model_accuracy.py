"""Certain factors, and a complete small run."""

from pathlib import Path

import numpy as np
import pytest

from mbagent.models import SimulatorModel
from mbagent_envs import GeyserRunner, Maneuverer
from model_accuracy import main
from studies.model_accuracy.experiment import (
    CASES,
    certain_factors,
    joint_variation,
    likeliest_states,
    random_play,
)


def test_only_what_is_not_random_is_judged() -> None:
    geysers = SimulatorModel(GeyserRunner())
    order = np.random.default_rng(1).permutation(15)
    rows = random_play(GeyserRunner(), 300, 1, order)
    certain = certain_factors(geysers, rows, order, 1)
    assert not certain.any()  # a third of the factors, the geyser's position, is random
    maze = SimulatorModel(Maneuverer())
    rows = random_play(Maneuverer(), 1000, 1, np.arange(108))
    certain = certain_factors(maze, rows, np.arange(108), 1)
    new_layouts = (rows.states[:, :36] & rows.states[:, 72:]).any(axis=1)
    assert new_layouts.any()
    np.testing.assert_array_equal(certain.all(axis=1), ~new_layouts)


def test_the_true_model_makes_no_mistake() -> None:
    game = GeyserRunner(mode="deterministic")
    true, order = SimulatorModel(game), np.arange(15)
    rows = random_play(game, 500, 2, order)
    assert joint_variation(true, true, rows, order) == pytest.approx(0.0)
    np.testing.assert_array_equal(likeliest_states(true, rows), rows.next_states)
    assert len(np.unique(rows.episodes)) == 5


def test_a_small_run_is_written_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = ["GeyserRunner, deterministic", "GeyserRunner, stochastic"]
    options = ["--cases", *cases, "--models", "graphs", "--steps", "1000", "--n-tests", "500", "--studies"]
    assert main([*options, "--workers", "1", "--output", str(tmp_path)]) == 0
    assert len((tmp_path / "results.csv").read_text(encoding="utf-8").splitlines()) == 3
    assert "100.00%" in capsys.readouterr().out
    assert len(CASES) == 9


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (["--cases", "Chess"], "no case 'Chess'"),
        (["--models"], "at least one model"),
        (["--studies", "all"], "no study 'all'"),
        (["--models", "none"], "no model called 'none'"),
        (["--steps", "5"], "must be 100 or more"),
        (["--seeds", "0"], "seeds must be at least 1"),
        (["--workers", "0"], "at least 1 process"),
    ],
)
def test_mistakes_get_one_sentence(wrong: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*wrong, "--output", str(tmp_path / "new")]) == 1
    assert expected in capsys.readouterr().out.replace("\n", " ")
