"""Truth tables of pruned networks: the same predictions as those of the matrices."""

from collections.abc import Iterator
from typing import get_args

import numpy as np
import pytest

from mbagent.models.mdp import StateGraph
from mbagent.models.neural.connections import PruningConfig
from mbagent.models.neural.model import NeuralTransitionModel, PrunedAs
from mbagent.models.neural.truth_tables import MOST_PARENTS, BitRules, Table, compile_rules
from mbagent_envs.random_keys import derive
from tests.models.neural.test_connections import N_BITS, fitted, shifted


@pytest.fixture(scope="module")
def learned() -> NeuralTransitionModel:
    data = shifted()
    model = fitted(data)
    assert model.rules() is None  # an unpruned model uses its matrices
    model.prune(data, 0.8, config=PruningConfig(evidence=False))
    return model


@pytest.fixture
def pruned(learned: NeuralTransitionModel) -> Iterator[NeuralTransitionModel]:
    weights = learned.state_dict()
    yield learned
    learned.pruned_as = "tables"
    learned.load_state_dict(weights)


def drawn(model: NeuralTransitionModel, pruned_as: PrunedAs) -> np.ndarray:
    model.pruned_as = pruned_as
    rows = shifted(seed=5).rows()
    return np.column_stack(model.sample(rows.states, rows.actions, derive(1, np.arange(len(rows.states)))))


def test_samples_are_those_of_the_matrices(pruned: NeuralTransitionModel) -> None:
    rules = pruned.rules()
    assert rules is not None
    assert (rules.bits[:, 5] - rules.bits[:, 3]).max() <= MOST_PARENTS
    assert sorted([*rules.bits[:, 0], *rules.copies[:, 0]]) == list(range(N_BITS + 1))
    theirs = drawn(pruned, "matrices")
    assert (drawn(pruned, "tables") != theirs).any(axis=1).mean() <= 0.005


def test_there_are_no_tables_if_a_bit_has_too_many_parents(
    pruned: NeuralTransitionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbagent.models.neural.truth_tables.MOST_PARENTS", 1)
    assert pruned.rules() is None
    assert pruned.kernel() is None


def test_tables_survive_saving(pruned: NeuralTransitionModel) -> None:
    other = NeuralTransitionModel(pruned.cardinalities, pruned.n_actions, pruned.config)
    other.load_state_dict(pruned.state_dict())
    first, second = pruned.rules(), other.rules()
    assert first is not None
    assert second is not None
    for name in ("table", "bits", "parents", "copies"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


def test_compiled_search_has_the_same_outcomes(pruned: NeuralTransitionModel) -> None:
    graphs = []
    states = np.unique(np.random.default_rng(0).integers(2, size=(40, N_BITS)), axis=0)
    for form in get_args(PrunedAs):
        pruned.pruned_as = form
        graphs.append(StateGraph(pruned))
        assert isinstance(graphs[-1].kernel, BitRules) == (form == "tables")
        graphs[-1].expand(graphs[-1].add(states, np.zeros(len(states), dtype=np.int64)), 8, seed=3)
    found = []
    for graph in graphs:
        rows = np.flatnonzero(graph.sources < len(states))
        keys = zip(graph.sources[rows], graph.actions[rows], map(bytes, graph.states[graph.next_nodes[rows]]), strict=True)
        found.append({(int(s), int(a), y): float(p) for (s, a, y), p in zip(keys, graph.probabilities[rows], strict=True)})
    apart = sum(abs(found[0].get(key, 0.0) - found[1].get(key, 0.0)) for key in set(found[0]) | set(found[1]))
    assert 0.5 * apart / (len(states) * pruned.n_actions) <= 0.005


def test_tables_have_no_irrelevant_parents() -> None:
    chances = np.array([[[0.0, 0.0], [1.0, 1.0]]] * 3)  # [action, the outcome's bit 4, the state's bit 2]
    plain = Table((2,), (4,), chances).simplified(chances)
    assert (plain.states, plain.others, plain.chances.tolist()) == ((), (4,), [[0.0, 1.0]])
    alone = Table((2,), (4,), chances).simplified(np.swapaxes(chances, 1, 2))
    assert (alone.states, alone.others, alone.chances.tolist()) == ((2,), (), [[0.0, 1.0]])
    nothing = Table((2,), (4,), chances).simplified(np.full((3, 2, 2), 0.5))
    assert (nothing.states, nothing.others, nothing.chances.tolist()) == ((), (), [0.5])


def test_improbable_values_are_treated_as_impossible() -> None:
    tables = [
        Table((0,), (), np.array([[1e-5, 1.0 - 1e-5]])),
        Table((), (), np.array([0.005])),
        Table((), (0,), np.array([[0.1, 1.0]])),
    ]
    rules = compile_rules(tables, 2)
    assert rules.copies.tolist() == [[0, 0, 0, 1]]
    assert rules.bits[:, 0].tolist() == [1, 2]
    assert rules.table.tolist() == [0.005, 0.1, 1.0]
    settled = compile_rules(tables, 2, settled=True)  # as used by search
    assert settled.copies.tolist() == [[0, 0, 0, 1], [1, 0, 0, 0]]
