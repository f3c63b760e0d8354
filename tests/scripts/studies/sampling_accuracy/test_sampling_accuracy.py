"""Samplers, scores and the page, on small data that is fitted quickly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness import joined, write_csv
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from sampling_accuracy import main
from studies.sampling_accuracy import experiment, samplers
from studies.sampling_accuracy.boltzmann import BoltzmannConfig
from studies.sampling_accuracy.data import DataOptions, generate
from studies.sampling_accuracy.experiment import Part, Settings, cells, run_cell
from studies.sampling_accuracy.measures import total_variation, valid_mass
from studies.sampling_accuracy.page import write_page
from studies.sampling_accuracy.results import (
    first_points,
    load_points,
    load_scores,
    load_settings,
    save_points,
    save_settings,
)
from studies.sampling_accuracy.samplers import COMBINED, PREDICTOR, FitOptions
from studies.sampling_accuracy.scores import Score, size
from studies.sampling_accuracy.summary import cell, paper_parameters, statements
from studies.sampling_accuracy.trials import find_trial

DATA = generate(DataOptions(3, 4), 0)


def test_the_perfect_sampler_is_perfect_and_its_draws_are_close() -> None:
    truth, model = samplers.observed(DATA), samplers.fit_table(DATA, prior=0.0)
    assert total_variation(truth, samplers.exact(model, DATA)) == pytest.approx(0.0, abs=1e-12)
    drawn = samplers.draw(model, DATA, 4000, seed=1)
    assert valid_mass(truth, drawn) == pytest.approx(1.0)
    assert total_variation(truth, drawn) < 0.05
    # Every probability is a multiple of 1 / c, so c systematic samples reproduce it exactly.
    assert total_variation(truth, samplers.draw_systematically(model, DATA, 4, 5)) == pytest.approx(0.0, abs=1e-12)
    assert total_variation(truth, samplers.draw(model, DATA, 4, 5)) > 0.1


def test_exact_probabilities_of_observed_outcomes_are_the_same_where_all_can_be_listed_or_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth, model = samplers.observed(DATA), samplers.fit_table(DATA, prior=1.0)
    every = samplers.exact(model, DATA)
    monkeypatch.setattr(samplers, "EXHAUSTIVE", 2)
    some = samplers.exact(model, DATA)
    assert every.complete
    assert not some.complete
    assert total_variation(truth, some) == pytest.approx(total_variation(truth, every))
    assert valid_mass(truth, some) == pytest.approx(valid_mass(truth, every))
    assert samplers.log_likelihood(truth, some) == pytest.approx(samplers.log_likelihood(truth, every))


def test_the_predictor_alone_is_the_combined_samplers_predictor() -> None:
    alone, combined = samplers.fit_paper(DATA, FitOptions(iterations=3), 0)
    nothing = np.zeros(len(DATA.inputs), dtype=np.int64)
    np.testing.assert_array_equal(alone.marginals(DATA.inputs, nothing), combined.marginals(DATA.inputs, nothing))
    assert not any(name.startswith("conditioner") for name in alone.state_dict())


@pytest.mark.parametrize(("targets", "iterations"), [("batch", 600), ("online", 120)])
def test_both_ways_of_training_learn(targets: str, iterations: int) -> None:
    truth = samplers.observed(DATA)

    def error(iterations: int) -> float:
        _, combined = samplers.fit_paper(DATA, FitOptions(iterations=iterations, targets=targets), 0)  # type: ignore[arg-type]
        return total_variation(truth, samplers.draw(combined, DATA, 400, 0))

    assert error(iterations) < error(1) - 0.1


def test_hidden_nodes_are_those_of_the_paper() -> None:
    for rounding, nodes in (("down", 16), ("up", 17)):
        config = samplers.paper_config(8, 320, FitOptions(rounding=rounding))  # type: ignore[arg-type]
        assert (config.hidden, config.group_size, config.training.batch_size) == ((17,), nodes, 80)
    # d = 2 by hand: 2 * 5 + 5 * 2 weights and 5 + 2 thresholds; 8 nodes with 2 + 1 inputs, threshold and output, and 2 more.
    assert paper_parameters(2) == (27, 42)


def test_means_leave_out_what_is_undefined_and_count_it() -> None:
    found = cell([1.0, 2.0, 3.0, float("nan")])
    assert (found.interval.estimate, found.undefined) == (2.0, 1)
    assert found.interval.low == pytest.approx(2.0 - 4.302653 / np.sqrt(3), abs=1e-5)  # t at 2 degrees of freedom
    assert cell([float("nan")]).undefined == 1


def score(trial: str, sampler: str, union: float, **more: float) -> Score:
    return Score(trial, 0, sampler, "many", union, 0.0, 0.0, 0.1, 0.9, at_zero=0.01, at_one=0.9, **more)  # type: ignore[arg-type]


def some_seeds(given: Score) -> list[Score]:
    """Three nearly equal data sets."""
    return [
        replace(given, seed=i, union=given.union + 0.001 * i, valid=given.valid + 0.001 * i, at_zero=0.01 + 0.001 * i)
        for i in range(3)
    ]


def test_the_papers_conclusions_hold_or_not_by_the_figures() -> None:
    early = f"{COMBINED}, {experiment.FEW_ITERATIONS} iterations"
    figures = {"1a": (0.8, 0.9), "1b": (0.5, 0.91), "2a": (0.4, 0.9), "2b": (0.3, 0.8), "2c": (0.4, 0.7), "3": (0.1, 0.5)}
    scores = [s for trial, (low, _) in figures.items() for s in some_seeds(score(trial, PREDICTOR, low))]
    scores += [s for trial, (_, high) in figures.items() for s in some_seeds(replace(score(trial, COMBINED, high), at_one=0.9))]
    scores += [s for trial in figures for s in some_seeds(replace(score(trial, early, 0.0), valid=0.5))]
    scores = [
        replace(s, union=s.union + 0.002 * s.seed, at_one=s.at_one + 0.001 * s.seed) if s.sampler == COMBINED else s
        for s in scores
    ]
    assert [statement.holds for statement in statements(scores)] == [True] * 6
    worse = [replace(s, union=0.2 + 0.01 * s.seed) if (s.trial, s.sampler) == ("2a", COMBINED) else s for s in scores]
    assert [statement.holds for statement in statements(worse)] == [False, True, True, False, True, True]


def test_a_conclusion_is_left_open_where_figures_do_not_tell() -> None:
    wide = [
        replace(score("1a", sampler, union), seed=i)
        for i, (low, high) in enumerate(((0.5, 0.9), (0.6, 0.5)))
        for sampler, union in ((PREDICTOR, low), (COMBINED, high))
    ]
    assert statements(wide)[0].holds is None
    single = [score("1a", PREDICTOR, 0.5), score("1a", COMBINED, 0.9)]
    found = statements(single)
    assert [statement.holds for statement in found] == [None] * 3
    assert np.isnan(cell([0.5]).interval.low)


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    training = TrainingConfig(min_steps=20, max_steps=20, validation=0.0)
    monkeypatch.setattr(samplers, "causal_config", lambda d: NeuralConfig(hidden=(8,), dropout=0.0, training=training))
    quick = BoltzmannConfig(min_steps=10, max_steps=10, burn_in=3)
    monkeypatch.setattr(samplers, "BoltzmannConfig", lambda **_: quick)


@pytest.mark.usefixtures("quick_fits")
def test_a_whole_run_becomes_one_page_and_one_table(tmp_path: Path) -> None:
    settings = Settings(trials=("1a", "1b"), seeds=1, n_draws=20, fit=FitOptions(iterations=2))
    results = [run_cell(cell) for cell in cells(settings)]
    rows, points = joined(results)["results"], first_points(results)
    write_csv(tmp_path / "results.csv", rows)
    save_points(tmp_path / "points.npz", points)
    again, points_again = load_scores(tmp_path / "results.csv"), load_points(tmp_path / "points.npz")
    assert [repr(score) for score in again] == [repr(Score(**row)) for row in rows]  # NaN equals itself here
    assert points_again.keys() == points.keys()
    changed = [replace(score("2a", name, 0.8), trial=t) for name in ("as scored", "one sweep") for t in ("2a", "3")]
    growing = [score(trial, COMBINED, 0.8, parameters=9, sample_microseconds=1.0) for trial in ("d = 2", "d = 4")]
    parts: dict[Part, list[Score]] = {"samplers": again, "variants": changed, "scaling": growing}
    write_page(tmp_path / "report.html", parts, points_again, settings, "python scripts/sampling_accuracy.py")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Trial 1a: d = 2, low correlation, c = 4, 4 inputs" in page
    assert "http" not in page
    lines = (tmp_path / "results.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + 2 * 18
    assert cells(Settings())[0].trial == "3"
    assert len(cells(Settings())) == 2 * 60 + 3 * 20 + 5
    assert find_trial("3").seeds == 5


def test_weights_are_counted_without_the_pruned_ones() -> None:
    _, combined = samplers.fit_paper(DATA, FitOptions(iterations=1), 0)
    # d = 3 and a fourth output, termination. Predictor: 4 inputs, 7 nodes. Conditioner: 6 nodes in each of 4 groups, each with
    # 4 inputs, 3 other outputs, a threshold and a weight to its output; 4 thresholds.
    assert size(combined) == (4 * 7 + 7) + (7 * 4 + 4) + 4 * 6 * (4 + 3 + 1 + 1) + 4


def test_settings_come_back_from_disk(tmp_path: Path) -> None:
    settings = Settings(("1b",), 2, n_draws=7, fit=FitOptions(sweeps=9))
    save_settings(tmp_path / "settings.json", settings)
    assert load_settings(tmp_path / "settings.json") == settings
    assert settings.measured() != Settings(("1b",), 2, n_draws=8, fit=FitOptions(sweeps=9)).measured()
    assert settings.measured() == Settings(("1a", "1b"), 5, n_draws=7, fit=FitOptions(sweeps=9)).measured()


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (["--trials", "9"], "no trial '9'"),
        (["--trials", "d = 2"], "no trial 'd = 2'"),
        (["--trials"], "nothing to measure"),
        (["--trials", "1a", "--parts", "variants"], "nothing to measure"),
        (["--seeds", "0"], "at least 1"),
        (["--first-seed", "-1"], "0 or more"),
        (["--n-draws", "0"], "between 1 and"),
        (["--multiplier", "0"], "multiplier b"),
        (["--workers", "0"], "at least 1 process"),
        (["--report-only"], "no results"),
    ],
)
def test_mistakes_get_one_sentence(wrong: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*wrong, "--output", str(tmp_path / "new")]) == 1
    assert expected in capsys.readouterr().out
    assert not (tmp_path / "new").exists()  # no run was started


def test_wrong_fit_options_are_told_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"fit.memory must lie in \[0, 1\)"):
        FitOptions(memory=2.0)
    with pytest.raises(SystemExit):
        main(["--fit.updates", "0"])
    assert "fit.updates must be at least 1" in capsys.readouterr().err


@pytest.mark.usefixtures("quick_fits")
def test_earlier_results_are_kept_or_gone_on_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--trials", "1a", "--n-draws", "9", "--fit.iterations", "1", "--workers", "1", "--output", str(tmp_path)]
    assert main([*options, "--seeds", "1"]) == 0
    first = (tmp_path / "results.csv").read_text(encoding="utf-8")
    assert main([*options, "--seeds", "2", "--resume"]) == 0
    assert (tmp_path / "results.csv").read_text(encoding="utf-8").startswith(first)
    assert main([*options, "--seeds", "2", "--resume", "--n-draws", "8"]) == 1
    assert "other options" in capsys.readouterr().out
    assert main(["--report-only", "--relates", "input", "--output", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "9 draws an input" in page
    assert "the output variable set before it" in page  # the settings of the measurement, not those of this command
    both = (tmp_path / "results.csv").read_text(encoding="utf-8")
    assert main([*options, "--seeds", "1"]) == 0
    assert (tmp_path / "earlier-1" / "results.csv").read_text(encoding="utf-8") == both
    (tmp_path / "results.csv").write_text(first[: len(first) // 2], encoding="utf-8")
    assert main([*options, "--seeds", "1", "--resume"]) == 1
    assert "line" in capsys.readouterr().out
