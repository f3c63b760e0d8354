import numpy as np
import pytest

from mbagent.planning.flat_monte_carlo import FlatMonteCarlo
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner, ValueIterationPlanner
from tests.worlds import optimal_q, planner_for, prize_corridor, random_table

ROLLOUTS = PlannerSettings(leaf_values="rollouts", backup="mean", num_simulations=4000, horizon=12, gamma=0.8, c_uct=0.7)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("settings", [PlannerSettings(gamma=0.8), ROLLOUTS], ids=["lookahead", "rollouts"])
def test_search_finds_the_best_action_of_a_stochastic_world(seed: int, settings: PlannerSettings) -> None:
    table, rewards = random_table(8, 3, seed), np.random.default_rng(seed).normal(size=8)
    exact = optimal_q(table, rewards, 0.8)
    plan = planner_for(MctsPlanner(settings), table, rewards).plan(np.arange(8)[:, None])
    regret = exact.max(axis=1) - np.take_along_axis(exact, plan.actions[:, None], axis=1)[:, 0]
    assert regret.max() < 0.02 * np.ptp(exact)


@pytest.mark.parametrize("seed", range(3))
def test_search_repairs_a_lookahead_too_short_to_see_the_prize(seed: int) -> None:
    # A corridor: the prize is 9 steps to the right, the lookahead has 4 states; the search must expand it.
    table, rewards = prize_corridor()
    short = PlannerSettings(max_states=1, lookahead_states=4, num_simulations=600, batch_size=4, learn_values=False, seed=seed)
    greedy = planner_for(ValueIterationPlanner(short), table, rewards).plan(np.array([[0]]))
    assert greedy.values[0, 0] == greedy.values[0, 1]
    plan = planner_for(MctsPlanner(short), table, rewards).plan(np.array([[0]]))
    assert plan.actions[0] == 1
    assert plan.values[0, 1] > plan.values[0, 0]


def test_several_successors_are_kept_for_an_action() -> None:
    # Action 0 is a coin toss between +1 and -0.6 (mean 0.2), action 1 has reward 0: a single stored successor would
    # give a wrong value.
    table = np.zeros((4, 2, 4))
    table[0, 0, 1] = table[0, 0, 2] = 0.5
    table[0, 1, 3] = 1.0
    table[1:, :, 3] = 1.0
    rewards = np.array([0.0, 1.0, -0.6, 0.0])
    for seed in range(20):
        settings = PlannerSettings(leaf_values="rollouts", backup="mean", num_simulations=2000, seed=seed, horizon=3)
        plan = planner_for(MctsPlanner(settings), table, rewards).plan(np.array([[0]]))
        assert plan.actions[0] == 0
        assert plan.values[0, 0] == pytest.approx(0.2, abs=0.15)


@pytest.mark.parametrize(
    "settings", [PlannerSettings(max_states=1, lookahead_states=10), ROLLOUTS], ids=["lookahead", "rollouts"]
)
def test_a_plan_does_not_depend_on_the_batch(settings: PlannerSettings) -> None:
    table, rewards = random_table(25, 3, 9), np.random.default_rng(9).normal(size=25)
    planner = planner_for(MctsPlanner(settings), table, rewards)
    roots = np.array([[3], [7], [3], [20]])
    together = planner.plan(roots)
    np.testing.assert_array_equal(together.values[0], together.values[2])
    for i, root in enumerate(roots):
        alone = planner.plan(root[None])
        np.testing.assert_array_equal(alone.values[0], together.values[i])
        np.testing.assert_array_equal(alone.visits[0], together.visits[i])


def test_golden_tree() -> None:
    # A golden result: any change of selection, random numbers or backup changes it and must be intended.
    table, rewards = random_table(6, 2, 0), np.arange(6.0)
    settings = PlannerSettings(leaf_values="rollouts", backup="mean", num_simulations=64, horizon=5, seed=1, c_uct=1.0)
    plan = planner_for(MctsPlanner(settings), table, rewards).plan(np.array([[0], [1]]))
    assert plan.visits.sum(axis=1).tolist() == [64.0, 64.0]
    assert plan.visits.tolist() == GOLDEN_VISITS


GOLDEN_VISITS = [[48.0, 16.0], [47.0, 17.0]]


def test_the_greatest_return_seeks_risk_and_the_mean_does_not() -> None:
    # Action 0: 10% chance of 5, else -2 (mean -1.3); action 1: always 0.
    table = np.zeros((4, 2, 4))
    table[0, 0, 1], table[0, 0, 2], table[0, 1, 3] = 0.1, 0.9, 1.0
    table[1:, :, 3] = 1.0
    rewards = np.array([0.0, 5.0, -2.0, 0.0])
    for choice, expected in (("mean", 1), ("greatest", 0)):
        settings = PlannerSettings(num_simulations=400, horizon=4, choice=choice)  # type: ignore[arg-type]
        assert planner_for(FlatMonteCarlo(settings), table, rewards).plan(np.array([[0]])).actions[0] == expected


@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 1.0), ("num_simulations", 0), ("horizon", 2.5), ("backup", "median"), ("c_uct", -1.0)],
)
def test_settings_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        PlannerSettings(**{name: value})  # type: ignore[arg-type]
