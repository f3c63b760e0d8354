"""The pruning experiment: true dependencies, measures, and refused options."""

from pathlib import Path

import numpy as np
import pytest

from harness import write_csv
from mbagent.evaluation.statistics import mean_interval
from mbagent.models.neural.pruning import Influence
from mbagent_envs import FlierCatcher
from pruning import main
from studies.pruning import measures
from studies.pruning.experiment import Cell, Key, Outcome, Row, Settings
from studies.pruning.measures import SizeRow
from studies.pruning.page import exponent, markdown_table, summary, summary_rows, write_page
from studies.pruning.picture import draw_modules
from studies.pruning.truth import agreement, flier_catcher_dependencies
from tests.models.neural.test_connections import N_BITS, fitted, shifted


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
    assert found[1:] == (1.0, 1.0, 1.0, 1.0, 1.0)


def outcome(seed: int, change: float) -> Outcome:
    """The outcome of pruning FlierCatcher without losing any true dependency."""
    game, names = FlierCatcher(), tuple(f"observation[{i}]" for i in range(120))
    found = Outcome(Cell("flier_catcher", seed, SETTINGS), names, game.action_names)
    for number, key in enumerate(KEYS):
        speeds = 8.0, 4.0, 2.0 / (1 + number)
        found.rows.append(Row("flier_catcher", seed, *key, 100, 0.9, 0.5, 0.1, 0.1, *speeds, *([0.5] * 8)))
        found.returns[key] = np.array([0.9, 1.1, 1.0]) + change * number
        found.influences[key] = found.linked[key] = perfect(game)
        found.modules[key], found.groups[key] = [f"module at {key}"], [f"group at {key}"]
    found.others["the others"] = 20.0
    return found


KEYS: list[Key] = [(0.0, "by size"), (0.9, "by size"), (0.9, "by evidence")]
SETTINGS = Settings(episodes=3, fractions=(0.0, 0.9), seeds=2)


def test_changes_are_those_of_the_same_episodes_and_speeds_those_of_the_whole() -> None:
    rows = dict(summary([outcome(1, 0.02), outcome(2, 0.04)]))
    assert rows[KEYS[0]]["change"] == 0.0
    assert rows[KEYS[1]]["change"] == pytest.approx(0.03)
    assert rows[KEYS[1]]["half_width"] == pytest.approx(mean_interval([0.02] * 3 + [0.04] * 3).high - 0.03)
    assert [rows[key]["speed_up"] for key in KEYS] == pytest.approx([4.0, 8.0, 12.0])


def test_the_readmes_table_is_made_of_the_summary(tmp_path: Path) -> None:
    write_csv(tmp_path / "summary.csv", summary_rows([outcome(1, 0.02), outcome(2, 0.04)]))
    lines = markdown_table([tmp_path / "summary.csv"]).splitlines()
    assert len(lines) == 2 + len(KEYS)
    assert lines[2].startswith("| FlierCatcher | no | 100 | 0.500 |  |")
    assert "90%, by evidence" in lines[4]
    assert "0.0600 ±" in lines[4]


def test_a_cost_that_grows_with_the_square_has_exponent_two() -> None:
    rows = [SizeRow(d, 0, 10, float(d**2), float(d)) for d in (8, 16, 32)]
    assert exponent(rows, "whole") == pytest.approx(2.0)
    assert exponent(rows, "pruned") == pytest.approx(1.0)


def test_the_page_names_variables_and_modules(tmp_path: Path) -> None:
    sizes = [SizeRow(d, 0, 10, 1.0, 0.5) for d in (8, 16)]
    pictures = write_page(tmp_path / "report.html", [outcome(1, 0.0)], SETTINGS, "command", sizes)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "module at (0.9" in page
    assert "90% of the connections removed, by evidence" in page
    assert "the others 20.0 µs, 30 times" in page
    assert {f"flier_catcher_{name}" for name in ("curves", "paths_0", "paths_1", "paths_2", "modules")} == set(pictures)


@pytest.mark.parametrize("shape", [(7,), (3, 4), (2, 3, 4)])
def test_modules_are_drawn_for_any_observation(shape: tuple[int, ...]) -> None:
    n = int(np.prod(shape))
    chain = np.eye(n + 1, n, k=1)
    found = Influence(chain, np.zeros((n + 1, 2)), np.zeros((n + 1, n + 1)), np.zeros((n + 1, n)))
    assert draw_modules(found, shape).startswith(b"\x89PNG")


def test_speeds_and_sizes_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measures, "microseconds", lambda call, rows: call() is None or 1.0)
    data = shifted(600)
    model = fitted(data)
    rows = data.rows()
    whole = measures.measure_speeds(model, rows.states, rows.actions, 0)
    assert whole.variation == 0.0
    model.prune(data, 0.9)
    assert 0.0 < measures.measure_speeds(model, rows.states, rows.actions, 0).variation < 0.02
    monkeypatch.setattr(measures, "trained", lambda sampler, d, seed: model)
    monkeypatch.setattr(measures, "random_data", lambda d, n, seed: data)
    assert measures.measure_size(N_BITS, 0)[3:] == (1.0, 1.0)


def test_mistakes_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--fractions", "1.0", "--output", str(tmp_path)]) == 1
    assert "up to but not 1" in capsys.readouterr().out
    assert main(["--games", "frozen_lake", "--output", str(tmp_path)]) == 1
    assert "none of this package's games" in capsys.readouterr().out
