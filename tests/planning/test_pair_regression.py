from itertools import combinations

import numpy as np
import pytest

from mbagent.planning import pair_regression
from mbagent.planning.pair_regression import PAIRED, RIDGE, PairRegression
from mbagent.planning.value_iteration import leaf_value

CARDINALITIES = (2, 3, 5, 2)


def drawn(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([np.minimum(rng.integers(c, size=n), rng.integers(c, size=n)) for c in CARDINALITIES])


def columns(states: np.ndarray, like: np.ndarray, paired: bool) -> np.ndarray:
    """Those features of the states that are active in states of ``like``, and all their pairs."""
    active = []
    for factor, values in enumerate(like.T):
        common = np.bincount(values).argmax()
        active += [states[:, factor] == value for value in np.unique(values) if value != common]
    if paired:
        active += [np.sqrt(PAIRED) * (a & b) for a, b in combinations(active, 2)]
    return np.stack(active, axis=1).astype(np.float64)


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("n_states", [6, 80])
def test_it_is_ridge_regression_with_a_free_mean(n_states: int, paired: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not paired:
        monkeypatch.setattr(pair_regression, "MOST_PAIRS", 0)
    states, others = drawn(n_states, 0), drawn(50, 1)
    values = np.random.default_rng(2).normal(size=n_states)
    regression = PairRegression(states, CARDINALITIES, others, -100.0, 100.0)
    leaf = regression.fit(values)
    assert (len(leaf.pairs) > 0) == paired
    x = columns(states, states, paired)
    centred = x - x.mean(axis=0)
    weights = np.linalg.solve(centred.T @ centred + RIDGE * np.eye(x.shape[1]), centred.T @ (values - values.mean()))
    expected = (columns(others, states, paired) - x.mean(axis=0)) @ weights + values.mean()
    np.testing.assert_allclose(regression.values(leaf), expected, atol=1e-9)
    np.testing.assert_allclose([leaf_value(leaf, state) for state in others], expected, atol=1e-9)


def test_values_are_within_bounds() -> None:
    states = drawn(30, 0)
    regression = PairRegression(states, CARDINALITIES, states, -0.1, 0.2)
    found = regression.values(regression.fit(np.random.default_rng(0).normal(size=30)))
    assert (found.min(), found.max()) == (-0.1, 0.2)
