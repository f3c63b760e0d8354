import numpy as np
import pytest
import torch

from mbagent.models import DensePredictor, NeuralConfig
from mbagent.models.neural.export import compiled_body, in_chunks
from mbagent.models.neural.networks import Activation
from tests.models.helpers import MIXED, outcomes, random_rows, scrambled


@pytest.mark.parametrize("cardinalities", [(2, 2, 2, 2), MIXED, (7,)])
@pytest.mark.parametrize("hidden", [(), (9,), (5, 11, 3)])
@pytest.mark.parametrize("activation", ["silu", "relu", "tanh", "sigmoid"])
def test_the_compiled_predictor_is_the_torch_predictor(
    cardinalities: tuple[int, ...], hidden: tuple[int, ...], activation: Activation
) -> None:
    model = scrambled(cardinalities, 3, NeuralConfig(hidden=hidden, activation=activation, group_size=2))
    assert isinstance(model.predictor, DensePredictor)
    states, actions = random_rows(cardinalities, 3, 70)
    compiled = compiled_body(model.predictor)(states, actions)
    np.testing.assert_allclose(compiled, in_chunks(model.predictor, states, actions), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("cardinalities", [(2, 2, 2, 2), MIXED])
@pytest.mark.parametrize("correction", [True, False])
def test_compiled_log_probabilities_are_those_of_the_torch_networks(cardinalities: tuple[int, ...], correction: bool) -> None:
    model = scrambled(cardinalities, 3, NeuralConfig(hidden=(8,), group_size=4, correction=correction, certain=1.0))
    following, ends = outcomes(cardinalities)
    n = len(ends)
    states, actions = random_rows(cardinalities, 3, n)
    given = torch.from_numpy(np.concatenate([following, ends[:, None]], axis=1).astype(np.int64))
    s, a = torch.from_numpy(states), torch.from_numpy(actions)
    assert model.conditioner is not None
    with torch.no_grad():
        logits = model.conditioner(s, a, given) + (model.predictor(s, a) if correction else 0.0)
        logs = torch.log_softmax(logits.double(), dim=2)
    expected = torch.gather(logs, 2, given[:, :, None])[:, :, 0].sum(dim=1).numpy()
    np.testing.assert_allclose(model.log_prob(states, actions, following, ends), expected, atol=1e-4)
