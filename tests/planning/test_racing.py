from collections import Counter

import numpy as np
import pytest

from mbagent.planning.fitted_value_iteration import Task
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner, ValueIterationPlanner
from mbagent.planning.racing import BLOCK_STEPS, MOST_BLOCKS, LookaheadConfig, _Trial, best_config
from mbagent.planning.value_iteration import LOWEST_KNOWN
from mbagent.types import Actions, Bools, Floats, Randomness, States
from tests.planning.test_fitted_value_iteration import Bulbs, count_bits

CONFIGS = tuple(LookaheadConfig(LOWEST_KNOWN, n, 1) for n in range(1, 5))
N_BULBS = 14
START = np.zeros((1, N_BULBS), dtype=np.int64)


def best(*actions: int) -> int:
    """Index of the winner among configurations, each of which always takes one action."""
    task = Task(Bulbs(3, lasts=0.5), count_bits, np.zeros((1, 3), dtype=np.int64), gamma=0.99, seed=0)
    configs = CONFIGS[: len(actions)]

    def act(config: LookaheadConfig, states: States) -> Actions:
        return np.full(len(states), actions[configs.index(config)])

    return configs.index(best_config(task, configs, act))


def test_a_better_configuration_is_found() -> None:
    assert best(0, 1) == 1
    assert best(0, 0, 1) == 2


def test_without_a_clear_difference_the_earlier_configuration_wins() -> None:
    assert best(1, 0) == 0
    assert best(1, 1) == 0
    assert best(1, 2) == 0  # equally good, but not identical
    assert best(0, 1, 2, 0) == 1


def test_no_configuration_is_simulated_twice() -> None:
    """The best configuration so far is compared with each other one by the episodes that are already simulated."""
    calls: list[tuple[int, int]] = []

    def act(config: LookaheadConfig, states: States) -> Actions:
        calls.append((config.states, len(states)))
        return np.full(len(states), config.states % 3)

    best_config(Task(Bulbs(3, lasts=0.5), count_bits, np.zeros((1, 3), dtype=np.int64), 0.99, 0), CONFIGS[:3], act)
    assert max(Counter(calls).values()) <= MOST_BLOCKS * BLOCK_STEPS


def test_no_rewards_follow_the_end_of_an_episode() -> None:
    class Ending(Bulbs):
        def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
            after, _ = super().sample(states, actions, rng)
            return after, actions == 1

    task = Task(Ending(1), count_bits, np.zeros((1, 1), dtype=np.int64), gamma=0.5, seed=0)
    lit, dark = (
        _Trial(task, CONFIGS[0], lambda config, s: np.ones(len(s), int)),
        _Trial(task, CONFIGS[0], lambda config, s: np.zeros(len(s), int)),
    )
    assert set(lit.returns(3)) == {1.0}
    assert set(dark.returns(3)) == {0.0}


def settings(**changes: object) -> PlannerSettings:
    return PlannerSettings(gamma=0.9, max_states=10, lookahead_states=4, num_simulations=4, batch_size=4, **changes)  # type: ignore[arg-type]


def planner(kind: type[ValueIterationPlanner] = MctsPlanner, **changes: object) -> ValueIterationPlanner:
    made = kind(settings(**changes))
    made.set_model(Bulbs(N_BULBS), START)
    made.set_goal(count_bits)
    return made


@pytest.mark.parametrize("kind", [ValueIterationPlanner, MctsPlanner])
def test_learned_values_are_used_if_they_perform_better(kind: type[ValueIterationPlanner]) -> None:
    """Of many bits that switch off, one that is off should be switched on; a lookahead with few samples is too noisy for that."""
    states = np.eye(N_BULBS, dtype=np.int64)[:5] ^ 1
    found = planner(kind)
    np.testing.assert_array_equal(found.plan(states).actions, np.arange(1, 6))
    assert found.config is not None
    assert len(found.config.leaf.weights)


def test_plans_do_not_depend_on_the_batch() -> None:
    states = np.random.default_rng(0).integers(0, 2, size=(6, N_BULBS))
    together = planner().plan(states)
    alone = planner()
    for i in range(6):
        plan = alone.plan(states[i : i + 1])
        np.testing.assert_array_equal(plan.values[0], together.values[i])


def test_racing_uses_neither_time_budget_nor_reuse() -> None:
    timed = planner(time_budget=0.01, reuse_tree=True)
    timed.plan(START)
    assert timed.settings.time_budget == 0.01
    assert timed.settings.reuse_tree
    assert timed.config is not None
    assert planner()._chosen_config().states == timed.config.states


def test_values_are_dropped_with_their_goal() -> None:
    made = planner()
    made.plan(START)
    first = made.config
    made.set_goal(lambda s, a, n: -count_bits(s, a, n))
    assert made.config is None
    assert made.plan(START).actions[0] == 0
    assert made.config is not first


def test_a_goal_that_fails_while_values_are_learned_leaves_the_planner_usable() -> None:
    calls = 0

    def fails_late(states: States, actions: Actions, next_states: States) -> Floats:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise RuntimeError("reward failed")
        return count_bits(states, actions, next_states)

    made = planner(time_budget=0.01)
    made.set_goal(fails_late)
    with pytest.raises(RuntimeError, match="reward failed"):
        made.plan(START)
    assert made.settings.time_budget == 0.01
    assert made.plan(START).actions.shape == (1,)


def test_learning_values_can_be_switched_off() -> None:
    made = planner(learn_values=False)
    made.plan(START)
    assert made.config == LookaheadConfig(LOWEST_KNOWN, 4, made.settings.lookahead_samples)
    with pytest.raises(ValueError, match="learn_values must be True or False"):
        settings(learn_values=1)
