"""The full check covers all studies and declared dependencies; the commands themselves run outside of the tests."""

import sys
from pathlib import Path

from full_check import KEPT, ROOT, STUDIES, Step, oldest, run, steps


def test_every_study_is_checked_or_is_a_tool() -> None:
    tools = {"compare_checkouts", "draw_games", "exact", "full_check", "harness", "results_table"}
    assert {path.stem for path in (ROOT / "scripts").glob("*.py")} == {*STUDIES, *tools}


def test_the_oldest_versions_are_those_of_all_dependencies() -> None:
    found = dict(requirement.split("==") for requirement in oldest())
    assert {"gymnasium", "numba", "numpy", "scipy", "stable-baselines3"} == set(found)
    assert found["numpy"] == "2.0.*"
    assert not set(KEPT) & set(found)


def test_chosen_parts_become_steps(tmp_path: Path) -> None:
    found = list(steps(("extras", "oldest", "studies"), ("forecast",), ("no-such-python",), tmp_path))
    assert [step.name for step in found] == ["oldest", "forecast"]


def test_a_step_fails_with_its_first_failing_command_and_keeps_the_output(tmp_path: Path) -> None:
    python = sys.executable
    good, bad = [python, "-c", "print('fine')"], [python, "-c", "raise SystemExit('broken')"]
    assert run(Step("good", [good]), tmp_path)
    assert not run(Step("bad", [bad, good]), tmp_path)
    assert (tmp_path / "good.txt").read_text() == "fine\n"
    assert (tmp_path / "bad.txt").read_text() == "broken\n"
