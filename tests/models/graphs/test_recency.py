"""Rules that change: only what changed is learned anew, and what stays loses nothing."""

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.graphs import DecisionGraphModel, LocalGraphModel
from mbagent.models.graphs.recency import still_true_since
from mbagent.spaces import FactoredSpace
from tests.models.helpers import dataset

RNG = np.random.default_rng(0)


def switches(n: int, changed_at: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bit 0 copies bit 1, and from some step on its opposite; bit 2 copies bit 3 for ever; the others are coins."""
    states, actions = RNG.integers(2, size=(n, 4)), RNG.integers(2, size=n)
    following = RNG.integers(2, size=(n, 4))
    following[:, 0] = states[:, 1] ^ (np.arange(n) >= changed_at)
    following[:, 2] = states[:, 3]
    return states, actions, following


def test_a_changed_rule_is_followed_and_others_keep_all_their_data() -> None:
    data = dataset((2,) * 4, 2, *switches(4000, 3500))
    model = DecisionGraphModel((2,) * 4, 2)
    report = model.fit(data)
    assert report.log["changed"] == 1
    states, actions, following = switches(1000, 0)
    found, _ = model.likeliest(states, actions)
    np.testing.assert_array_equal(found[:, [0, 2]], following[:, [0, 2]])
    assert report.exact_match is not None


def test_nothing_is_forgotten_where_nothing_changed() -> None:
    model = DecisionGraphModel((2,) * 4, 2)
    assert model.fit(dataset((2,) * 4, 2, *switches(4000, 4000))).log["changed"] == 0


def test_planes_follow_a_change_too() -> None:
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


def test_the_longest_past_that_still_holds_is_kept() -> None:
    rows = dataset((2,) * 4, 2, *switches(6000, 4000)).rows()
    model = DecisionGraphModel((2,) * 4, 2)
    since = still_true_since(rows, 5, model._factors_foretold)
    assert 4000 - 500 <= since[0] <= 6000 - 200 - 250
    assert (since[1:] == 0).all()


def test_a_report_after_a_change_holds_out_new_steps_even_of_one_long_episode() -> None:
    rows = dataset((2,) * 4, 2, *switches(4000, 2500), episode_length=4000)
    report = DecisionGraphModel((2,) * 4, 2).fit(rows)
    assert report.log["changed"] == 1
    assert report.n_validation > 50
    assert report.predictor_loss == pytest.approx(2 * np.log(2), abs=0.1)
