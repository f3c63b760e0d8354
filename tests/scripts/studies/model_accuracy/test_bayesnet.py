"""The textbook baseline: its probabilities sum to one, and it learns rules that full tables can represent."""

import importlib.util

import numpy as np
import pytest

from mbagent_envs.random_keys import derive
from studies.model_accuracy.bayesnet import BayesNetModel
from tests.models.helpers import dataset, outcome_numbers, outcomes

CARDS = (2, 3, 2)


@pytest.mark.skipif(importlib.util.find_spec("pyagrum") is None, reason="pyAgrum is optional")
def test_a_network_of_full_tables_is_learned_and_drawn_from() -> None:
    rng, n = np.random.default_rng(0), 5000
    states, actions = rng.integers(0, CARDS, size=(n, 3)), rng.integers(2, size=n)
    following = np.stack(
        [np.where(actions == 1, states[:, 2], states[:, 0]), (states[:, 1] + 1) % 3, rng.random(n) < 0.25], axis=1
    ).astype(np.int64)
    model = BayesNetModel(CARDS, 2)
    model.fit(dataset(CARDS, 2, states, actions, following, following[:, 0] & (states[:, 1] == 2) == 1))
    possible, ends = outcomes(CARDS)
    state, m = np.array([0, 1, 1]), 20_000
    probs = np.exp(model.log_prob(np.tile(state, (24, 1)), np.ones(24, dtype=np.int64), possible, ends))
    assert probs.sum() == pytest.approx(1.0)
    likely = (possible[:, 0] == 1) & (possible[:, 1] == 2) & ~ends
    assert probs[likely].sum() > 0.99
    drawn, over = model.sample(np.tile(state, (m, 1)), np.ones(m, dtype=np.int64), derive(1, np.arange(m)))
    share = np.bincount(outcome_numbers(CARDS, drawn, over), minlength=24) / m
    np.testing.assert_allclose(share, probs, atol=5 * np.sqrt(0.25 / m))
    marginals = model.marginals(states[:5], actions[:5])
    assert marginals.shape == (5, 7)
    np.testing.assert_allclose(marginals.sum(axis=1), 3.0)
