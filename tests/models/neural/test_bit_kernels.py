"""Networks of bits in compiled search: the same outcomes as by the model's own successors."""

import numpy as np
import pytest
import torch

from mbagent.models.mdp import StateGraph
from mbagent.models.neural.bit_kernels import CausalBits, pack_bits
from mbagent.models.neural.export import pack_dense, pack_groups, pack_layout
from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.neural.network_pair import NeuralConfig
from mbagent.planning.lookahead import grow_lookahead
from tests.models.helpers import QUICK, dataset

N_BITS, N_ACTIONS = 11, 3


def world(n: int, seed: int) -> tuple[np.ndarray, ...]:
    """One of four bits is on, at random; two bits are equal; one bit per action; other bits are constant; random termination."""
    rng = np.random.default_rng(seed)
    states, actions = rng.integers(2, size=(n, N_BITS)), rng.integers(N_ACTIONS, size=n)
    after = states.copy()
    after[:, :4] = np.eye(4, dtype=np.int64)[rng.integers(4, size=n)]
    after[:, 4] = rng.random(n) < 0.3
    after[:, 5] = after[:, 4]
    after[:, 6:9] = np.eye(3, dtype=np.int64)[actions]
    return states, actions, after, rng.random(n) < 0.2 * states[:, 10]


def trained(**changes: object) -> tuple[NeuralTransitionModel, np.ndarray]:
    states, actions, after, ended = world(1500, 0)
    config = NeuralConfig(hidden=(24,), group_size=6, training=QUICK, **changes)  # type: ignore[arg-type]
    model = NeuralTransitionModel((2,) * N_BITS, N_ACTIONS, config)
    model.fit(dataset(model.cardinalities, N_ACTIONS, states, actions, after, ended))
    return model, np.unique(states, axis=0)[:40]


def edges(graph: StateGraph, node: int) -> list[tuple[int, bytes, bool, float]]:
    rows = np.flatnonzero(graph.sources == node)
    states = graph.states[graph.next_nodes[rows]]
    parts = zip(graph.actions[rows], states, graph.terminated[rows], graph.probabilities[rows], strict=True)
    return sorted((int(a), s.tobytes(), bool(t), float(p)) for a, s, t, p in parts)


def assert_same(one: StateGraph, other: StateGraph, node: int, same: int) -> None:
    ours, theirs = edges(one, node), edges(other, same)
    assert [edge[:3] for edge in ours] == [edge[:3] for edge in theirs]
    np.testing.assert_allclose([edge[3] for edge in ours], [edge[3] for edge in theirs], atol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"activation": "tanh", "certain": 0.9},
        {"activation": "relu", "residual": False, "correction": False},
        {"certain": 1.0},
    ],
    ids=["default", "tanh", "relu without correction", "nothing is certain"],
)
def test_compiled_expansion_is_that_of_the_successors(changes: dict[str, object]) -> None:
    model, states = trained(**changes)
    compiled, plain = StateGraph(model), StateGraph(model)
    assert isinstance(compiled.kernel, CausalBits)
    plain.kernel = None
    groups, several = np.zeros(len(states), dtype=np.int64), 0
    for draws in (1, 4, 16):
        for graph in (compiled, plain):
            graph.clear()
            graph.expand(graph.add(states, groups), draws, seed=draws)
        several += int(compiled.counts[: len(states)].max() > 1)
        for node in range(len(states)):
            assert_same(compiled, plain, node, node)
    assert several == 3  # even with one sample, since rare values get strata


def test_successors_of_a_state_do_not_depend_on_other_states() -> None:
    model, states = trained()
    together, alone = StateGraph(model), StateGraph(model)
    together.expand(together.add(states, np.zeros(len(states), dtype=np.int64)), 8, seed=3)
    for node in range(0, len(states), 7):
        alone.clear()
        alone.expand(alone.add(states[[node]], np.zeros(1, dtype=np.int64)), 8, seed=3)
        assert edges(together, node) == edges(alone, 0)


def test_compiled_lookahead_is_that_of_any_model() -> None:
    model, states = trained()
    graphs = []
    for compiled in (True, False):
        graph = StateGraph(model)
        graph.kernel = graph.kernel if compiled else None
        grow_lookahead(graph, graph.add(states[:1], np.zeros(1, dtype=np.int64)), max_states=30, n_samples=4, horizon=8, seed=5)
        graphs.append(graph)
    expanded = np.flatnonzero(graphs[0].expanded)
    assert len(expanded) == graphs[1].expanded.sum() == 30
    for node, same in zip(expanded, graphs[1].find(graphs[0].states[expanded]), strict=True):
        assert_same(graphs[0], graphs[1], int(node), int(same))


def test_new_weights_make_a_new_kernel() -> None:
    model, _ = trained()
    before = model.kernel()
    assert isinstance(before, CausalBits)
    assert model.kernel() is before
    assert before.first.any()
    with torch.no_grad():
        for parameter in model.predictor.parameters():
            parameter.zero_()
    model.load_state_dict(model.state_dict())
    after = model.kernel()
    assert isinstance(after, CausalBits)
    assert not after.first.any()


@pytest.mark.parametrize(
    ("cardinalities", "config", "n_steps"),
    [
        ((3, 2), NeuralConfig(), 1),
        ((2, 2), NeuralConfig(hidden=(8, 8)), 1),
        ((2, 2), NeuralConfig(conditioner="others"), 1),
        ((2, 2), NeuralConfig(conditioner=None), 1),
        ((2, 2), NeuralConfig(), 2),
    ],
    ids=["not bits", "two layers", "sweeps", "no conditioner", "strings of actions"],
)
def test_unsupported_networks_have_no_kernel(cardinalities: tuple[int, ...], config: NeuralConfig, n_steps: int) -> None:
    model = NeuralTransitionModel(cardinalities, 2, config, n_steps=n_steps)
    assert model.kernel() is None
    assert StateGraph(model).kernel is None


def test_a_threshold_of_certainty_is_one_of_the_logit() -> None:
    model = NeuralTransitionModel((2, 2), 2, NeuralConfig(certain=0.9))
    assert model.conditioner is not None
    parts = pack_dense(model.predictor), pack_groups(model.conditioner), pack_layout(model.codec)  # type: ignore[arg-type]
    for certain, logit in ((0.9, np.log(9.0)), (0.3, 0.0), (1.0, np.inf)):
        kernel = pack_bits(*parts, certain)
        assert kernel is not None
        assert kernel.certain == pytest.approx(logit)
