import numpy as np
import pytest

from mbagent.models.base import Bools, Floats, Randomness, States, Successors, as_keys
from mbagent.models.known import KnownModel
from mbagent.models.systematic import independent_successors
from mbagent.planning.fitted_values import RIDGE, Task, _Columns, _Regression, greedy_actions, learn_values
from mbagent.planning.leaf_values import LOWEST_KNOWN, LeafValues, evaluate, leaf_value
from mbagent_envs.random_keys import uniforms


class Bulbs(KnownModel):
    """Bits that go out on their own; action i > 0 lights bit i - 1."""

    def __init__(self, n: int, lasts: float | tuple[float, ...] = 0.8, n_actions: int | None = None) -> None:
        super().__init__((2,) * n, n + 1 if n_actions is None else n_actions)
        self.lasts = lasts

    def sample(self, states: States, actions: States, rng: Randomness) -> tuple[States, Bools]:
        luck = uniforms(as_keys(rng, len(states)), states.shape[1])
        return (luck < self._on(states, actions)).astype(np.int64), np.zeros(len(states), dtype=np.bool_)

    def successors(self, states: States, actions: States, n_samples: int, seed: int) -> Successors:
        on = np.column_stack([self._on(states, actions), np.zeros(len(states))])
        return independent_successors(np.stack([1.0 - on, on], axis=2), np.full(on.shape[1], 2), n_samples, seed)

    def marginals(self, states: States, actions: States) -> Floats:
        raise NotImplementedError

    def _on(self, states: States, actions: States) -> Floats:
        on: Floats = states * np.asarray(self.lasts)
        lit = np.flatnonzero(actions > 0)
        on[lit, actions[lit] - 1] = 1.0
        return on


def count_bits(states: States, actions: States, next_states: States) -> Floats:
    counts: Floats = next_states.sum(axis=1).astype(np.float64)
    return counts


def task(model: KnownModel, goal: object = count_bits, seed: int = 0) -> Task:
    start = np.zeros((1, len(model.cardinalities)), dtype=np.int64)
    return Task(model, goal, start, gamma=0.9, seed=seed)  # type: ignore[arg-type]


@pytest.mark.parametrize("n_states", [5, 50])
def test_regression_is_ridge_with_a_free_mean(n_states: int) -> None:
    rng, cardinalities = np.random.default_rng(0), (2, 3, 5)
    states = np.column_stack([rng.integers(c, size=n_states) for c in cardinalities])
    values = rng.normal(size=n_states)
    regression = _Regression(states, cardinalities)
    weights = regression.fit(values)
    columns = np.zeros((n_states, 10))
    columns[np.arange(n_states)[:, None], regression.first + states] = 1.0
    centred = columns - columns.mean(axis=0)
    expected = np.linalg.solve(centred.T @ centred + RIDGE * np.eye(10), centred.T @ (values - values.mean()))
    np.testing.assert_allclose(weights[:-1], expected, atol=1e-9)
    np.testing.assert_allclose(columns @ weights[:-1] + weights[-1], centred @ expected + values.mean(), atol=1e-9)


def test_values_that_are_sums_over_factors_are_found() -> None:
    """A bit that is on is worth what it earns until it goes out: lasts / (1 - gamma lasts)."""
    model = Bulbs(8, n_actions=1)
    problem = Task(model, count_bits, np.ones((1, 8), dtype=np.int64), gamma=0.9, seed=0)
    leaf, _ = learn_values(problem)
    differences = leaf.weights[leaf.first + 1] - leaf.weights[leaf.first]
    np.testing.assert_allclose(differences, 0.8 / (1 - 0.9 * 0.8), rtol=0.2)


def test_behaviour_by_learned_values_looks_beyond_one_step() -> None:
    """Every lit bit earns the same at once; one that lasts is worth more."""
    problem = task(Bulbs(2, lasts=(0.1, 0.95)))
    leaf, _ = learn_values(problem)
    assert greedy_actions(problem, leaf, np.array([[0, 0]]), 0)[0] == 2


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_nothing_is_learned_where_every_step_earns_the_same(value: float) -> None:
    leaf, met = learn_values(task(Bulbs(3), lambda s, a, n: np.full(len(s), value)))
    assert len(met) == 8
    assert len(leaf.weights) == 0


def test_the_seed_decides() -> None:
    first, again, other = (learn_values(task(Bulbs(4), seed=seed))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.weights, again.weights)
    assert (first.weights != other.weights).any()


def test_sums_of_many_states_are_those_of_each() -> None:
    rng = np.random.default_rng(0)
    states = np.column_stack([rng.integers(k, size=40) for k in (2, 3, 5)])
    leaf = LeafValues(rng.normal(size=11), np.array([0, 2, 5]), -1.0, 2.0)
    expected = [leaf_value(leaf, state) for state in states]
    np.testing.assert_allclose(_Columns(states, leaf.first, 11).values(leaf), expected, atol=1e-12)


def test_values_are_sums_within_bounds() -> None:
    leaf = LeafValues(np.array([0.0, 1.0, 0.0, 10.0, 20.0, 0.5]), np.array([0, 2]), 0.0, 12.0)
    states = np.array([[0, 0], [1, 1], [1, 2]])
    assert [leaf_value(leaf, state) for state in states] == [0.5, 11.5, 12.0]
    v = np.full(3, -1.0)
    evaluate(leaf, states, np.array([False, True, False]), v)
    np.testing.assert_array_equal(v, [0.5, -1.0, 12.0])
    evaluate(LOWEST_KNOWN, states, np.zeros(3, dtype=np.bool_), v)
    np.testing.assert_array_equal(v, [0.5, -1.0, 12.0])
