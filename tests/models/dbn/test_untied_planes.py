"""Planes whose dynamics depend on the position, and planes whose dynamics do not."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn import PlaneGraphModel
from mbagent.spaces import FactoredSpace

SIZE = 9


def walk(n: int, flip: np.ndarray, seed: int = 0) -> tuple[FactoredSpace, TransitionDataset]:
    """A dot on a torus moves down and, under action 1, right, under action 0, left; in cells of ``flip``, these are exchanged."""
    rng, space = np.random.default_rng(seed), FactoredSpace(spaces.MultiBinary((SIZE, SIZE)))
    places, actions = rng.integers(SIZE, size=(n, 2)), rng.integers(2, size=n)
    right = actions ^ flip[places[:, 0], places[:, 1]]
    following = (places + np.stack([np.ones(n, dtype=np.int64), 2 * right - 1], axis=1)) % SIZE
    states, after = np.zeros((2, n, SIZE, SIZE), dtype=np.int64)
    states[np.arange(n), places[:, 0], places[:, 1]] = 1
    after[np.arange(n), following[:, 0], following[:, 1]] = 1
    nothing = np.zeros(n)
    rows = TransitionBatch(space.encode(states), actions, space.encode(after), nothing.astype(bool), nothing, np.arange(n) // 20)
    data = TransitionDataset(space.cardinalities, 2)
    data.append(rows)
    return space, data


def test_untied_graphs_are_used_if_dynamics_depend_on_the_position() -> None:
    flip = np.random.default_rng(3).integers(2, size=(SIZE, SIZE))
    space, data = walk(3000, flip)
    model = PlaneGraphModel(space, 2)
    report = model.fit(data)
    assert model.flat is not None
    assert report.exact_match == 1.0
    assert report.advice is None
    rows = walk(300, flip, 1)[1].rows()
    found, _ = model.likeliest(rows.states, rows.actions)
    np.testing.assert_array_equal(found, rows.after)

    other = PlaneGraphModel(space, 2)
    other.load_state_dict(model.state_dict())
    again = other.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated)
    np.testing.assert_array_equal(again, model.log_prob(rows.states, rows.actions, rows.next_states, rows.terminated))
    with pytest.raises(ValueError, match="depend on the position"):
        other.for_space(spaces.MultiBinary((11, 11)))


def test_tied_graphs_are_used_if_dynamics_are_the_same_everywhere() -> None:
    space, data = walk(1500, np.zeros((SIZE, SIZE), dtype=np.int64))
    model = PlaneGraphModel(space, 2)
    report = model.fit(data)
    assert model.flat is None
    assert report.exact_match == 1.0
    other = PlaneGraphModel(space, 2)
    other.load_state_dict(model.state_dict())
    assert other.flat is None
    assert model.for_space(spaces.MultiBinary((11, 11))).cardinalities == (2,) * 121


def test_untied_graphs_follow_a_change_of_rules() -> None:
    """Left and right are exchanged in every cell, so that earlier transitions contradict later ones."""
    flip = np.random.default_rng(3).integers(2, size=(SIZE, SIZE))
    space, data = walk(3000, flip)
    new = walk(3000, 1 - flip, 1)[1].rows()
    data.append(replace(new, episodes=new.episodes + 1000))
    model = PlaneGraphModel(space, 2)
    report = model.fit(data)
    assert model.flat is not None
    assert report.exact_match == 1.0
    rows = walk(300, 1 - flip, 2)[1].rows()
    found, _ = model.likeliest(rows.states, rows.actions)
    np.testing.assert_array_equal(found, rows.after)
