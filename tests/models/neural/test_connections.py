"""Pruning networks: removed weights stay removed, predictions remain accurate, and failures change nothing."""

import numpy as np
import pytest
import torch

from mbagent.data import TransitionDataset
from mbagent.models.neural.connections import Connections, PruningConfig, Shrinking
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.networks import PlanePredictor
from mbagent.models.neural.training import NeuralConfig, TrainingConfig
from mbagent.spaces import PlaneLayout
from tests.models.helpers import dataset

N_BITS, N_ACTIONS = 8, 2
QUICK = TrainingConfig(min_steps=300, max_steps=300, batch_size=64)


def shifted(n: int = 1200, seed: int = 0) -> TransitionDataset:
    """Every bit takes the value of its right neighbour; the last two are random and equal to each other."""
    rng = np.random.default_rng(seed)
    states, actions = rng.integers(2, size=(n, N_BITS)), rng.integers(N_ACTIONS, size=n)
    after = np.roll(states, -1, axis=1)
    after[:, -1] = after[:, -2] = rng.integers(2, size=n)
    return dataset((2,) * N_BITS, N_ACTIONS, states, actions, after)


def fitted(data: TransitionDataset, **changes: object) -> NeuralTransitionModel:
    config = NeuralConfig(hidden=(32,), group_size=8, training=QUICK, **changes)  # type: ignore[arg-type]
    model = NeuralTransitionModel(data.cardinalities, data.n_actions, config)
    model.fit(data)
    return model


def test_a_pruned_model_is_accurate_and_can_be_saved() -> None:
    data = shifted()
    model = fitted(data)
    report = model.prune(data, 0.9, config=PruningConfig(evidence=False))
    assert report.log["pruned"] == pytest.approx(0.9, abs=0.002)
    assert report.conditioner_loss == pytest.approx(np.log(2.0), abs=0.05)  # one coin is the only uncertainty
    for connections in model.connections().values():
        assert connections.left / connections.total == pytest.approx(0.1, abs=0.005)
    again = NeuralTransitionModel(data.cardinalities, data.n_actions, model.config)
    again.load_state_dict(model.state_dict())
    assert {k: c.left for k, c in again.connections().items()} == {k: c.left for k, c in model.connections().items()}


def test_removed_connections_stay_removed_until_the_next_fit() -> None:
    data = shifted(400)
    model = fitted(data)
    by_size = PruningConfig(evidence=False)
    model.prune(data, 0.8, config=by_size)
    gone = {k: v == 0.0 for k, v in model.state_dict().items() if k.endswith("weight")}
    model.prune(data, 0.9, config=by_size)
    assert all((model.state_dict()[k][mask] == 0.0).all() for k, mask in gone.items())
    assert model.prune(data, 0.5, config=by_size).log["pruned"] == pytest.approx(0.9, abs=0.005)
    rows = data.rows()
    model.observe(rows.states[:8], rows.actions[:8], rows.next_states[:8], rows.terminated[:8])
    assert all((model.state_dict()[k][mask] == 0.0).all() for k, mask in gone.items())
    assert model.fit(data).log["pruned"] == 0.0


def test_a_model_that_cannot_be_pruned_is_unchanged() -> None:
    data = shifted(400)
    model = fitted(data)
    before = model.state_dict()

    def stop(share: float) -> None:
        raise KeyboardInterrupt

    for fraction in (1.0, -0.1, float("nan"), True):
        with pytest.raises(ValueError, match="up to but not including 1"):
            model.prune(data, fraction)
    with pytest.raises(ValueError, match="no transitions"):
        model.prune(TransitionDataset(data.cardinalities, data.n_actions), 0.5)
    with pytest.raises(KeyboardInterrupt):
        model.prune(data, 0.5, progress=stop)
    after = model.state_dict()
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_weights_shared_over_positions_are_pruned_too() -> None:
    layout = PlaneLayout(2, 2, 2, channels_last=False)
    data = shifted(400)
    config = NeuralConfig(conditioner=None, training=QUICK)
    model = NeuralTransitionModel(data.cardinalities, N_ACTIONS, config, body=lambda c, g: PlanePredictor(c, layout, generator=g))
    model.fit(data)
    assert model.prune(data, 0.75).log["pruned"] == pytest.approx(0.75, abs=0.005)


@pytest.mark.parametrize("gradual", [True, False])
def test_the_smallest_weights_are_removed(gradual: bool) -> None:
    layer = torch.nn.Linear(4, 2)
    weights = torch.tensor([[4.0, -0.1, 3.0, 0.2], [-5.0, 0.3, 0.05, 6.0]])
    layer.weight.data = weights.clone()
    connections = Connections(layer)
    shrinking = Shrinking(connections, 0.5, PruningConfig(gradual=gradual, removal=0.5))
    for step in range(1, 21):
        shrinking.after_step(step / 20)
    assert shrinking.finished
    assert torch.equal(layer.weight.data, torch.where(weights.abs() > 1.0, weights, torch.zeros(())))


def test_models_without_uncertain_factors_are_pruned_too() -> None:
    nothing, actions = np.zeros((300, 4), dtype=np.int64), np.arange(300) % 2
    model = fitted(data := dataset((2,) * 4, 2, nothing, actions, nothing))
    assert model.conditioner is not None
    assert len(model.conditioner.members) == 0
    model.prune(data, 0.9)
    drawn, ended = model.sample(nothing, actions, np.random.default_rng(1))
    assert not drawn.any()
    assert not ended.any()
