import subprocess
import sys
from pathlib import Path

import pytest

from scripts.kill_test import Args, main, rows_of, version_of

SCRIPT = Path(__file__).parents[2] / "scripts" / "kill_test.py"


def test_a_folder_is_killed_and_nothing_is_lost() -> None:
    command = [sys.executable, str(SCRIPT), "--kills", "1", "--rows", "300", "--subjects", "folder"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "folder through a link: 1 kills" in done.stdout
    assert "Nothing was lost." in done.stdout


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
