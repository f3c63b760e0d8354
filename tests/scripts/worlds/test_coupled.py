from collections.abc import Callable

import numpy as np
import pytest

from mbagent_envs.random_keys import derive
from studies.planning.coupled import play
from worlds.coupled import COUPLED, CoupledWorld, cells, corridor, ring


@pytest.mark.parametrize("make", COUPLED)
def test_samples_and_successors_have_the_same_chances(make: Callable[[], CoupledWorld]) -> None:
    world = make()
    model, n = world.model, 4000
    states, actions = np.repeat(world.start[:1], n, axis=0), np.full(n, 1)
    drawn, over = model.sample(states, actions, derive(0, np.arange(n)))
    assert not over.any()
    expected = model.marginals(states[:1], actions[:1])[0]
    assert expected.sum() == pytest.approx(len(model.cardinalities))
    means = np.concatenate([np.bincount(drawn[:, f], minlength=k) / n for f, k in enumerate(model.cardinalities)])
    np.testing.assert_allclose(means, expected, atol=0.05)
    found = model.successors(states[:1], actions[:1], 64, 0)
    assert found.probabilities.sum() == pytest.approx(1.0)
    mean = found.probabilities @ (found.states[:, -1] == 1)
    assert mean == pytest.approx(expected[-1 if model.cardinalities[-1] == 2 else -2], abs=0.1)


def test_what_the_worlds_do() -> None:
    lights = corridor(n_lights=2)
    right = play(lights, lambda states: np.full(len(states), 2), 0)
    left = play(lights, lambda states: np.zeros(len(states), dtype=np.int64), 0)
    assert right.mean() > 33.0
    assert left.max() < 5.0
    assert ring(4).goal(np.ones((1, 4), int), np.array([2]), np.ones((1, 4), int))[0] == 3.25
    life = cells(3)
    line = np.array([[0, 0, 0, 1, 1, 1, 0, 0, 0]])  # rotates by a right angle
    on = life.model.marginals(line, np.array([0])).reshape(9, 2)[:, 1]
    np.testing.assert_allclose(on, np.where([0, 1, 0, 0, 1, 0, 0, 1, 0], 0.9, 0.1))
