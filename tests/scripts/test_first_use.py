from pathlib import Path

import pytest

import first_use


def test_programs_run_with_an_empty_folder_for_compiled_functions(tmp_path: Path) -> None:
    code = "import os; print('log'); print(len(os.listdir(os.environ['NUMBA_CACHE_DIR'])) + 0.5)"
    assert first_use.seconds(code, tmp_path) == 0.5


def test_the_first_decision_and_the_import_are_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = []

    def seconds(code: str, folder: Path) -> float:
        measured.append(code)
        return 2.0

    monkeypatch.setattr(first_use, "seconds", seconds)
    first_use.main(("FrozenLake-v1",), repetitions=3)
    assert sum("agent.predict" in code and "FrozenLake-v1" in code for code in measured) == 3
    assert "FrozenLake-v1: 2.0 s" in capsys.readouterr().out
