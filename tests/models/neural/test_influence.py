"""Groups of dependent variables from the remaining connections."""

import numpy as np

from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.networks import DensePredictor
from mbagent.models.neural.pruning import dependent_groups, influence, modules
from mbagent.models.neural.training import NeuralConfig, examples
from mbagent.models.neural.truth_tables import Pair, find_parents
from tests.models.helpers import dataset


def sparse() -> NeuralTransitionModel:
    """Four bits: 0 depends on 1 and the second action, 2 on 3; 3 depends on the next value of 1."""
    model = NeuralTransitionModel((2,) * 4, 2, NeuralConfig(hidden=(2,), group_size=1))
    weights = {name: np.zeros_like(array) for name, array in model.state_dict().items()}
    weights["conditioner.grouped"] = np.ones(5, dtype=np.bool_)
    weights["conditioner.groups.mask"] = model.state_dict()["conditioner.groups.mask"]
    weights["predictor.layers.0.weight"][0, [1, 5]] = 2.0, -3.0
    weights["predictor.layers.0.weight"][1, 3] = 4.0
    weights["predictor.out.weight"][[0, 2], [0, 1]] = -5.0, 1.0
    weights["conditioner.groups.weight"][3, 6 + 1] = 2.0
    weights["conditioner.readout"][3] = 3.0
    model.load_state_dict({**weights, "pruned": np.zeros((0, 0), dtype=np.int8)})
    return model


def test_sums_over_paths() -> None:
    found = influence(sparse())
    expected = np.zeros((5, 4))
    expected[0, 1], expected[2, 3] = 10.0, 4.0
    np.testing.assert_allclose(found.states, expected)
    assert found.actions.tolist()[0] == [0.0, 15.0]
    assert found.others[3, 1] == 6.0
    assert (found.others > 0.0).sum() == 1


def test_modules_and_groups_have_names() -> None:
    found, names = influence(sparse()), ("a", "b", "c", "d")
    assert {module.text(names) for module in modules(found)} == {"a, b <- b, action", "c, d <- d"}
    assert [group.text(names) for group in dependent_groups(found)] == ["b, d <- nothing"]


def test_paths_that_cancel_each_other_are_no_dependency() -> None:
    """Two nodes contain the sum and the difference of two bits: each next bit reads both, but depends on one bit only."""
    rng = np.random.default_rng(0)
    states = rng.integers(2, size=(400, 2))
    data = dataset((2, 2), 2, states, rng.integers(2, size=400), states)
    model = NeuralTransitionModel((2, 2), 2, NeuralConfig(hidden=(2,), activation="relu", residual=False, conditioner=None))
    model.fit(data)
    weights = {name: np.zeros_like(array) for name, array in model.state_dict().items()}
    weights["predictor.layers.0.weight"][:, :2] = [[20.0, 20.0], [20.0, -20.0]]
    weights["predictor.layers.0.bias"][:] = 0.0, 20.0
    weights["predictor.out.weight"][:2] = [[1.0, 1.0], [1.0, -1.0]]
    weights["predictor.out.bias"][:] = -40.0, 0.0, -40.0
    model.load_state_dict(weights)
    assert isinstance(model.predictor, DensePredictor)
    marks = find_parents(Pair(model.predictor, None, 1.0), examples(data.rows()))
    model.load_state_dict({**model.state_dict(), "pruned": marks})
    assert (influence(model).states[:2] > 0.0).all()
    assert (influence(model, effective=True).states[:2] > 0.0).tolist() == [[True, False], [False, True]]
    assert [module.text(("a", "b")) for module in model.modules()] == ["a <- a", "b <- b"]
    assert model.dependent_groups() == []
