"""Learning curves: the planned cells, the rows, and the picture."""

from pathlib import Path

import numpy as np
import pytest

from learning_curves import Args, cells, main
from studies.learning.curves import OURS, RANDOM, Cell, run_cell
from worlds.registry import find_world

CLIFF = find_world("CliffWalking")


def test_the_agent_goes_on_learning_from_mark_to_mark() -> None:
    rows = run_cell(Cell(CLIFF, OURS, 0, (500, 3000), 2)).rows
    assert [row["steps"] for row in rows] == [500, 3000]
    assert rows[-1]["return"] == -13.0
    assert rows[0]["learn_seconds"] < rows[1]["learn_seconds"]


def test_baselines_are_trained_for_each_mark_and_random_play_once() -> None:
    rows = run_cell(Cell(CLIFF, "PPO", 0, (1000, 2000), 2)).rows
    assert [row["steps"] for row in rows] == [1000, 2000]
    (row,) = run_cell(Cell(CLIFF, RANDOM, 0, (1000, 2000), 2)).rows
    assert row["return"] < -200.0


def test_the_command_draws_a_picture(tmp_path: Path) -> None:
    options = ["--worlds", "CliffWalking", "--agents", "random", "--marks", "100", "--episodes", "2", "--workers", "1"]
    assert main([*options, "--output", str(tmp_path)]) == 0
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "curves.csv").read_text(encoding="utf-8").splitlines()) == 2


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (Args(agents=("Nobody",)), "no agent 'Nobody'"),
        (Args(worlds=("Nowhere",)), "no world 'Nowhere'"),
        (Args(worlds=("CliffWalking",), marks=(5, 2)), "ascending"),
        (Args(worlds=("CliffWalking",), seeds=0), "--seeds"),
    ],
)
def test_mistakes_are_named(args: Args, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cells(args)


def test_every_agent_plays_every_world() -> None:
    todo = cells(Args(worlds=("CliffWalking", "Taxi"), seeds=2, marks=(10,)))
    assert len(todo) == 16
    assert len({(c.world.name, c.agent, c.seed) for c in todo}) == 16
    np.testing.assert_array_equal([c.episodes for c in todo], 5)
