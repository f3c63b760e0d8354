"""Unsupported connections: noise is removed, true parents remain, and the mean prediction is unchanged."""

import numpy as np
import pytest
import torch

from mbagent.data import TransitionDataset
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.networks import Affine, DensePredictor
from mbagent.models.neural.pruning import Judge, influence, trim_layer
from mbagent.models.neural.training import Examples, NeuralConfig, TrainingConfig, examples
from tests.models.helpers import dataset
from tests.models.neural.test_connections import N_BITS, fitted, shifted


def coins(n: int = 800) -> TransitionDataset:
    """Each bit of the next state is a coin."""
    rng = np.random.default_rng(0)
    states, after = rng.integers(2, size=(n, N_BITS)), rng.integers(2, size=(n, N_BITS))
    return dataset((2,) * N_BITS, 2, states, rng.integers(2, size=n), after)


def test_coins_keep_no_parents() -> None:
    data = coins()
    model = fitted(data)
    model.prune(data, 0.5)
    found = influence(model)
    links = [found.states > 0.0, found.actions > 0.0, found.others > 0.0, found.conditions > 0.0]
    assert sum(int(link.sum()) for link in links) <= 2  # of some 200: by chance, about one in a hundred is kept


def test_only_true_parents_remain() -> None:
    data = shifted()
    model = fitted(data)
    report = model.prune(data, 0.5)
    found = influence(model)
    truth = np.eye(N_BITS, k=1, dtype=bool)
    truth[-2, -1] = False  # the last two are random and equal to each other
    wrong = (found.states[:-1] > 0.0) != truth
    assert not (truth & wrong).any()
    assert wrong.sum() <= 4  # of 64
    assert found.others[N_BITS - 1, N_BITS - 2] > 0.0
    assert report.conditioner_loss == pytest.approx(np.log(2.0), abs=0.03)


def test_variables_of_many_values_keep_their_parents() -> None:
    rng = np.random.default_rng(1)
    states, actions = rng.integers(3, size=(1500, 4)), rng.integers(2, size=1500)
    after = np.column_stack([(states[:, 1] + actions) % 3, states[:, 1], rng.integers(3, size=1500), states[:, 3]])
    data = dataset((3,) * 4, 2, states, actions, after)
    config = NeuralConfig(hidden=(32,), group_size=8, training=TrainingConfig(min_steps=600, max_steps=600, batch_size=64))
    model = NeuralTransitionModel(data.cardinalities, data.n_actions, config)
    model.fit(data)
    report = model.prune(data, 0.3)
    found = influence(model)
    assert (found.states[:4] > 0.0).tolist() == [[i == j for j in (0, 1, 2, 3)] for i in (1, 1, 9, 3)]
    assert found.actions[0].any()
    assert not found.actions[2:].any()
    assert report.conditioner_loss == pytest.approx(np.log(3.0), abs=0.1)


def rows(n: int = 500) -> Examples:
    return examples(shifted(n).rows())


def test_the_mean_contribution_of_a_connection_is_added_to_the_bias() -> None:
    given = rows()
    judge = Judge(given, torch.arange(N_BITS + 1), torch.zeros(len(given), N_BITS + 1), 10**9, 1)
    judge.price = np.inf  # all connections are removed
    weight, bias = torch.ones(1, 3), torch.zeros(1)
    inputs = torch.from_numpy(np.random.default_rng(0).random((len(given), 3)).astype(np.float32))
    expected = float(judge.mean(inputs).sum())
    trim_layer(inputs, weight, bias, torch.tensor([4]), judge)
    assert (weight == 0.0).all()
    assert float(bias) == pytest.approx(expected, rel=1e-5)
    changed = -(inputs - judge.mean(inputs)).sum(dim=1)
    assert torch.allclose(judge.logits[:, 4], changed, atol=1e-5)
    assert (judge.logits[:, :4] == 0.0).all()


def test_the_judge_measures_the_loss_of_outcomes() -> None:
    given = rows()
    judge = Judge(given, torch.arange(N_BITS + 1), torch.zeros(len(given), N_BITS + 1), len(given), 1)
    assert judge.price == pytest.approx(0.5 * np.log(len(given)) / len(given))
    right = 4.0 * given.outcomes[:, :1].float() - 2.0
    column = torch.tensor([0])
    assert judge.accepts(column, right)  # closer to the observed outcomes
    assert not judge.accepts(column, -right)  # and back again
    assert torch.equal(judge.logits[:, :1], right)


def test_nodes_without_a_path_to_an_output_are_removed() -> None:
    data = coins(300)
    config = NeuralConfig(hidden=(12, 6), conditioner=None, training=TrainingConfig(min_steps=300, max_steps=300, batch_size=64))
    model = NeuralTransitionModel(data.cardinalities, data.n_actions, config)
    model.fit(data)
    before = model.connections()["predictor"].left
    model.prune(data, 0.0)
    assert model.connections()["predictor"].left < 0.5 * before
    predictor = model.predictor
    assert isinstance(predictor, DensePredictor)
    first, second = (layer.weight for layer in predictor.layers if isinstance(layer, Affine))
    assert not (first != 0.0)[(second == 0.0).all(dim=0)].any()
    assert not (second != 0.0)[(predictor.out.weight == 0.0).all(dim=0)].any()
