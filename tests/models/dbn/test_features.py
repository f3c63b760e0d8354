"""Actions with components: the effect of one component is learned from few steps, and generalises to actions never taken."""

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.models.dbn import DecisionGraphModel, LocalGraphModel
from mbagent.models.dbn.features import action_encoding, action_feature_table
from mbagent.models.mdp import StateGraph
from mbagent.models.registry import build_model
from mbagent.spaces import ActionEnumeration, FactoredSpace
from tests.models.helpers import dataset

SWITCHES = (2,) * 8


def pressed(actions: NDArray[np.int64], switch: int) -> NDArray[np.int64]:
    """Whether a switch is on in actions numbered as ActionEnumeration numbers those of MultiBinary(8)."""
    on: NDArray[np.int64] = actions >> (7 - switch) & 1
    return on


def test_features_are_the_components_of_enumerated_actions() -> None:
    enumerated = ActionEnumeration(spaces.MultiDiscrete([2, 3, 2]))
    parts = enumerated.decode(np.arange(enumerated.n))
    expected = np.stack([parts[:, 0] == 1, *(parts[:, 1] == v for v in range(3)), parts[:, 2] == 1], axis=1)
    encoding = action_encoding(enumerated.factored.cardinalities)
    assert np.array_equal(action_feature_table(encoding, np.arange(enumerated.n)), expected)
    assert np.array_equal(action_feature_table(action_encoding((4,)), np.arange(4)), np.eye(4, dtype=bool))


def test_one_of_eight_switches_is_learned_from_few_steps_also_for_actions_never_taken() -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.integers(2, size=(300, 2)), rng.integers(256, size=300)
    following = np.stack([states[:, 0] ^ pressed(actions, 2), states[:, 0]], axis=1)
    data = dataset((2, 2), 256, states, actions, following)
    every, tests = np.arange(256), rng.integers(2, size=(256, 2))
    expected = np.stack([tests[:, 0] ^ pressed(every, 2), tests[:, 0]], axis=1)
    assert len(np.unique(actions)) < 200
    model = DecisionGraphModel((2, 2), 256, parts=SWITCHES)
    report = model.fit(data)
    assert np.array_equal(model.likeliest(tests, every)[0], expected)
    assert report.variables[0].parents == ("action",)
    whole = DecisionGraphModel((2, 2), 256)
    whole.fit(data)
    assert not np.array_equal(whole.likeliest(tests, every)[0], expected)


def test_compiled_search_has_the_same_outcomes_as_the_model() -> None:
    rng = np.random.default_rng(1)
    states, actions = np.stack([rng.integers(5, size=600), rng.integers(2, size=600)], axis=1), rng.integers(256, size=600)
    place = (states[:, 0] + pressed(actions, 0) - pressed(actions, 5)).clip(0, 4)
    lamp = np.where(pressed(actions, 3) == 1, rng.random(600) < 0.5, states[:, 1])
    model = build_model("auto", FactoredSpace(spaces.MultiDiscrete([5, 2])), 256, 0.02, SWITCHES)
    model.fit(dataset((5, 2), 256, states, actions, np.stack([place, lamp], axis=1)))
    graph = StateGraph(model)
    root = graph.add(np.asarray([[2, 1]]), np.zeros(1, dtype=np.int64))
    graph.expand(root, 32, 0)
    found = model.successors(np.repeat([[2, 1]], 256, axis=0), np.arange(256), 32, 0)
    assert np.array_equal(graph.counts[0], np.diff(found.offsets))
    assert np.array_equal(graph.states[graph.next_nodes], found.states)
    assert graph.probabilities == pytest.approx(found.probabilities)


def test_planes_learn_action_components_and_weights_are_restored() -> None:
    rng = np.random.default_rng(2)
    space = FactoredSpace(spaces.MultiBinary((1, 3, 3)))
    states, actions = rng.integers(2, size=(300, 9)), rng.integers(256, size=300)
    following = states ^ pressed(actions, 6)[:, None]
    model = LocalGraphModel(space, 256, parts=SWITCHES)
    model.fit(dataset((2,) * 9, 256, states, actions, following))
    every, tests = np.arange(256), rng.integers(2, size=(256, 9))
    assert np.array_equal(model.likeliest(tests, every)[0], tests ^ pressed(every, 6)[:, None])
    other = LocalGraphModel(space, 256, parts=SWITCHES)
    other.load_state_dict(model.state_dict())
    assert np.array_equal(other.marginals(tests, every), model.marginals(tests, every))
    with pytest.raises(ValueError, match="do not fit"):
        LocalGraphModel(space, 256).load_state_dict(model.state_dict())


def test_parts_that_do_not_multiply_to_the_number_of_actions_raise() -> None:
    with pytest.raises(ValueError, match="make 256 actions, not 255"):
        DecisionGraphModel((2,), 255, parts=SWITCHES)
