"""Sums of a factor's value and an action component or another factor's value."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from mbagent.data import TransitionBatch
from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.dbn.effects import Operand, candidates, chained, likely_operands
from mbagent.models.dbn.features import action_encoding, feature_table, make_layout
from mbagent.types import Ints
from tests.models.helpers import dataset

LAST, ORDERS, DEMAND = 12, 6, 3.0
STOCK, ORDER = (part.ravel() for part in np.meshgrid(np.arange(LAST + 1), np.arange(ORDERS), indexing="ij"))


def sold(stock: Ints, more: Ints, demand: Ints) -> Ints:
    left: Ints = np.clip(stock + more - demand, 0, LAST)
    return left


def truth() -> NDArray[np.float64]:
    """True distribution of the next stock for every pair (stock, order), [pairs, values]."""
    probs = np.zeros((len(STOCK), LAST + 1))
    for demand in range(60):
        left = sold(STOCK, ORDER, np.full(len(STOCK), demand))
        probs[np.arange(len(STOCK)), left] += stats.poisson.pmf(demand, DEMAND)
    return probs


def distance(found: NDArray[np.float64]) -> float:
    return float(0.5 * np.abs(found - truth()).sum(axis=1).mean())


def rows(states: Ints, actions: Ints, following: Ints) -> TransitionBatch:
    n = len(actions)
    return TransitionBatch(states, actions, following, np.zeros(n, dtype=np.bool_), np.zeros(n), np.arange(n))


def two_products(n: int) -> tuple[Ints, Ints, Ints]:
    rng = np.random.default_rng(0)
    stocks, orders = rng.integers(LAST + 1, size=(n, 2)), rng.integers(ORDERS, size=(n, 2))
    return stocks, orders[:, 0] * ORDERS + orders[:, 1], sold(stocks, orders, rng.poisson(DEMAND, (n, 2)))


def on_the_way(n: int) -> tuple[Ints, Ints, Ints]:
    """Stock and the two orders in transit; the action is the new order."""
    rng = np.random.default_rng(0)
    states = np.column_stack([rng.integers(LAST + 1, size=n), rng.integers(ORDERS, size=(n, 2))])
    actions = rng.integers(ORDERS, size=n)
    return states, actions, np.column_stack([sold(states[:, 0], states[:, 1], rng.poisson(DEMAND, n)), states[:, 2], actions])


def test_each_stock_is_increased_by_its_own_component() -> None:
    model = DecisionGraphModel((LAST + 1, LAST + 1), ORDERS**2, parts=(ORDERS, ORDERS))
    model.fit(dataset((LAST + 1, LAST + 1), ORDERS**2, *two_products(1500)))
    other = np.full(len(STOCK), 4)
    first = model.marginals(np.column_stack([STOCK, other]), ORDER * ORDERS + 2)[:, : LAST + 1]
    second = model.marginals(np.column_stack([other, STOCK]), 2 * ORDERS + ORDER)[:, LAST + 1 :]
    assert max(distance(first), distance(second)) < 0.07
    again = DecisionGraphModel((LAST + 1, LAST + 1), ORDERS**2, parts=(ORDERS, ORDERS))
    again.load_state_dict(model.state_dict())
    loaded = again.marginals(np.column_stack([STOCK, other]), ORDER * ORDERS + 2)[:, : LAST + 1]
    np.testing.assert_array_equal(loaded, first)


def test_operand_can_be_another_factor() -> None:
    model = DecisionGraphModel((LAST + 1, ORDERS, ORDERS), ORDERS)
    report = model.fit(dataset((LAST + 1, ORDERS, ORDERS), ORDERS, *on_the_way(1500)))
    states, actions = np.column_stack([STOCK, ORDER, np.full(len(STOCK), 3)]), np.full(len(STOCK), 2)
    probs = model.marginals(states, actions)
    assert distance(probs[:, : LAST + 1]) < 0.07
    assert probs[:, [LAST + 1 + 3, LAST + 1 + ORDERS + 2]].min() > 0.98
    assert report.variables[0].parents == ("factor 1",)

    found = model.successors(states, actions, 64, 0)  # few enough to be listed
    own = np.repeat(np.arange(len(states)), np.diff(found.offsets))
    listed = np.zeros((len(states), LAST + 1))
    np.add.at(listed, (own, found.states[:, 0]), found.probabilities)
    assert 0.5 * np.abs(listed - probs[:, : LAST + 1]).sum(axis=1).max() < 0.05


def test_sum_is_found_although_the_next_value_is_partly_predictable() -> None:
    rng, n = np.random.default_rng(3), 5000
    states, actions = rng.integers([10, 5], size=(n, 2)), rng.integers(2, size=n)
    left = np.clip(states[:, 0] + states[:, 1] - rng.integers(5, size=n), 0, 9)
    model = DecisionGraphModel((10, 5), 2)
    model.fit(dataset((10, 5), 2, states, actions, np.column_stack([left, rng.integers(5, size=n)])))
    every = np.array(list(np.ndindex(10, 5)))
    expected = np.zeros((50, 10))
    for demand in range(5):
        expected[np.arange(50), np.clip(every.sum(axis=1) - demand, 0, 9)] += 0.2
    found = model.marginals(every, np.zeros(50, dtype=np.int64))[:, :10]
    assert 0.5 * np.abs(found - expected).sum(axis=1).max() < 0.08  # relative effects have 0.2


def test_sums_that_need_too_many_nodes_are_not_used() -> None:
    rng, n = np.random.default_rng(0), 400
    states = rng.integers(100, size=(n, 2))
    following = states.copy()
    following[:, 0] = np.clip(states.sum(axis=1) - rng.integers(50, size=n), 0, 99)
    found = rows(states, np.zeros(n, dtype=np.int64), following)
    assert likely_operands((0,), candidates((100, 100), (1,)), found) == [None]
    small = rows(states // 10, np.zeros(n, dtype=np.int64), following // 10)
    assert likely_operands((0,), candidates((10, 10), (1,)), small) == [(Operand(10, 1), 1)]


def test_most_significant_operand_is_the_true_one() -> None:
    parts = (ORDERS, 2, ORDERS)
    every = candidates((LAST + 1, 2, 4), parts)
    assert every == [Operand(LAST + 1, 0), Operand(4, 2), Operand(ORDERS, -1, 12, 0), Operand(ORDERS, -1, 1, 7)]
    assert candidates((2,), (5,)) == [Operand(5, whole=True)]
    assert candidates((2,), (2,)) == candidates((2, 2), (2, 2)) == []
    rng, n = np.random.default_rng(0), 400
    states, actions = rng.integers([LAST + 1, 2, 4], size=(n, 3)), rng.integers(72, size=n)
    following = states.copy()
    following[:, 0] = np.clip(states[:, 0] - actions // 12 + rng.integers(3, size=n), 0, LAST)
    following[:, 2] = rng.integers(4, size=n)
    assert likely_operands((0, 2), every, rows(states, actions, following)) == [(every[2], -1), None]
    assert likely_operands((0, 2), every, rows(states, actions, following).select(slice(10))) == [None, None]


@pytest.mark.parametrize("operand", candidates((LAST + 1, 2, 4), (ORDERS, 2, ORDERS)))
def test_features_of_an_operand_indicate_its_value(operand: Operand) -> None:
    rng, layout = np.random.default_rng(0), make_layout((LAST + 1, 2, 4), (), action_encoding((ORDERS, 2, ORDERS)))
    states, actions = rng.integers([LAST + 1, 2, 4], size=(200, 3)), rng.integers(72, size=200)
    shown = feature_table(layout, states, actions)[:, operand.features(layout)]
    assert (shown.sum(axis=1) == 1).all()
    np.testing.assert_array_equal(shown.argmax(axis=1), operand.of(rows(states, actions, states)))


def test_chains_select_the_node_of_the_operands_value() -> None:
    links = [(-1, 0, 0)] * 4  # three leaves and one for values without an entry
    entries = np.array([(0, 5, 7, 1), (2, 5, 7, 2), (1, 5, 8, 3)])

    def add(feature: int, off: int, on: int) -> int:
        links.append((feature, off, on))
        return len(links) - 1

    def follow(node: int, value: int) -> int:
        while links[node][0] >= 0:
            feature, off, on = links[node]
            node = on if feature == 10 + value else off
        return node

    nodes = {(now, value): node for now, value, node in chained(entries, np.array([10, 11, 12]), add, 0).tolist()}
    assert [follow(nodes[5, 7], value) for value in range(3)] == [1, 0, 2]
    assert [follow(nodes[5, 8], value) for value in range(3)] == [0, 3, 0]
