"""Error estimates: calibrated with limited data, and higher for unobserved states."""

from dataclasses import replace

import numpy as np
import pytest

from mbagent.data import TransitionDataset
from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.model_error import _calibrated, estimate_error, likeliest, missed, parts_of
from mbagent.models.tabular import TabularModel
from tests.models.helpers import dataset

CARDS = (30, 2)


def world(n: int, seed: int) -> TransitionDataset:
    """A table of thirty places with random transitions, of which low ones are observed often, and a biased coin."""
    rng = np.random.default_rng(seed)
    table = np.random.default_rng(9).integers(30, size=(30, 2))
    place = np.minimum(rng.geometric(0.12, size=n) - 1, 29)
    actions = rng.integers(2, size=n)
    states = np.stack([place, rng.integers(2, size=n)], axis=1)
    following = np.stack([table[place, actions], rng.random(n) < 0.1], axis=1).astype(np.int64)
    return dataset(CARDS, 2, states, actions, following)


def test_estimated_errors_are_those_observed() -> None:
    data = world(400, 0)
    model = DecisionGraphModel(CARDS, 2)
    model.fit(data)
    error = estimate_error(lambda: DecisionGraphModel(CARDS, 2), model, data)
    rows = world(20_000, 1).rows()
    estimated, wrong = error(rows.states, rows.actions), missed(model, rows)
    assert abs(estimated.mean() - wrong.mean()) < 0.05
    known = np.isin(rows.states[:, 0], np.arange(5))
    unknown = rows.states[:, 0] > 20
    assert abs(estimated[known].mean() - wrong[known].mean()) < 0.05
    assert abs(estimated[unknown].mean() - wrong[unknown].mean()) < 0.15
    doubt = error.doubt(rows.states, rows.actions)
    assert doubt[unknown].mean() > doubt[known].mean() + 0.01
    apart = error.disagreement(rows.states, rows.actions)
    assert apart[unknown].mean() > apart[known].mean()


def test_models_without_a_method_for_the_likeliest_state_use_each_factors_likeliest_value() -> None:
    data = world(2000, 0)
    model = TabularModel(CARDS, 2)
    model.fit(data)
    rows = data.rows()
    found, ends = likeliest(model, rows.states, rows.actions)
    probs = model.marginals(rows.states, rows.actions)
    np.testing.assert_array_equal(found[:, 0], probs[:, :30].argmax(axis=1))
    assert not ends.any()


def test_parts_are_whole_episodes() -> None:
    rows = world(400, 0).rows()
    part = parts_of(rows, 5, 0)
    np.testing.assert_array_equal(np.bincount(part), [80] * 5)
    assert sum(len(set(rows.episodes[part == number])) for number in range(5)) == len(set(rows.episodes))


def test_few_long_episodes_are_cut_into_runs() -> None:
    rows = replace(world(400, 0).rows(), episodes=np.zeros(400, dtype=np.int64))
    part = parts_of(rows, 5, 0)
    np.testing.assert_array_equal(np.bincount(part), [80] * 5)
    assert (np.diff(part) != 0).sum() <= 9


def test_models_without_probabilities_are_refused_before_anything_is_fitted() -> None:
    class Unfitted(TabularModel):
        def log_prob(self, *_: object) -> np.ndarray:
            raise NotImplementedError

    def build() -> TabularModel:
        raise AssertionError("nothing should be built")

    with pytest.raises(NotImplementedError, match="needs exact probabilities, which Unfitted does not have"):
        estimate_error(build, Unfitted(CARDS, 2), world(400, 0))


def test_calibrated_probabilities_strictly_increase() -> None:
    doubts = np.linspace(0.0, 1.0, 400)
    x, y = _calibrated(doubts, doubts > 0.5)
    assert (np.diff(x) > 0.0).all()
    assert (np.diff(y) > 0.0).all()
    np.testing.assert_allclose(np.interp([0.2, 0.8], x, y), [0.0, 1.0], atol=0.05)
    x, y = _calibrated(doubts[::-1], doubts > 0.5)  # doubts that mislead leave only the mean rate
    np.testing.assert_allclose(np.interp(doubts, x, y).mean(), 0.5, atol=0.05)


def test_too_little_data_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 50"):
        estimate_error(lambda: DecisionGraphModel(CARDS, 2), DecisionGraphModel(CARDS, 2), world(20, 0))
