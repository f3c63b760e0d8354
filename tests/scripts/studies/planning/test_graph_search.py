import numpy as np
import pytest

from mbagent.planning.planner import Planner, PlannerSettings
from mbagent.planning.planners import ValueIterationPlanner
from mbagent.types import Floats
from studies.planning.graph_search import GraphSearch
from tests.worlds import optimal_q, planner_for, prize_corridor, random_table


def planner_alone(planner: Planner, table: Floats, rewards: Floats, ends: tuple[int, ...] = ()) -> Planner:
    return planner_for(planner, table, rewards, ends, start=())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ends", [(), (1, 5)], ids=["endless", "ends"])
def test_search_finds_the_best_action_of_a_stochastic_world(seed: int, ends: tuple[int, ...]) -> None:
    table, rewards = random_table(8, 3, seed), np.random.default_rng(seed).normal(size=8)
    exact = optimal_q(table, rewards, 0.8, ends)
    settings = PlannerSettings(gamma=0.8, lookahead_states=2, num_simulations=300, seed=seed)
    plan = planner_alone(GraphSearch(settings), table, rewards, ends).plan(np.arange(8)[:, None])
    regret = exact.max(axis=1) - np.take_along_axis(exact, plan.actions[:, None], axis=1)[:, 0]
    going_on = [s for s in range(8) if s not in ends]
    assert regret[going_on].max() < 0.02 * np.ptp(exact)


@pytest.mark.parametrize("seed", range(3))
def test_search_repairs_a_lookahead_too_short_to_see_the_prize(seed: int) -> None:
    # A corridor in which rewards decrease with the distance from the prize, 9 steps to the right.
    table, rewards = prize_corridor()
    short = PlannerSettings(lookahead_states=4, num_simulations=600, seed=seed)
    greedy = planner_alone(ValueIterationPlanner(short), table, rewards).plan(np.array([[0]]))
    assert greedy.values[0, 0] == greedy.values[0, 1]
    plan = planner_alone(GraphSearch(short), table, rewards).plan(np.array([[0]]))
    assert plan.actions[0] == 1
    assert plan.values[0, 1] > plan.values[0, 0]


def test_a_plan_does_not_depend_on_the_batch() -> None:
    table, rewards = random_table(25, 3, 9), np.random.default_rng(9).normal(size=25)
    planner = planner_alone(GraphSearch(PlannerSettings(lookahead_states=10)), table, rewards)
    roots = np.array([[3], [7], [3], [20]])
    together = planner.plan(roots)
    np.testing.assert_array_equal(together.values[0], together.values[2])
    for i, root in enumerate(roots):
        alone = planner.plan(root[None])
        np.testing.assert_array_equal(alone.values[0], together.values[i])
        np.testing.assert_array_equal(alone.visits[0], together.visits[i])


@pytest.mark.parametrize(("n", "wave"), [(1, 16), (7, 16), (100, 1), (1000, 256)])
def test_every_simulation_goes_through_an_action_of_the_root(n: int, wave: int) -> None:
    table, rewards = random_table(25, 3, 1), np.random.default_rng(1).normal(size=25)
    planner = planner_alone(GraphSearch(PlannerSettings(num_simulations=n, batch_size=wave, lookahead_states=5)), table, rewards)
    plan = planner.plan(np.array([[0], [9]]))
    assert plan.visits.sum(axis=1).tolist() == [n, n]
    if n == 1000:
        assert (plan.visits.max(axis=1) > 0.5 * n).all()


def test_expanded_successors_are_counted() -> None:
    table, rewards = random_table(25, 3, 1), np.zeros(25)
    planner = GraphSearch(PlannerSettings(num_simulations=8, lookahead_states=1))
    planner_alone(planner, table, rewards).plan(np.array([[0]]))
    once = planner.expanded
    assert once > 0
    planner.plan(np.array([[0]]))
    assert planner.expanded == 2 * once


def test_golden_graph() -> None:
    # A golden result: any change of selection, random numbers, expansion or backup changes it and must be intended.
    table, rewards = random_table(12, 2, 0), np.arange(12.0)
    settings = PlannerSettings(num_simulations=64, horizon=5, lookahead_states=2, c_uct=2.0, seed=1)
    plan = planner_alone(GraphSearch(settings), table, rewards).plan(np.array([[0], [1]]))
    assert plan.visits.tolist() == GOLDEN_VISITS


GOLDEN_VISITS = [[0.0, 64.0], [62.0, 2.0]]
