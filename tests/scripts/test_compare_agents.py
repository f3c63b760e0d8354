import subprocess
import sys
from pathlib import Path

import pytest

from compare_agents import Args, main, settings_of
from tests.scripts.fakes import FakeAgent, fake_baseline

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_agents.py"
CASE = ["--cases", "geyser_high_cost"]
TINY = [*CASE, "--steps", "600", "--seeds", "1", "--episodes", "2", "--workers", "1"]


def test_help_documents_every_option() -> None:
    printed = subprocess.run([sys.executable, SCRIPT, "--help"], capture_output=True, text=True, check=True).stdout
    for name in Args.__dataclass_fields__:
        assert "--" + name.replace("_", "-") in printed
    assert "ten times the steps" in " ".join(printed.split())


def test_the_script_writes_report_and_table_and_can_write_the_report_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("studies.comparison.jobs.ModelLearningAgent", FakeAgent)
    monkeypatch.setattr("studies.comparison.jobs.train_baseline", fake_baseline)
    options = [*TINY, "--output", str(tmp_path)]
    assert main(options) == 0
    assert "jobs" not in capsys.readouterr().err
    page = tmp_path / "report.html"
    assert "GeyserRunner, stochastic, hit cost 5" in page.read_text(encoding="utf-8")
    assert "geyser_high_cost,PPO,default,0,600" in (tmp_path / "results.csv").read_text(encoding="utf-8")
    page.unlink()
    assert main([*options, "--report-only"]) == 0
    assert page.exists()


def test_mistakes_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--cases", "tetris", "--output", str(tmp_path)]) == 1
    assert "There is no case 'tetris'; choose from geyser_deterministic" in capsys.readouterr().out
    assert main(["--report-only", "--output", str(tmp_path)]) == 1
    assert "run the comparison first" in capsys.readouterr().out
    for wrong in (["--seeds", "0"], ["--episodes", "-1"], ["--baselines", "SAC"], ["--workers", "0"]):
        assert main([*CASE, "--output", str(tmp_path), *wrong]) == 1
        printed = capsys.readouterr().out
        assert "at least 1" in printed or "choose from PPO, DQN, A2C" in printed
    assert not (tmp_path / "records").exists()


def test_a_new_run_deletes_nothing_but_what_an_earlier_one_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("studies.comparison.jobs.ModelLearningAgent", FakeAgent)
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "precious.txt").write_text("mine")
    options = [*TINY, "--baselines", "--no-curves", "--output", str(tmp_path)]
    assert main(options) == main(options) == 0
    assert (tmp_path / "records" / "precious.txt").read_text() == "mine"
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Learning curves" not in page  # an empty figure would be worse than none
    assert "Stable-Baselines3 use" not in page
    # A rewritten page ignores other options: it uses the settings of that run.
    assert main(["--report-only", "--output", str(tmp_path)]) == 0
    capsys.readouterr()


def test_full_is_more_thorough_in_everything() -> None:
    quick, full = settings_of(Args()), settings_of(Args(full=True))
    assert full.seeds >= 5 > quick.seeds
    assert full.baseline_multiples == (1, 10)
    assert set(quick.curve_steps) < set(full.curve_steps)
    assert settings_of(Args(steps=5000)).curve_steps == (1000,)
