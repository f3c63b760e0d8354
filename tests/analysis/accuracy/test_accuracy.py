"""Samplers, scores and the page, on data small enough to fit in moments."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mbagent.analysis.accuracy import experiment, samplers
from mbagent.analysis.accuracy.data import DataOptions, generate
from mbagent.analysis.accuracy.experiment import Outcome, Part, Settings, plan, run_task
from mbagent.analysis.accuracy.measures import total_variation, valid_mass
from mbagent.analysis.accuracy.page import write_page
from mbagent.analysis.accuracy.results import first_points, load_points, load_scores, save_points, save_scores
from mbagent.analysis.accuracy.samplers import COMBINED, PREDICTOR, FitOptions
from mbagent.analysis.accuracy.scores import Score
from mbagent.analysis.accuracy.summary import cell, paper_parameters, statements
from mbagent.analysis.accuracy.trials import find_trial
from mbagent.models.boltzmann import BoltzmannConfig
from mbagent.models.config import NeuralConfig
from mbagent.models.training import TrainingConfig
from scripts.sampling_accuracy import main

DATA = generate(DataOptions(3, 4), 0)


def test_the_perfect_sampler_is_perfect_and_its_draws_are_close() -> None:
    truth, model = samplers.observed(DATA), samplers.fit_table(DATA, prior=0.0)
    assert total_variation(truth, samplers.exact(model, DATA)) == pytest.approx(0.0, abs=1e-12)
    drawn = samplers.draw(model, DATA, 4000, seed=1)
    assert valid_mass(truth, drawn) == pytest.approx(1.0)
    assert total_variation(truth, drawn) < 0.05
    # Every probability is a multiple of 1 / c, so c systematic draws hit it exactly.
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
    for rounding, size in (("down", 16), ("up", 17)):
        config = samplers.paper_config(8, 320, FitOptions(rounding=rounding))  # type: ignore[arg-type]
        assert (config.hidden, config.group_size, config.training.batch_size) == ((17,), size, 80)
    # d = 2 by hand: 2 * 5 + 5 * 2 weights and 5 + 2 thresholds; 8 nodes with 2 + 1 inputs, threshold and output, and 2 more.
    assert paper_parameters(2) == (27, 42)


def test_means_leave_out_what_is_undefined_and_count_it() -> None:
    found = cell([1.0, 2.0, 3.0, float("nan")])
    assert (found.interval.estimate, found.undefined) == (2.0, 1)
    assert found.interval.low == pytest.approx(2.0 - 4.302653 / np.sqrt(3), abs=1e-5)  # t at 2 degrees of freedom
    assert cell([float("nan")]).undefined == 1


def score(trial: str, sampler: str, union: float, **more: float) -> Score:
    return Score(trial, 0, sampler, "many", union, 0.0, 0.0, 0.1, 0.9, at_zero=0.01, at_one=0.9, **more)  # type: ignore[arg-type]


def test_the_papers_conclusions_hold_or_not_by_the_figures() -> None:
    early = f"{COMBINED}, {experiment.FEW_ITERATIONS} iterations"
    figures = {"1a": (0.8, 0.9), "1b": (0.5, 0.9), "2a": (0.4, 0.9), "2b": (0.3, 0.8), "2c": (0.4, 0.7), "3": (0.1, 0.5)}
    scores = [score(trial, PREDICTOR, low) for trial, (low, _) in figures.items()]
    scores += [score(trial, COMBINED, high) for trial, (_, high) in figures.items()]
    scores += [replace(score(trial, early, 0.0), valid=0.5) for trial in figures]
    assert len(statements(scores)) == 6
    assert all(statement.holds for statement in statements(scores))
    worse = [replace(s, union=0.2) if (s.trial, s.sampler) == ("2a", COMBINED) else s for s in scores]
    assert [statement.holds for statement in statements(worse)] == [False, True, True, False, True, True]


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    training = TrainingConfig(min_steps=20, max_steps=20, validation=0.0)
    monkeypatch.setattr(samplers, "causal_config", lambda d: NeuralConfig(hidden=(8,), dropout=0.0, training=training))
    quick = BoltzmannConfig(min_steps=10, max_steps=10, burn_in=3)
    monkeypatch.setattr(samplers, "BoltzmannConfig", lambda **_: quick)


@pytest.mark.usefixtures("quick_fits")
def test_a_whole_run_becomes_one_page_and_one_table(tmp_path: Path) -> None:
    settings = Settings(trials=("1a", "1b"), seeds=1, n_draws=20, fit=FitOptions(iterations=2))
    outcomes: list[Outcome] = [run_task(task) for task in plan(settings)]
    scores, points = experiment.collect(outcomes), first_points(outcomes)
    save_scores(tmp_path / "results.csv", scores)
    save_points(tmp_path / "points.npz", points)
    again, points_again = load_scores(tmp_path / "results.csv"), load_points(tmp_path / "points.npz")
    assert [repr(score) for score in again] == [repr(score) for score in scores]  # NaN equals itself here
    assert points_again.keys() == points.keys()
    changed = [replace(score("2a", name, 0.8), trial=t) for name in ("as scored", "one sweep") for t in ("2a", "3")]
    growing = [score(trial, COMBINED, 0.8, parameters=9, sample_microseconds=1.0) for trial in ("d = 2", "d = 4")]
    parts: dict[Part, list[Score]] = {"samplers": again, "variants": changed, "scaling": growing}
    write_page(tmp_path / "report.html", parts, points_again, settings, "python scripts/sampling_accuracy.py")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Trial 1a: d = 2, low correlation, c = 4, 4 inputs" in page
    assert "http" not in page
    lines = (tmp_path / "results.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + 2 * 14
    assert plan(Settings())[0].trial == "3"
    assert len(plan(Settings())) == 2 * 60 + 3 * 20 + 5
    assert find_trial("3").seeds == 5


def test_mistakes_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong, told in (
        (["--trials", "9"], "no trial '9'"),
        (["--seeds", "0"], "at least 1"),
        (["--n-draws", "0"], "at least 1"),
    ):
        assert main([*wrong, "--output", str(tmp_path)]) == 1
        assert told in capsys.readouterr().out
