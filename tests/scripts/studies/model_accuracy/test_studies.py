"""Studies: true parents of a known game, the page with all its parts."""

from pathlib import Path

import numpy as np
import pytest

import model_accuracy
from mbagent_envs import FlierCatcher, GeyserRunner
from studies.model_accuracy import studies
from studies.model_accuracy.page import KEYS, averaged, slope, write_page
from studies.model_accuracy.studies import STUDIES, area, true_parents
from worlds.nonstationary import CHANGES, other_geysers


def test_true_parents_are_those_of_the_rules() -> None:
    game = FlierCatcher(height=3, width=4)
    units = [np.arange(0, 12, 4), *(np.array([12 + i]) for i in range(12))]  # the player's rows, then each flier
    found = true_parents(game, units, 0)
    expected = np.zeros((13, 13), dtype=bool)
    for y in range(3):
        for x in range(3):
            expected[1 + 4 * y + x, 1 + 4 * y + x + 1] = True
    np.testing.assert_array_equal(found, expected)
    assert not true_parents(GeyserRunner(), [np.arange(10), np.arange(10, 15)], 0).any()


def test_area_under_the_curve_is_the_share_of_pairs_in_order() -> None:
    assert area(np.array([0.1, 0.4, 0.35, 0.8]), np.array([False, False, True, True])) == pytest.approx(0.75)
    assert np.isnan(area(np.ones(3), np.zeros(3, dtype=np.bool_)))


def test_every_study_has_its_keys_and_a_sentence() -> None:
    assert set(KEYS) == set(STUDIES)
    assert all((study.__doc__ or "").endswith(".") or "\n" in (study.__doc__ or "") for study in STUDIES.values())


def test_exponents_and_means() -> None:
    rows = [{"d": d, "size": 1, "fit seconds": 0.1 * d**1.1, "sample microseconds": float(d)} for d in (10, 100, 1000)]
    assert slope(rows, "fit seconds") == pytest.approx(1.1)
    mean = averaged("transfer", [{"size": 6, "likeliest": 1.0}, {"size": 6, "likeliest": float("nan")}])
    assert mean == [{"size": 6, "likeliest": 1.0, "seeds": 2}]


def test_the_page_holds_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "N_TESTS", 300)
    monkeypatch.setitem(CHANGES, "geysers in the opposite order", other_geysers)
    for name in list(CHANGES):
        if name != "geysers in the opposite order":
            monkeypatch.delitem(CHANGES, name)
    options = ["--cases", "--studies", "changes", "--workers", "1", "--seeds", "1", "--output", str(tmp_path)]
    assert model_accuracy.main(options) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "geysers in the opposite order" in text
    assert (tmp_path / "changes.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "changes.csv").read_text(encoding="utf-8").splitlines()) == 5
    cost = [{"d": d, "size": d, "fit seconds": 1.0 * d, "sample microseconds": 1.0 * d} for d in (48, 192)]
    trust = [{"world": "w", "steps": 1, "bin": str(p), "estimate": p, "rate": p} for p in (0.1, 0.9)]
    pictures = write_page(tmp_path / "other.html", {"cost": cost, "trust": trust}, [], "a command")
    assert sorted(pictures) == ["cost", "trust"]
