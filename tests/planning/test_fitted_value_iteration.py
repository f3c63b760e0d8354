import numpy as np
import pytest

from mbagent.models.base import ExactModel
from mbagent.models.neural.sampling import independent_successors
from mbagent.models.protocol import Successors, as_keys
from mbagent.planning.fitted_value_iteration import Task, greedy_actions, learn_values
from mbagent.planning.value_iteration import evaluate
from mbagent.types import Bools, Floats, Randomness, States
from mbagent_envs.random_keys import uniforms


class Bulbs(ExactModel):
    """Bits that switch off at random; action i > 0 switches bit i - 1 on."""

    def __init__(self, n: int, lasts: float | tuple[float, ...] = 0.8, n_actions: int | None = None) -> None:
        super().__init__((2,) * n, n + 1 if n_actions is None else n_actions)
        self.lasts = lasts

    def sample(self, states: States, actions: States, rng: Randomness) -> tuple[States, Bools]:
        noise = uniforms(as_keys(rng, len(states)), states.shape[1])
        return (noise < self._on(states, actions)).astype(np.int64), np.zeros(len(states), dtype=np.bool_)

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


def task(model: ExactModel, goal: object = count_bits, seed: int = 0) -> Task:
    start = np.zeros((1, len(model.cardinalities)), dtype=np.int64)
    return Task(model, goal, start, gamma=0.9, seed=seed)  # type: ignore[arg-type]


def test_values_that_are_sums_over_factors_are_found() -> None:
    """The value of an active bit is its expected income until it switches off: lasts / (1 - gamma lasts)."""
    model = Bulbs(8, n_actions=1)
    problem = Task(model, count_bits, np.ones((1, 8), dtype=np.int64), gamma=0.9, seed=0)
    leaf, _ = learn_values(problem)
    on = np.eye(9, 8, -1, dtype=np.int64)  # no bit, then each bit alone
    values = np.empty(9)
    evaluate(leaf, on, np.zeros(9, dtype=np.bool_), values)
    np.testing.assert_allclose(values[1:] - values[0], 0.8 / (1 - 0.9 * 0.8), rtol=0.2)


def test_greedy_actions_on_learned_values_look_beyond_one_step() -> None:
    """All active bits have the same immediate reward, but one that stays on longer has a higher value."""
    problem = task(Bulbs(2, lasts=(0.1, 0.95)))
    leaf, _ = learn_values(problem)
    assert greedy_actions(problem, leaf, np.array([[0, 0]]), 0)[0] == 2


class Catch(ExactModel):
    """A ball falls down a column, one row at a time; actions move a paddle to the left or right, or not at all."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__((width, height, width), 3)
        self.width, self.height = width, height

    def sample(self, states: States, actions: States, rng: Randomness) -> tuple[States, Bools]:
        column, row, paddle = states.T
        paddle = np.clip(paddle + actions - 1, 0, self.width - 1)
        return np.stack([column, np.minimum(row + 1, self.height - 1), paddle], axis=1), row + 1 == self.height - 1

    def successors(self, states: States, actions: States, n_samples: int, seed: int) -> Successors:
        following, over = self.sample(states, actions, np.random.default_rng(seed))
        return Successors(np.arange(len(states) + 1), following, over, np.ones(len(states)))

    def marginals(self, states: States, actions: States) -> Floats:
        raise NotImplementedError


def caught(states: States, actions: States, next_states: States) -> Floats:
    there: Floats = ((next_states[:, 1] == 7) & (next_states[:, 0] == next_states[:, 2])).astype(np.float64)
    return there


def test_values_that_depend_on_pairs_of_factors_are_found() -> None:
    """The best place of the paddle depends on that of the ball, which no sum over single factors represents."""
    model, every = Catch(6, 8), np.array([(c, 0, p) for c in range(6) for p in range(6)])
    problem = Task(model, caught, every, gamma=0.9, seed=0)
    leaf, _ = learn_values(problem)
    states, total = every, np.zeros(len(every))
    for step in range(7):
        actions = greedy_actions(problem, leaf, states, step)
        following, _ = model.sample(states, actions, np.random.default_rng(0))
        total, states = total + caught(states, actions, following), following
    assert total.mean() > 0.9


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_nothing_is_learned_if_all_rewards_are_equal(value: float) -> None:
    leaf, visited = learn_values(task(Bulbs(3), lambda s, a, n: np.full(len(s), value)))
    assert len(visited) == 8
    assert len(leaf.common) == 0


def test_results_depend_on_the_seed_only() -> None:
    # so many bits that their outcomes must be sampled
    first, again, other = (learn_values(task(Bulbs(8), seed=seed))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.weights, again.weights)
    assert len(first.weights) != len(other.weights) or (first.weights != other.weights).any()
