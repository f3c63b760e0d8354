"""Coverage and model error against steps."""

import csv
from pathlib import Path

import numpy as np
import pytest

from exact import toy_text_mdp
from exploration import main
from mbagent.models import TabularModel
from studies.learning.coverage import outcomes, reachable, wrongness
from worlds.known_rules import exact_world, true_model
from worlds.registry import find_world


def test_reachable_states_are_those_in_which_play_goes_on() -> None:
    cliff = toy_text_mdp(find_world("CliffWalking").make())
    np.testing.assert_array_equal(reachable(cliff), np.arange(37))  # neither the cliff nor the goal
    taxi = toy_text_mdp(find_world("Taxi").make())
    assert len(reachable(taxi)) == 400


def test_the_true_model_is_not_wrong_and_one_that_knows_nothing_is() -> None:
    world = find_world("FrozenLake 4x4")
    exact, known = exact_world(world), true_model(world)
    assert exact is not None
    assert known is not None
    numbers, actions = np.arange(11), np.arange(11) % 4
    truth, states = outcomes(world, exact, numbers, actions), numbers[:, None]
    np.testing.assert_allclose(np.add.reduceat(truth.probabilities, truth.offsets[:-1]), 1.0)
    assert wrongness(known[0], truth, states, actions) == pytest.approx(0.0, abs=1e-9)
    assert wrongness(TabularModel((16,), 4), truth, states, actions) > 0.5  # predicts that no state changes


def test_the_script_writes_table_and_picture_and_refuses_what_it_does_not_know(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--worlds", "CliffWalking", "--marks", "300", "600", "--workers", "1", "--output", str(tmp_path)]
    assert main(options) == 0
    with (tmp_path / "coverage.csv").open(encoding="utf-8") as file:
        rows = {(row["exploration"], int(row["steps"])): row for row in csv.DictReader(file)}
    assert float(rows["auto", 600]["tried"]) == 1.0
    assert float(rows["random", 600]["tried"]) < 0.7
    assert float(rows["auto", 600]["error"]) < float(rows["random", 600]["error"])
    assert (tmp_path / "coverage.png").read_bytes()[:4] == b"\x89PNG"
    for wrong, expected in (
        (["--explorations", "bold"], "bold"),
        (["--worlds", "CartPole, binned"], "not available"),
        (["--marks", "20", "10"], "ascending"),
    ):
        assert main(wrong) == 1
        assert expected in capsys.readouterr().out
