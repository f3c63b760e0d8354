"""Change points: only changed variables are learned again, and all others keep their data."""

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.data import TransitionDataset
from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.dbn.change_points import last_changes
from mbagent.spaces import FactoredSpace
from tests.models.helpers import dataset

RNG = np.random.default_rng(0)


def switches(n: int, changed_at: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bit 0 copies bit 1, and from a given step on its negation; bit 2 always copies bit 3; the others are coins."""
    states, actions = RNG.integers(2, size=(n, 4)), RNG.integers(2, size=n)
    following = RNG.integers(2, size=(n, 4))
    following[:, 0] = states[:, 1] ^ (np.arange(n) >= changed_at)
    following[:, 2] = states[:, 3]
    return states, actions, following


def since_of(data: TransitionDataset) -> np.ndarray:
    rows = data.rows()
    return DecisionGraphModel(data.cardinalities, 2)._since(rows, np.zeros(len(rows), dtype=np.bool_))


def test_changed_variable_follows_its_new_rule_and_others_keep_all_data() -> None:
    data = dataset((2,) * 4, 2, *switches(4000, 3500))
    model = DecisionGraphModel((2,) * 4, 2)
    report = model.fit(data)
    assert report.log["changed"] == 1
    states, actions, following = switches(1000, 0)
    found, _ = model.likeliest(states, actions)
    np.testing.assert_array_equal(found[:, [0, 2]], following[:, [0, 2]])
    assert report.exact_match is not None


def test_no_data_are_ignored_if_nothing_changed() -> None:
    model = DecisionGraphModel((2,) * 4, 2)
    assert model.fit(dataset((2,) * 4, 2, *switches(4000, 4000))).log["changed"] == 0


def test_planes_follow_a_change() -> None:
    n, space = 2500, FactoredSpace(spaces.MultiBinary((1, 4, 5)))
    states = (RNG.random((n, 1, 4, 5)) < 0.3).astype(np.int64)
    following = np.zeros_like(states)
    following[: n - 500, ..., 1:] = states[: n - 500, ..., :-1]
    following[n - 500 :, ..., :-1] = states[n - 500 :, ..., 1:]
    model = LocalGraphModel(space, 2)
    report = model.fit(dataset(space.cardinalities, 2, states.reshape(n, -1), RNG.integers(2, size=n), following.reshape(n, -1)))
    assert report.log["changed"] == 1
    found, _ = model.likeliest(states[-300:].reshape(300, -1), np.zeros(300, dtype=np.int64))
    np.testing.assert_array_equal(found, following[-300:].reshape(300, -1))


def test_all_steps_since_the_change_are_kept() -> None:
    rows = dataset((2,) * 4, 2, *switches(6000, 4000)).rows()
    since = last_changes(rows, 5, DecisionGraphModel((2,) * 4, 2)._factor_log_probs)
    assert 4000 <= since[0] <= 4020
    assert (since[1:] == 0).all()


def test_fifty_steps_of_a_new_rule_are_detected() -> None:
    since = since_of(dataset((2,) * 4, 2, *switches(3050, 3000)))
    assert 3000 <= since[0] <= 3010
    assert (since[1:] == 0).all()


def test_variables_that_changed_at_different_steps_have_separate_change_points() -> None:
    states, actions, following = switches(4000, 3500)
    following[3900:, 2] ^= 1
    since = since_of(dataset((2,) * 4, 2, states, actions, following))
    assert 3500 <= since[0] <= 3510
    assert 3900 <= since[2] <= 3910
    assert (since[[1, 3, 4]] == 0).all()


def test_random_variable_that_becomes_predictable_is_detected_in_long_runs() -> None:
    states, actions, following = switches(4000, 4000)
    following[3300:, 1] = states[3300:, 3]  # a coin before
    since = since_of(dataset((2,) * 4, 2, states, actions, following))
    assert 3290 <= since[1] <= 3310
    assert (since[[0, 2, 3, 4]] == 0).all()


def test_states_never_observed_before_are_no_change_point() -> None:
    states, actions, following = switches(4000, 4000)
    rng = np.random.default_rng(5)
    place = np.where(np.arange(4000) < 3900, rng.integers(4, size=4000), 4 + rng.integers(4, size=4000))
    table = np.random.default_rng(6).integers(8, size=(8, 2))
    states[:, 0], following[:, 0] = place, table[place, actions]
    assert (since_of(dataset((8, 2, 2, 2), 2, states, actions, following)) == 0).all()


def test_steps_after_a_change_are_held_out_even_from_a_single_episode() -> None:
    rows = dataset((2,) * 4, 2, *switches(4000, 2500), episode_length=4000)
    report = DecisionGraphModel((2,) * 4, 2).fit(rows)
    assert report.log["changed"] == 1
    assert report.n_validation > 50
    assert report.predictor_loss == pytest.approx(2 * np.log(2), abs=0.1)
