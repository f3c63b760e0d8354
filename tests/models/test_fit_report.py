"""The fit report: calibration against a closed form, names of parents, and the Markov test with and without hidden state."""

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.dbn.features import action_encoding
from mbagent.models.fit_report import calibration_error
from mbagent.models.held_out import following_steps, steps_in_a_row, with_past
from mbagent.spaces import FactoredSpace
from tests.models.helpers import dataset

RNG = np.random.default_rng(0)


def test_calibration_is_the_distance_of_probabilities_from_frequencies() -> None:
    p = np.repeat([0.25, 0.85], 1000)
    observed = np.concatenate([np.arange(1000) < 250, np.arange(1000) < 600])
    assert calibration_error(p, observed) == pytest.approx(0.125)
    assert calibration_error(np.ones(4), np.ones(4, dtype=np.bool_)) == 0.0


def test_each_variable_is_reported_with_its_parents() -> None:
    states, actions = RNG.integers(2, size=(1000, 4)), RNG.integers(2, size=1000)
    following = states.copy()
    following[:, 2] = np.where(actions == 1, states[:, 0], states[:, 2])
    following[:, 3] = RNG.random(1000) < 0.5
    report = DecisionGraphModel((2,) * 4, 2).fit(dataset((2,) * 4, 2, states, actions, following))
    found = {variable.name: variable for variable in report.variables}
    assert sorted(found) == ["factor 2", "factor 3"]
    assert found["factor 2"].parents == ("action", "factor 0")
    assert found["factor 2"].log_likelihood > -0.02
    assert found["factor 3"].parents == ()
    assert found["factor 3"].log_likelihood == pytest.approx(-np.log(2), abs=0.02)
    assert report.calibration is not None
    assert report.calibration < 0.05
    assert "factor 3" in report.table()


def swing(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A position that moves back and forth; its direction is not observed."""
    place = np.abs((np.arange(n + 1) % 10) - 5)
    return place[:-1], place[1:]


def test_a_hidden_direction_is_detected() -> None:
    now, then = swing(1200)
    report = DecisionGraphModel((6,), 2).fit(dataset((6,), 2, now[:, None], RNG.integers(2, size=1200), then[:, None]))
    assert report.memory == pytest.approx(0.8 * np.log(2), rel=0.2)
    assert report.advice is not None
    assert "History" in report.advice
    space = FactoredSpace(spaces.MultiBinary((1, 3, 6)))
    lights = np.eye(18, dtype=np.int64)
    data = dataset(space.cardinalities, 2, lights[now], RNG.integers(2, size=1200), lights[then])
    assert LocalGraphModel(space, 2).fit(data).memory == pytest.approx(0.8 * np.log(2), rel=0.2)


def test_a_complete_state_gives_no_advice() -> None:
    place, moves = np.zeros(1201, dtype=np.int64), RNG.integers(-1, 2, size=1200)
    for t in range(1200):
        place[t + 1] = np.clip(place[t] + moves[t], 0, 5)
    actions = RNG.integers(2, size=1200)
    report = DecisionGraphModel((6,), 2).fit(dataset((6,), 2, place[:-1, None], actions, place[1:, None], episode_length=1200))
    assert report.memory == 0.0
    assert report.advice is None


def test_only_steps_that_follow_another_one_have_a_past() -> None:
    now, then = swing(40)
    rows = dataset((6,), 3, now[:, None], RNG.integers(3, size=40), then[:, None], episode_length=20).rows()
    later, earlier = following_steps(rows)
    assert later.tolist() == [*range(1, 20), *range(21, 40)]
    assert (later - earlier == 1).all()
    mixed = rows.select(np.arange(40).reshape(2, 20).T.ravel())  # two interleaved episodes, as from vector environments
    assert all((later - earlier == 2).all() for later, earlier in (following_steps(mixed),))
    space, longer = with_past(*steps_in_a_row(rows, 100), (6,), action_encoding((3,)), None)
    assert space.cardinalities == (6, 6, 2, 2, 2)
    np.testing.assert_array_equal(longer.states[:, 1], now[earlier])
    np.testing.assert_array_equal(longer.next_states[:, 1], now[later])
    np.testing.assert_array_equal(longer.states[:, 2:].argmax(axis=1), rows.actions[earlier])


def test_a_hidden_velocity_is_detected_although_an_action_reverses_it() -> None:
    place, speed, rows = 0, 1, []
    for action in RNG.integers(2, size=3000).tolist():
        before, speed = place, speed if action == 0 else -speed
        place += speed
        if not 0 <= place <= 7:
            speed, place = -speed, min(max(place, 0), 7)
        rows.append((before, action, place))
    now, actions, then = (np.array(column) for column in zip(*rows, strict=True))
    report = DecisionGraphModel((8,), 2).fit(dataset((8,), 2, now[:, None], actions, then[:, None], episode_length=100))
    assert report.memory is not None
    assert report.memory > 0.3
