"""Decision graphs in compiled search: the same state graph as from the model's own successors, for any kind of model."""

from collections.abc import Callable

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.dbn.affected_variables import AffectedIndex
from mbagent.models.mdp import StateGraph
from mbagent.models.registry import build_model
from mbagent.planning.lookahead import grow_lookahead
from mbagent.spaces import FactoredSpace
from mbagent_envs import FlierCatcher, GeyserRunner, Maneuverer
from mbagent_envs.game import Game
from tests.models.dbn.planes.test_invariants import fitted
from tests.models.dbn.test_model import CARDINALITIES, small_world
from tests.models.helpers import dataset, played


def of_game(game: Game) -> tuple[DecisionGraphModel, np.ndarray]:
    data = played(game, 1500, 100)
    model = build_model("graphs", FactoredSpace(game.observation_space), int(game.action_space.n), 0.02)
    assert isinstance(model, DecisionGraphModel)
    model.fit(data)
    return model, data.rows().states


def of_game_as_bits(game: Game) -> tuple[DecisionGraphModel, np.ndarray]:
    data = played(game, 3000, 100)
    model = DecisionGraphModel(data.cardinalities, int(game.action_space.n))
    model.fit(data)
    return model, data.rows().states


def of_small_world() -> tuple[DecisionGraphModel, np.ndarray]:
    states, actions, following, terminated = small_world(4000, 0)
    model = DecisionGraphModel(CARDINALITIES, 2)
    model.fit(dataset(CARDINALITIES, 2, states, actions, following, terminated))
    return model, states


def of_walker() -> tuple[DecisionGraphModel, np.ndarray]:
    """A random walker: up or down, or right under action 1; on the target, the episode ends with probability 3/4."""
    rng, rows, place = np.random.default_rng(0), [], (0, 0)
    target = np.zeros((4, 4), dtype=np.int64)
    target[2, 3] = 1
    for _ in range(4000):
        before, action = np.zeros((4, 4), dtype=np.int64), int(rng.integers(2))
        before[place] = 1
        move = (int(rng.integers(-1, 2)), action * int(rng.integers(2)))
        place = (place[0] + move[0]) % 4, (place[1] + move[1]) % 4
        after = np.zeros((4, 4), dtype=np.int64)
        after[place] = 1
        over = bool((after & target).any() and rng.random() < 0.75)
        rows.append((np.stack([before, target]).ravel(), action, np.stack([after, target]).ravel(), over))
        place = (0, 0) if over else place
    states, actions, following, terminated = (np.array(part) for part in zip(*rows, strict=True))
    space = FactoredSpace(spaces.MultiBinary((2, 4, 4)))
    model = build_model("graphs", space, 2, 0.02)
    assert isinstance(model, DecisionGraphModel)
    model.fit(dataset(space.cardinalities, 2, states, actions, following, terminated))
    return model, states


def test_affected_variables_are_used_if_only_the_end_is_synchronic() -> None:
    model, _ = of_walker()
    kernel = model.kernel()
    assert isinstance(kernel, AffectedIndex)
    assert len(kernel.synchronic.changing) == 1
    assert len(model.fitted.synchronic.changing) == 1


WORLDS: dict[str, Callable[[], tuple[DecisionGraphModel, np.ndarray]]] = {
    "planes with redraws": lambda: of_game(Maneuverer(size=4)),
    "planes with noise": lambda: of_game(FlierCatcher(height=4, width=5)),
    "groups": lambda: of_game(GeyserRunner()),
    "resets": lambda: of_game_as_bits(Maneuverer(size=4)),
    "wheels and ends": of_small_world,
    "random ends in some next states": of_walker,
    "planes with invariants": fitted,
}


def edges(graph: StateGraph, node: int) -> list[tuple[int, bytes, bool, float]]:
    rows = np.flatnonzero(graph.sources == node)
    states = graph.states[graph.next_nodes[rows]]
    parts = zip(graph.actions[rows], states, graph.terminated[rows], graph.probabilities[rows], strict=True)
    return sorted((int(a), s.tobytes(), bool(t), round(float(p), 6)) for a, s, t, p in parts)


@pytest.mark.parametrize("name", WORLDS)
def test_compiled_expansion_equals_the_successors(name: str) -> None:
    model, states = WORLDS[name]()
    roots = np.unique(states[::7], axis=0)[:60]
    compiled, plain = StateGraph(model), StateGraph(model)
    assert compiled.kernel is not None
    plain.kernel = None
    groups = np.zeros(len(roots), dtype=np.int64)
    for draws in (1, 4, 16):
        for graph in (compiled, plain):
            graph.clear()
            graph.expand(graph.add(roots, groups), draws, seed=draws)
        assert compiled.expanded[: len(roots)].all()
        for node in range(len(roots)):
            assert edges(compiled, node) == edges(plain, node)


@pytest.mark.parametrize("name", WORLDS)
def test_compiled_lookahead_equals_the_general_one(name: str) -> None:
    model, states = WORLDS[name]()
    roots = states[[0, 40, 80]]
    graphs = []
    for compiled in (True, False):
        graph = StateGraph(model)
        graph.kernel = graph.kernel if compiled else None
        grow_lookahead(graph, graph.add(roots, np.arange(3)), max_states=50, n_samples=4, horizon=12, seed=5)
        graphs.append(graph)
    for group in range(3):
        expanded = [
            {g.states[node].tobytes(): edges(g, int(node)) for node in np.flatnonzero(g.expanded & (g.groups == group))}
            for g in graphs
        ]
        assert expanded[0] == expanded[1]


def test_cleared_state_graph_equals_a_new_one() -> None:
    model, states = WORLDS["groups"]()
    graph = StateGraph(model)
    for _ in range(3):
        graph.clear()
        grow_lookahead(graph, graph.add(states[:1], np.zeros(1, dtype=np.int64)), 20, 4, horizon=9, seed=1)
        sizes = len(graph), graph.n_edges
        assert graph.expanded.sum() == 20
    assert sizes == (len(graph), graph.n_edges)
    assert graph.find(states[:1])[0] == 0


def test_many_equally_probable_states_are_expanded_together() -> None:
    # One step draws five wheels and sets a sixth, which keep their values from then on: 96 equally probable states, more than fit
    # into the arrays at first.
    rng = np.random.default_rng(0)
    states, actions = rng.integers(3, size=(4000, 7)), rng.integers(3, size=4000)
    states[:, 6] = rng.integers(2, size=4000)
    following = np.where(states[:, 6:] == 1, states, rng.integers(3, size=(4000, 7)))
    following[:, 5] = np.where(states[:, 6] == 1, states[:, 5], actions)
    following[:, 6] = 1
    model = DecisionGraphModel((*(3,) * 6, 2), 3)
    model.fit(dataset(model.cardinalities, 3, states, actions, following))
    graph = StateGraph(model)
    roots = graph.add(states[states[:, 6] == 0][:1], np.zeros(1, dtype=np.int64))
    grow_lookahead(graph, roots, 300, 200, horizon=5, seed=0)
    assert graph.expanded.all()
    assert 80 < graph.expanded.sum() <= 97
