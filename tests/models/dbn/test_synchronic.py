"""Synchronic arcs and relative effects, with exact joint probabilities."""

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel, fitting
from mbagent.spaces import FactoredSpace
from mbagent_envs.random_keys import derive
from tests.models.helpers import dataset, outcome_numbers, outcomes

CARDINALITIES = (2, 2, 3)


def tied_world(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two coins, equal under action 0 and different under action 1; a die; the episode ends if all have their highest values."""
    rng = np.random.default_rng(seed)
    states, actions = rng.integers(0, CARDINALITIES, size=(n, 3)), rng.integers(2, size=n)
    coin, die = rng.integers(2, size=n), rng.integers(3, size=n)
    following = np.stack([coin, coin ^ actions, die], axis=1)
    return states, actions, following, (following == [1, 1, 2]).all(axis=1)


@pytest.fixture(scope="module")
def tied() -> DecisionGraphModel:
    model = DecisionGraphModel(CARDINALITIES, 2)
    model.fit(dataset(CARDINALITIES, 2, *tied_world(3000, 0)))
    return model


def test_dependent_next_values_have_exact_joint_probabilities(tied: DecisionGraphModel) -> None:
    possible, ends = outcomes(CARDINALITIES)
    assert tied.fitted.synchronic.changing.tolist() == [1, 3]  # the second coin, given the first; the end, given all
    for action in (0, 1):
        probs = np.exp(tied.log_prob(np.zeros((24, 3), dtype=np.int64), np.full(24, action), possible, ends))
        alike = (possible[:, 0] ^ possible[:, 1]) == action
        over = (possible == [1, 1, 2]).all(axis=1)
        true = np.where(alike & (over == ends), 1 / 6, 0.0)
        assert probs.sum() == pytest.approx(1.0)
        assert 0.5 * np.abs(probs - true).sum() < 0.03


def test_samples_and_successors_follow_the_joint_probabilities(tied: DecisionGraphModel) -> None:
    possible, ends = outcomes(CARDINALITIES)
    n, state = 40_000, np.array([[1, 0, 2]])
    probs = np.exp(tied.log_prob(np.tile(state, (24, 1)), np.ones(24, dtype=np.int64), possible, ends))
    drawn, over = tied.sample(np.tile(state, (n, 1)), np.ones(n, dtype=np.int64), derive(1, np.arange(n)))
    share = np.bincount(outcome_numbers(CARDINALITIES, drawn, over), minlength=24) / n
    np.testing.assert_allclose(share, probs, atol=5 * np.sqrt(0.25 / n))
    listed = tied.successors(state, np.array([1]), 64, 0)
    weights = np.zeros(24)
    weights[outcome_numbers(CARDINALITIES, listed.states, listed.terminated)] = listed.probabilities
    assert 0.5 * np.abs(weights - probs).sum() < 0.02
    likeliest, _ = tied.likeliest(np.tile(state, (2, 1)), np.array([0, 1]))
    assert ((likeliest[:, 0] ^ likeliest[:, 1]) == [0, 1]).all()


def test_weights_of_synchronic_graphs_are_saved(tied: DecisionGraphModel) -> None:
    other = DecisionGraphModel(CARDINALITIES, 2)
    other.load_state_dict(tied.state_dict())
    states, actions, following, ends = tied_world(50, 3)
    np.testing.assert_array_equal(
        other.log_prob(states, actions, following, ends), tied.log_prob(states, actions, following, ends)
    )


def test_relative_effects_generalise_to_unobserved_values() -> None:
    rng, cards = np.random.default_rng(0), (40,)
    states, actions = rng.integers(30, size=(600, 1)), rng.integers(3, size=600)  # never at 30 ... 39
    following = (states + np.array([1, -1, 5])[actions][:, None]) % 40
    model = DecisionGraphModel(cards, 3)
    model.fit(dataset(cards, 3, states, actions, following))
    new = np.arange(30, 40)[:, None]
    found, _ = model.likeliest(new, np.full(10, 2))
    np.testing.assert_array_equal(found, (new + 5) % 40)


def wanderers(n: int, seed: int) -> tuple[FactoredSpace, np.ndarray, np.ndarray, np.ndarray]:
    """Two objects on a board, each of which stays or moves to a free neighbouring cell, independently of the action."""
    rng, size = np.random.default_rng(seed), 5
    states, following = np.zeros((2, n, size, size), dtype=np.int64)
    for b in range(n):
        places = [divmod(int(p), size) for p in rng.choice(size * size, 2, replace=False)]
        for y, x in places:
            states[b, y, x] = 1
        for y, x in places:
            near = [(y + dy, x + dx) for dy, dx in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))]
            free = [p for p in near if min(p) >= 0 and max(p) < size and not following[b][p]]
            following[b][free[rng.integers(len(free))] if free else (y, x)] = 1
    space = FactoredSpace(spaces.MultiBinary((1, size, size)))
    return space, states.reshape(n, -1), rng.integers(2, size=n), following.reshape(n, -1)


def test_several_objects_on_one_plane_are_each_drawn_once() -> None:
    space, states, actions, following = wanderers(4000, 0)
    model = LocalGraphModel(space, 2)
    model.fit(dataset(space.cardinalities, 2, states, actions, following))
    assert model.local.synchronic.changing.tolist() == [0]
    _, tests, chosen, _ = wanderers(1000, 1)
    drawn, _ = model.sample(tests, chosen, derive(5, np.arange(1000)))
    assert (drawn.sum(axis=1) == 2).mean() > 0.75  # 0.3 if every cell is drawn independently


@pytest.mark.parametrize("wrap", [False, True])
def test_reach_of_neighbourhoods_is_found(wrap: bool) -> None:
    rng, n, width = np.random.default_rng(0), 2500, 8
    states = (rng.random((n, 1, 3, width)) < 0.3).astype(np.int64)
    following = np.roll(states, 2, axis=3)
    if not wrap:
        following[..., :2] = 0
    space = FactoredSpace(spaces.MultiBinary((1, 3, width)))
    model = LocalGraphModel(space, 2)
    data = dataset(space.cardinalities, 2, states.reshape(n, -1), rng.integers(2, size=n), following.reshape(n, -1))
    report = model.fit(data)
    assert tuple(model.reach) == (2, wrap)
    assert report.exact_match == 1.0


def test_end_of_an_episode_is_predicted_from_the_next_state() -> None:
    rng, n, size = np.random.default_rng(0), 3000, 5
    place, action = rng.integers(size * size, size=n), rng.integers(2, size=n)
    y, x = place // size, place % size
    row = np.where(rng.random(n) < 0.5, np.minimum(y + 1, size - 1), y)  # falls at random; the episode ends at the bottom
    states, following = (np.eye(size * size, dtype=np.int64)[cells] for cells in (place, row * size + x))
    space = FactoredSpace(spaces.MultiBinary((1, size, size)))
    model = LocalGraphModel(space, 2)
    model.fit(dataset(space.cardinalities, 2, states, action, following, row == size - 1))
    drawn, over = model.sample(states, action, derive(2, np.arange(n)))
    np.testing.assert_array_equal(over, drawn.reshape(n, size, size)[:, -1].any(axis=1))


def test_states_that_violate_a_group_have_valid_probabilities() -> None:
    rng, n = np.random.default_rng(0), 1500
    place, actions = rng.integers(4, size=n), rng.integers(2, size=n)
    states, following = (np.eye(4, dtype=np.int64)[p] for p in (place, (place + np.where(rng.random(n) < 0.5, 1, actions)) % 4))
    model = DecisionGraphModel((2,) * 4, 2)
    model.fit(dataset((2,) * 4, 2, states, actions, following))
    assert model.fitted.layout.outputs[0] == 4
    possible, ends = outcomes((2,) * 4)
    for broken in ([1, 1, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1]):
        many = np.tile(broken, (len(ends), 1))
        for action in (0, 1):
            probs = np.exp(model.log_prob(many, np.full(len(ends), action), possible, ends))
            assert probs.sum() == pytest.approx(1.0)
        drawn, over = model.sample(many, np.zeros(len(ends), dtype=np.int64), derive(1, np.arange(len(ends))))
        assert np.isfinite(model.log_prob(many, np.zeros(len(ends), dtype=np.int64), drawn, over)).all()
        listed = model.successors(many[:1], np.array([1]), 16, 0)
        ones = np.ones(len(listed.states), dtype=np.int64)
        logs = model.log_prob(np.tile(broken, (len(ones), 1)), ones, listed.states, listed.terminated)
        np.testing.assert_allclose(np.exp(logs), listed.probabilities, atol=0.01)


def test_probabilities_beside_a_constant_factor_do_not_depend_on_what_memory_held(monkeypatch: pytest.MonkeyPatch) -> None:
    states, actions, following, ends = tied_world(500, 1)
    states, following = (np.insert(array, 1, 0, axis=1) for array in (states, following))
    model, rows = DecisionGraphModel((2, 1, 2, 3), 2), dataset((2, 1, 2, 3), 2, states, actions, following, ends)
    model.fit(rows)
    layout, graphs, batch = model.fitted.layout, model.fitted.usual, rows.rows()
    clean = fitting.probabilities(layout, graphs, batch)
    with monkeypatch.context() as patch:
        patch.setattr(np, "empty", lambda shape, dtype=np.float64: np.full(shape, np.inf if dtype == np.float64 else 1, dtype))
        np.testing.assert_array_equal(fitting.probabilities(layout, graphs, batch), clean)
