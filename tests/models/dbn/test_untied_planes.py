"""Planes whose rules hang on the place, and planes whose rules do not."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn import PlaneGraphModel
from mbagent.spaces import FactoredSpace

SIZE = 9


def walk(n: int, flip: np.ndarray, seed: int = 0) -> tuple[FactoredSpace, TransitionDataset]:
    """A dot on a torus goes down, and to the right under action 1, to the left under 0; in cells of ``flip`` the other way."""
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


def test_cells_are_learned_for_themselves_where_rules_hang_on_the_place() -> None:
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


def test_rules_that_are_the_same_everywhere_stay_so() -> None:
    space, data = walk(1500, np.zeros((SIZE, SIZE), dtype=np.int64))
    model = PlaneGraphModel(space, 2)
    report = model.fit(data)
    assert model.flat is None
    assert report.exact_match == 1.0
    other = PlaneGraphModel(space, 2)
    other.load_state_dict(model.state_dict())
    assert other.flat is None
    assert model.for_space(spaces.MultiBinary((11, 11))).cardinalities == (2,) * 121


def test_places_are_known_as_they_are_now_where_rules_have_changed() -> None:
    """Left and right changed places in every cell; what was before says the contrary."""
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
