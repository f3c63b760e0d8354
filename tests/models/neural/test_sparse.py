"""Networks as lists of connections: predictions of the torch modules, and only the remaining weights."""

import numpy as np
import pytest
import torch

from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.network_pair import NeuralConfig
from mbagent.models.neural.networks import DensePredictor
from mbagent.models.neural.sparse import ask, leans_on_open, pack_sparse, room_for, see_action, see_state
from mbagent.models.neural.truth_tables import Pair, chances

N_BITS, N_ACTIONS, N_OUT = 5, 3, 6


def thinned(hidden: tuple[int, ...] = (16,), seed: int = 0) -> NeuralTransitionModel:
    """Random weights, of which three quarters are removed."""
    config = NeuralConfig(hidden=hidden, group_size=4, activation="tanh")
    model = NeuralTransitionModel((2,) * N_BITS, N_ACTIONS, config, seed=seed)
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for part in (model.predictor, model.conditioner):
            assert part is not None
            for parameter in part.parameters():
                parameter.normal_(generator=rng)
                parameter.mul_(torch.rand(parameter.shape, generator=rng) < 0.25)
    return model


def test_probabilities_are_those_of_the_torch_modules() -> None:
    model = thinned()
    assert isinstance(model.predictor, DensePredictor)
    k, plain = (pack_sparse(model.predictor, c, 1.0, np.ones(N_OUT, dtype=np.bool_)) for c in (model.conditioner, None))
    pairs, rng = [Pair(model.predictor, c, 2.0) for c in (model.conditioner, None)], np.random.default_rng(1)
    none = np.zeros((1, 1), dtype=np.int64)
    for _ in range(20):
        state, action, outcome = rng.integers(2, size=N_BITS), int(rng.integers(N_ACTIONS)), rng.integers(2, size=N_OUT)
        columns = torch.from_numpy(np.concatenate([state, np.eye(N_ACTIONS)[action], outcome]).astype(np.float32))[None]
        for networks, pair in zip((k, plain), pairs, strict=True):
            room = room_for(networks)
            see_state(networks, room, state)
            see_action(networks, room, state, action)
            with torch.no_grad():
                expected = [float(chances(pair, columns, i)) for i in range(N_OUT)]
            conditioned = [ask(networks, room, i, action, 0, state, outcome, none[0], none) for i in range(N_OUT)]
            ours = np.where(room.conditioned, conditioned, room.chances).tolist()
            assert ours == pytest.approx(expected, abs=1e-5)


def test_only_connections_of_the_requested_bits_are_included() -> None:
    model = thinned()
    assert isinstance(model.predictor, DensePredictor)
    requested = np.array([False, True, False, False, True, False])
    some = pack_sparse(model.predictor, model.conditioner, 0.99, requested)
    everything = pack_sparse(model.predictor, model.conditioner, 0.99, np.ones(N_OUT, dtype=np.bool_))
    assert some is not None
    assert everything is not None
    assert 0 < len(some.bias) < len(everything.bias)
    assert len(some.outputs.weight) == int((model.predictor.out.weight[requested] != 0.0).sum())
    assert some.groups.grouped.tolist() == requested.tolist()
    assert np.diff(some.groups.begin)[~requested].sum() == 0


def test_only_connected_groups_depend_on_an_open_bit() -> None:
    model = thinned()
    assert isinstance(model.predictor, DensePredictor)
    k = pack_sparse(model.predictor, model.conditioner, 1.0, np.ones(N_OUT, dtype=np.bool_))
    assert k is not None
    n_inputs = N_BITS + N_ACTIONS
    begin, other, _ = k.groups.links
    for i in range(N_OUT):
        seen = set(other[begin[k.groups.begin[i]] : begin[k.groups.begin[i + 1]]].tolist())
        for j in range(N_OUT):
            base = np.zeros(N_OUT, dtype=np.int64)
            base[j] = -1
            assert leans_on_open(k, i, base) == (n_inputs + j in seen)


def test_several_hidden_layers_are_not_supported() -> None:
    model = thinned((8, 8))
    assert isinstance(model.predictor, DensePredictor)
    assert pack_sparse(model.predictor, model.conditioner, 0.99, np.ones(N_OUT, dtype=np.bool_)) is None
