import os
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import kill_test
from kill_test import Args, main, rows_of, version_of


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_writers_are_killed_and_nothing_is_lost(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kill_test, "METHOD", "fork")  # the server would import everything first
    monkeypatch.setattr(os, "environ", {})  # which is changed for the server
    assert main(["--kills", "1", "--rows", "300", "--subjects", "folder", "save_transitions"]) == 0
    output = capsys.readouterr().out
    assert "folder through a link: 1 kills" in output
    assert "save_transitions: two processes with 1 saves each" in output
    assert "Nothing was lost." in output


def test_losses_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(*args: Any) -> tuple[int, bool]:
        raise EOFError

    monkeypatch.setattr(kill_test, "kill_once", damaged)
    args = Args(rows=30)
    assert kill_test.kill("save_transitions", tmp_path / "rows.npz", 2, args, Console()) == 2
    assert "lost: EOFError()" in capsys.readouterr().out


def test_a_mix_of_two_versions_counts_as_lost() -> None:
    rows = rows_of(3, 20)
    assert version_of(rows, 20) == 3
    rows.rewards[7] = 4.0
    with pytest.raises(ValueError, match="not those of version 3"):
        version_of(rows, 20)


def test_mistakes_get_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--kills", "0"]) == 1
    assert "--kills and --rows must be at least 1." in capsys.readouterr().out
    assert Args().kills == 10
