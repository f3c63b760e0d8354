"""Files written by a study, and refused options."""

import csv
from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console

from harness import Result, Run, check_at_least, check_known, find, grouped, run_cells, run_command


def square(cell: int) -> Result[int]:
    return Result(cell, {"squares": [{"cell": cell, "square": cell**2}], "none": []}, f"cell {cell}", {"cell": cell})


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_tables_are_kept_after_each_cell_behind_those_of_an_earlier_run(tmp_path: Path) -> None:
    run, seen = Run(tmp_path, 1, Console(quiet=True), ""), []
    kept = {"squares": [{"cell": 7, "square": 49}]}
    results = run_cells(
        square, [3, 1, 2], run, kept=kept, order=lambda cell: cell, each=lambda _: seen.append(read(tmp_path / "squares.csv"))
    )
    assert [len(rows) for rows in seen] == [2, 3, 4]
    assert [row["square"] for row in seen[-1]] == ["49", "1", "4", "9"]
    assert not (tmp_path / "none.csv").exists()
    assert sorted(result.arrays["cell"] for result in results) == [1, 2, 3]
    assert results[0].rows == [{"cell": 3, "square": 9}]


@dataclass(frozen=True)
class Args:
    """Options.

    Attributes:
        output: folder of the results.
        n: a number.
    """

    output: Path
    n: int = 1


def prepare(args: Args, run: Run) -> list[int]:
    check_at_least(args, n=1)
    return list(range(args.n))


def execute(args: Args, cells: list[int], run: Run) -> None:
    run_cells(square, cells, run)
    run.say(run.command)


def test_a_command_sets_earlier_results_aside_and_refuses_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--output", str(tmp_path / "some folder"), "--n"]
    assert run_command("squares", "Squares.", Args, prepare, execute, [*options, "2"]) == 0
    assert "python scripts/squares.py --output" in capsys.readouterr().out
    assert run_command("squares", "Squares.", Args, prepare, execute, [*options, "3"]) == 0
    assert len(read(tmp_path / "some folder" / "squares.csv")) == 3
    assert len(read(tmp_path / "some folder" / "earlier-1" / "squares.csv")) == 2
    capsys.readouterr()
    assert run_command("squares", "Squares.", Args, prepare, execute, [*options, "0"]) == 1
    assert capsys.readouterr().out == "n must be at least 1, got 0.\n"
    (tmp_path / "file").write_text("")
    assert run_command("squares", "Squares.", Args, prepare, execute, ["--output", str(tmp_path / "file")]) == 1
    assert "must be a folder" in capsys.readouterr().out


def test_unknown_names_are_refused_with_those_there_are() -> None:
    assert find("agent", "PPO", {"PPO": 1, "DQN": 2}) == 1
    with pytest.raises(ValueError, match="There is no agent 'A2C'; choose from PPO, DQN"):
        find("agent", "A2C", {"PPO": 1, "DQN": 2})
    with pytest.raises(ValueError, match="choose from 'Taxi', 'FrozenLake 4x4'"):
        check_known("world", ["Taxi", "Nowhere"], ["Taxi", "FrozenLake 4x4"])


def test_rows_are_grouped_in_the_order_in_which_they_come() -> None:
    rows = [{"a": 2, "b": 1}, {"a": 1, "b": 2}, {"a": 2, "b": 3}]
    assert {key: [row["b"] for row in group] for key, group in grouped(rows, ["a"]).items()} == {(2,): [1, 3], (1,): [2]}
