import numpy as np
import pytest

from mbagent.data import TransitionDataset
from mbagent.models import TabularModel
from mbagent_envs.random_keys import derive
from tests.models.helpers import dataset, outcome_numbers, outcomes

CARDINALITIES = (3, 2)


def counted() -> TransitionDataset:
    """State (0, 0), action 0: (1, 1) three times, (2, 0) twice, and (0, 0) with an end once."""
    following = np.array([[1, 1]] * 3 + [[2, 0]] * 2 + [[0, 0]])
    n = len(following)
    zeros = np.zeros(n, dtype=np.int64)
    return dataset(CARDINALITIES, 2, np.zeros((n, 2), dtype=np.int64), zeros, following, np.arange(n) == n - 1)


def one_row(action: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((1, 2), dtype=np.int64), np.array([action])


def test_probabilities_are_the_observed_frequencies() -> None:
    model = TabularModel(CARDINALITIES, 2)
    model.fit(counted())
    following, ends = outcomes(CARDINALITIES)
    n = len(ends)
    probabilities = np.exp(model.log_prob(np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64), following, ends))
    expected = np.zeros(n)
    expected[outcome_numbers(CARDINALITIES, np.array([[1, 1], [2, 0], [0, 0]]), np.array([False, False, True]))] = [
        3 / 6,
        2 / 6,
        1 / 6,
    ]
    assert probabilities == pytest.approx(expected)
    assert model.marginals(*one_row())[0] == pytest.approx([1 / 6, 3 / 6, 2 / 6, 3 / 6, 3 / 6])
    found = model.successors(*one_row(), 4, seed=0)
    assert found.probabilities.sum() == pytest.approx(1.0)
    assert len(found.states) == 3
    assert model.visits(*one_row()).tolist() == [6]


def test_after_unobserved_pairs_nothing_changes() -> None:
    model = TabularModel(CARDINALITIES, 2)
    model.fit(counted())
    states, actions = np.array([[2, 1], [0, 0], [0, 0]]), np.array([0, 1, 0])
    following, ends = model.sample(states, actions, derive(np.arange(3), 0))
    assert np.array_equal(following[:2], states[:2])
    assert not ends[:2].any()
    found = model.successors(states, actions, 4, seed=0)
    assert np.diff(found.offsets).tolist() == [1, 1, 3]
    assert model.visits(states, actions).tolist() == [0, 0, 6]
    fresh = TabularModel(CARDINALITIES, 2)
    assert np.array_equal(fresh.sample(states, actions, np.random.default_rng(0))[0], states)


def test_the_prior_counts_as_transitions_in_which_nothing_changed() -> None:
    model = TabularModel(CARDINALITIES, 2, prior=2.0)
    model.fit(counted())
    stays = (np.zeros((1, 2), dtype=np.int64), np.array([False]))
    assert np.exp(model.log_prob(*one_row(), *stays)) == pytest.approx([2 / 8])
    assert np.exp(model.log_prob(*one_row(), np.array([[1, 1]]), np.array([False]))) == pytest.approx([3 / 8])


@pytest.mark.parametrize("prior", [0.0, 1.5])
def test_draws_follow_the_table_and_only_their_own_key(prior: float) -> None:
    model, n = TabularModel(CARDINALITIES, 2, prior=prior), 20_000
    model.fit(counted())
    states, actions, keys = np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64), derive(np.arange(n), 3)
    following, ends = model.sample(states, actions, keys)
    every, every_end = outcomes(CARDINALITIES)
    m = len(every_end)
    exact = np.exp(model.log_prob(np.zeros((m, 2), dtype=np.int64), np.zeros(m, dtype=np.int64), every, every_end))
    shares = np.bincount(outcome_numbers(CARDINALITIES, following, ends), minlength=m) / n
    assert shares == pytest.approx(exact, abs=0.015)
    part = slice(70, 90)
    assert np.array_equal(model.sample(states[part], actions[part], keys[part])[0], following[part])


def test_a_table_survives_a_round_trip_and_does_not_depend_on_the_order_of_experience() -> None:
    model, data = TabularModel(CARDINALITIES, 2, prior=1.0), counted()
    model.fit(data)
    backwards = TransitionDataset(CARDINALITIES, 2)
    backwards.append(data.rows().select(np.arange(len(data))[::-1]))
    other, third = TabularModel(CARDINALITIES, 2, prior=1.0), TabularModel(CARDINALITIES, 2, prior=1.0)
    other.fit(backwards)
    third.load_state_dict(model.state_dict())
    for rival in (other, third):
        for name, array in model.state_dict().items():
            assert np.array_equal(array, rival.state_dict()[name])
        assert np.array_equal(rival.marginals(*one_row()), model.marginals(*one_row()))
    with pytest.raises(ValueError, match="factors"):
        TabularModel((3, 2, 2), 2).load_state_dict(model.state_dict())
    with pytest.raises(ValueError, match="arrays"):
        other.load_state_dict({})


def test_the_report_measures_on_held_out_episodes() -> None:
    rng, n = np.random.default_rng(0), 4000
    states, actions = rng.integers(0, (3, 2), size=(n, 2)), rng.integers(2, size=n)
    report = TabularModel(CARDINALITIES, 2).fit(dataset(CARDINALITIES, 2, states, actions, states[rng.permutation(n)]))
    assert report.n_validation == pytest.approx(n / 10, rel=0.1)
    assert report.predictor_loss == pytest.approx(np.log(6), abs=0.1)
