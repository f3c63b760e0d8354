"""Fits to very few rows, or to rows without any change, do not fail."""

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.fit_report import FitReport
from mbagent.spaces import FactoredSpace
from mbagent_envs.random_keys import derive
from tests.models.helpers import dataset

SPACES = (
    spaces.Discrete(7),
    spaces.MultiDiscrete([2, 3, 5]),
    spaces.MultiBinary((2, 3, 4)),
    spaces.MultiDiscrete(np.full((3, 3, 2), 4)),
    spaces.Discrete(1),
)


def fitted(space: spaces.Space[object], n: int, *, constant: bool) -> tuple[DecisionGraphModel, FitReport, np.ndarray]:
    factored, rng = FactoredSpace(space), np.random.default_rng(0)
    model = DecisionGraphModel(factored.cardinalities, 3) if factored.planes is None else LocalGraphModel(factored, 3)
    states = rng.integers(0, factored.cardinalities, size=(n, len(factored)))
    if constant:
        states[:] = states[:1]
    following = states if constant else np.roll(states, 1, axis=0)
    data = dataset(factored.cardinalities, 3, states, rng.integers(3, size=n), following)
    return model, model.fit(data), states


@pytest.mark.parametrize("space", SPACES, ids=str)
@pytest.mark.parametrize("n", [1, 2, 11, 300])
@pytest.mark.parametrize("constant", [True, False])
def test_few_rows_give_a_model(space: spaces.Space[object], n: int, constant: bool) -> None:
    model, report, states = fitted(space, n, constant=constant)
    actions = np.arange(len(states)) % 3
    drawn, over = model.sample(states, actions, derive(1, np.arange(n)))
    assert drawn.shape == states.shape
    assert not over.any()
    assert np.isfinite(model.log_prob(states, actions, drawn, over)).all()
    assert all(np.isfinite(variable.log_likelihood) for variable in report.variables)
    assert report.exact_match is not None
    if constant:
        np.testing.assert_array_equal(model.likeliest(states, actions)[0], states)
        assert report.variables == ()
    listed = model.successors(states[:1], actions[:1], 16, 0)
    assert listed.probabilities.sum() == pytest.approx(1.0)
