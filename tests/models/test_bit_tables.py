"""Truth tables of a pruned network: the same world, by look-ups."""

import numpy as np
import pytest

from mbagent.models.bit_tables import BitTables
from mbagent.models.network_pair import NO_MARKS
from mbagent.models.neural import NeuralTransitionModel
from mbagent.models.state_graph import StateGraph
from mbagent.models.tabulate import MOST_PARENTS
from mbagent_envs.random_keys import derive
from tests.models.test_pruning import N_BITS, fitted, shifted


@pytest.fixture(scope="module")
def pruned() -> NeuralTransitionModel:
    data = shifted()
    model = fitted(data)
    assert model.tables() is None  # an unpruned one goes by its networks
    model.prune(data, 0.9)
    return model


def networks_only(model: NeuralTransitionModel) -> NeuralTransitionModel:
    """The same weights without tables."""
    other = NeuralTransitionModel(model.cardinalities, model.n_actions, model.config)
    other.load_state_dict({**model.state_dict(), "pruned": NO_MARKS})
    return other


def test_draws_are_those_of_the_networks(pruned: NeuralTransitionModel) -> None:
    tables = pruned.tables()
    assert isinstance(tables, BitTables)
    assert np.diff(tables.first).max() <= MOST_PARENTS
    rows = shifted(seed=5).rows()
    keys = derive(1, np.arange(len(rows.states)))
    ours = np.column_stack(pruned.sample(rows.states, rows.actions, keys))
    theirs = np.column_stack(networks_only(pruned).sample(rows.states, rows.actions, keys))
    assert (ours != theirs).any(axis=1).mean() <= 0.005


def test_tables_survive_saving(pruned: NeuralTransitionModel) -> None:
    other = NeuralTransitionModel(pruned.cardinalities, pruned.n_actions, pruned.config)
    other.load_state_dict(pruned.state_dict())
    first, second = pruned.tables(), other.tables()
    assert first is not None
    assert second is not None
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in BitTables._fields)


def test_compiled_search_imagines_the_same_with_tables(pruned: NeuralTransitionModel) -> None:
    graphs = [StateGraph(pruned), StateGraph(networks_only(pruned))]
    assert isinstance(graphs[0].kernel, BitTables)
    states = np.unique(np.random.default_rng(0).integers(2, size=(40, N_BITS)), axis=0)
    for graph in graphs:
        graph.expand(graph.add(states, np.zeros(len(states), dtype=np.int64)), 8, seed=3)
    found = []
    for graph in graphs:
        rows = np.flatnonzero(graph.sources < len(states))
        keys = zip(graph.sources[rows], graph.actions[rows], map(bytes, graph.states[graph.next_nodes[rows]]), strict=True)
        found.append({(int(s), int(a), y): float(p) for (s, a, y), p in zip(keys, graph.probabilities[rows], strict=True)})
    apart = sum(abs(found[0].get(key, 0.0) - found[1].get(key, 0.0)) for key in set(found[0]) | set(found[1]))
    assert 0.5 * apart / (len(states) * pruned.n_actions) <= 0.005
