"""Measures of forecasts against known answers, and a whole run on little data."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from forecast import main
from harness import joined
from mbagent.models import SimulatorModel, TrainingConfig
from mbagent_envs import FlierCatcher, GeyserRunner
from studies.forecasting import measures as m
from studies.forecasting.experiment import CASES, Score, Settings, cells, run_cell
from studies.forecasting.page import tables, write_page


def test_marginal_variation_is_the_mean_over_factors_of_total_variation() -> None:
    truth = np.array([[[0, 0], [1, 2], [0, 1], [1, 0]]])  # one case, four draws of a bit and of a factor with three values
    draws = np.array([[[1, 0], [1, 0], [1, 0], [1, 0]]])
    # The bit: |1 - 1/2|. The other: half of |1 - 1/2| + |0 - 1/4| + |0 - 1/4|.
    assert m.marginal_variation(draws, truth, (2, 3)) == pytest.approx((0.5 + 0.5) / 2)
    assert m.marginal_variation(truth, truth[:, ::-1], (2, 3)) == 0.0


def test_the_share_of_misses_looks_at_certain_cases_only() -> None:
    truth = np.zeros((40, 3, 2), dtype=np.int64)
    truth[30:, 0] = 1  # ten cases are uncertain
    draws = np.zeros((40, 4, 2), dtype=np.int64)
    draws[:15, 0, 1] = 1  # half of the certain cases miss in one of four draws
    assert m.inexact_share(draws, truth) == pytest.approx(0.125)
    assert np.isnan(m.inexact_share(draws[25:], truth[25:]))


def test_distributions_after_a_string_are_those_of_the_game() -> None:
    game = GeyserRunner(width=6, mode="deterministic")
    model = SimulatorModel(game)
    states = m.listed_states(model, model.start_states(64), 100)
    assert states is not None
    assert len(states) == 18
    matrices = m.transition_matrices(model, states)
    np.testing.assert_allclose(matrices.sum(axis=2), 1.0)
    starts, strings = np.arange(18), np.tile([2, 2, 0], (18, 1))
    after = m.follow(matrices, starts, strings)
    position = states[:, :6].argmax(axis=1)
    expected = np.clip(np.clip(position + 2, 0, 5) - 1, 0, 5)
    np.testing.assert_array_equal(position[after.argmax(axis=1)], expected)
    assert m.joint_variation(after, after) == pytest.approx(0.0)
    assert m.joint_variation(0.75 * after, after) == pytest.approx(0.25)  # the missing mass is on other states


def test_worlds_too_large_to_list_are_not_listed() -> None:
    geysers = SimulatorModel(GeyserRunner())
    assert m.listed_states(geysers, geysers.start_states(64), 20) is None
    fliers = SimulatorModel(FlierCatcher())
    assert m.listed_states(fliers, fliers.start_states(64), 300) is None


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    training = TrainingConfig(min_steps=20, max_steps=20)
    monkeypatch.setattr("mbagent.models.registry.TrainingConfig", lambda: training)
    monkeypatch.setattr("mbagent.models.registry.PLANE_TRAINING", training)


@pytest.mark.usefixtures("quick_fits")
def test_a_whole_run_becomes_one_page_and_one_table(tmp_path: Path) -> None:
    names = ("GeyserRunner, stochastic", "FlierCatcher")
    settings = Settings(names, steps=(1, 3), timesteps=250, seeds=1, n_starts=25, n_draws=5, episodes=0)
    results = joined(run_cell(cell) for cell in cells(settings))
    figure = write_page(tmp_path / "report.html", results, settings, "python scripts/forecast.py")
    assert figure.startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "A model for n" in page
    assert "http" not in page
    found = tables(results["results"], [])
    assert [(table.name, table.measure) for table in found] == [(names[0], "joint"), (names[1], "marginal")]
    joint = {(row["method"], row["n"]): row["joint"] for row in results["results"] if row["case"] == names[0]}
    assert joint["direct", 1] == joint["iterated", 1]  # both are the same model for one step
    assert joint["true again", 3] == 0.0
    assert [cell.case for cell in cells(Settings(seeds=1))] == list(reversed(CASES))


@pytest.mark.usefixtures("quick_fits")
def test_a_planner_plays_with_either_kind_of_forecasts() -> None:
    settings = Settings((CASES[0].name,), steps=(1, 2), timesteps=200, seeds=1, n_starts=5, n_draws=2, episodes=1)
    returns = run_cell(cells(settings)[0]).tables["returns"]
    assert [row["forecasts"] for row in returns] == ["iterated", "direct"]
    assert all(np.isfinite(row["value"]) for row in returns)


def test_a_measure_is_used_only_where_it_exists_for_every_score() -> None:
    scores = [asdict(Score(CASES[2].name, 0, "direct", n, np.nan, inexact, 0.1)) for n, inexact in ((1, 0.0), (2, np.nan))]
    assert tables(scores, [])[0].measure == "marginal"
    assert tables(scores[:1], [])[0].measure == "inexact"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--steps", "0"], "n = 1, 2"),
        (["--games", "Chess"], "no game 'Chess'"),
        (["--timesteps", "0"], "timesteps must be at least 100"),
        (["--n-draws", "1"], "n_draws must be at least 2"),
        (["--games"], "name at least one game"),
        (["--steps", "1", "100"], "at most 39 steps ahead"),
        (["--first-seed", "-1"], "first_seed must be at least 0"),
        (["--workers", "0"], "at least 1 process"),
    ],
)
def test_mistakes_get_one_sentence(wrong: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*wrong, "--output", str(tmp_path)]) == 1
    assert message in capsys.readouterr().out
