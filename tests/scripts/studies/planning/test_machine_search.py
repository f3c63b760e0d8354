"""Search on a known MDP: correct in the limit, independent of the batch, and reproducible by its seed."""

import numpy as np
import pytest

from mbagent.types import Floats
from studies.planning.machine_search import KnownMachine, known_machine, search_machine
from tests.worlds import optimal_q, random_table

GAMMA = 0.9


def machine_of(table: Floats, rewards: Floats, first_value: Floats, ends: tuple[int, ...] = ()) -> KnownMachine:
    n, n_actions, _ = table.shape
    rows, following = np.nonzero(table.reshape(n * n_actions, n))
    first = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n * n_actions))]).astype(np.int64)
    probabilities = table.reshape(n * n_actions, n)[rows, following]
    over = np.isin(following, ends)
    return known_machine(
        first, following.astype(np.int64), probabilities, rewards[following], over, first_value, n_actions, GAMMA
    )


@pytest.mark.parametrize("seed", range(3))
def test_values_become_the_optimal_ones(seed: int) -> None:
    table, rewards = random_table(10, 3, seed), np.random.default_rng(seed).normal(size=10)
    found = search_machine(machine_of(table, rewards, np.zeros(10)), np.arange(10), 20_000, seed, depth=5, c_uct=50.0)
    exact = optimal_q(table, rewards, GAMMA)
    np.testing.assert_allclose(found.values.max(axis=1), exact.max(axis=1), rtol=0.01, atol=0.01)
    assert (found.values.argmax(axis=1) == exact.argmax(axis=1)).mean() >= 0.9
    assert (found.visits.sum(axis=1) == 20_000).all()


def test_one_simulation_counts_and_leaf_values_are_used() -> None:
    # From state 0, deterministic actions lead to 1 or 2; only the initial values show that 2 is better.
    table = np.zeros((3, 2, 3))
    table[0, 0, 1] = table[0, 1, 2] = 1.0
    table[1, :, 1] = table[2, :, 2] = 1.0
    found = search_machine(machine_of(table, np.zeros(3), np.array([0.0, 0.0, 7.0])), np.array([0]), 1, 0)
    assert found.visits.tolist() == [[0, 1]]
    assert found.values[0].tolist() == [0.0, pytest.approx(GAMMA * GAMMA * 7.0)]
    assert found.steps == 1


def test_nothing_is_earned_after_the_end() -> None:
    table = np.zeros((2, 1, 2))
    table[:, 0, 1] = 1.0
    machine = machine_of(table, np.array([0.0, 1.0]), np.array([5.0, 5.0]), ends=(1,))
    assert search_machine(machine, np.array([0]), 50, 0).values[0, 0] == 1.0


def test_a_root_does_not_depend_on_the_others() -> None:
    table, rewards = random_table(12, 3, 4), np.random.default_rng(4).normal(size=12)
    machine, roots = machine_of(table, rewards, np.zeros(12)), np.array([3, 7, 3, 11])
    together = search_machine(machine, roots, 200, 9)
    np.testing.assert_array_equal(together.values[0], together.values[2])
    for i, root in enumerate(roots):
        alone = search_machine(machine, np.array([root]), 200, 9)
        np.testing.assert_array_equal(alone.values[0], together.values[i])
        np.testing.assert_array_equal(alone.visits[0], together.visits[i])
    assert not np.array_equal(search_machine(machine, roots, 200, 10).visits, together.visits)


def test_without_initial_values_all_actions_are_tried() -> None:
    # A corridor of 6 cells with a prize at its end; all initial values are 0.
    table, rewards = np.zeros((6, 2, 6)), (np.arange(6) == 5).astype(np.float64)
    for s in range(6):
        table[s, 0, max(s - 1, 0)] = table[s, 1, min(s + 1, 5)] = 1.0
    found = search_machine(machine_of(table, rewards, np.zeros(6)), np.array([0]), 3000, 0, depth=8)
    assert found.visits.min() > 0
    assert found.values[0, 1] > found.values[0, 0] > 0.0


@pytest.mark.parametrize("wrong", [{"depth": 0}, {"n_simulations": 0}, {"seed": -1}, {"roots": np.array([9])}])
def test_arguments_out_of_range_are_named(wrong: dict[str, object]) -> None:
    table = random_table(4, 2, 0)
    arguments = {"roots": np.array([0]), "n_simulations": 5, "seed": 0, **wrong}
    with pytest.raises(ValueError, match="must be"):
        search_machine(machine_of(table, np.zeros(4), np.zeros(4)), **arguments)  # type: ignore[arg-type]
