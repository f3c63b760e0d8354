"""Synthetic environments with distractor bits."""

import numpy as np
import pytest

from exploration import main
from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models import TabularModel
from worlds.distractors import DISTRACTORS, DistractorWorld, chain, grid, key_and_door


def test_cores_are_as_large_as_they_should_be() -> None:
    assert len(chain(16).reachable()) == 16
    assert len(grid(20).reachable()) == 400
    assert 80 < len(grid(12, 0.3).reachable()) < 144
    n, wall = 8, 4  # without key: left of the wall; with key and shut door: either side; with open door: everywhere
    assert len(key_and_door(n).reachable()) == n * wall + n * (n - 1) + 1 + n * (n - 1) + 1 - n * (n - wall - 1) - 1


def test_a_model_that_saw_everything_is_hardly_wrong_and_one_that_saw_nothing_is() -> None:
    world = DistractorWorld("two lights", lambda: chain(3), 2, 50)
    env, rng = world.make(), np.random.default_rng(0)
    obs, rows = env.reset(seed=0)[0], []
    for _ in range(6000):
        action = int(rng.integers(2))
        after = env.step(action)[0]
        rows.append((obs, action, after))
        obs = after
    before, actions, after = (np.array(column) for column in zip(*rows, strict=True))
    none, zeros = np.zeros(6000, dtype=np.bool_), np.zeros(6000)
    data, model = TransitionDataset((3, 2, 2), 2), TabularModel((3, 2, 2), 2)
    data.append(TransitionBatch(before, actions, after, none, zeros, zeros.astype(np.int64)))
    numbers, some = np.repeat(np.arange(3), 2), np.tile(np.arange(2), 3)
    assert world.tried(before, actions) == 1.0
    assert world.wrongness(model, numbers, some) > 0.5
    model.fit(data)
    assert world.wrongness(model, numbers, some) < 0.1


def test_the_script_knows_them(tmp_path: object, capsys: pytest.CaptureFixture[str]) -> None:
    assert len({world.name for world in DISTRACTORS}) == len(DISTRACTORS)
    options = ["--worlds", "14 lights", "--marks", "20", "--explorations", "random", "--workers", "1", "--output", str(tmp_path)]
    assert main(options) == 0
    assert "14 lights" in capsys.readouterr().out
