import numpy as np
import pytest

from mbagent.models.mdp import StateGraph
from mbagent.planning import planners
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner
from mbagent.planning.search import carry_over
from tests.worlds import TableWorld, arrival_goal, optimal_q, random_table

KINDS = {
    "lookahead": PlannerSettings(max_states=1, lookahead_states=8, gamma=0.8, reuse_tree=True),
    "rollouts": PlannerSettings(
        leaf_values="rollouts", backup="mean", num_simulations=400, horizon=8, gamma=0.8, c_uct=0.7, reuse_tree=True
    ),
}
TABLE, REWARDS = random_table(12, 2, 5), np.random.default_rng(5).normal(size=12)
WORLD = TableWorld(TABLE)


def planner(settings: PlannerSettings) -> MctsPlanner:
    made = MctsPlanner(settings)
    made.set_model(WORLD, np.array([[0]]))
    made.set_goal(arrival_goal(REWARDS))
    return made


def is_reused(made: MctsPlanner, state: int) -> bool:
    """Whether a plan from the state starts from the search of the last decision."""
    made.plan(np.array([[state]]))
    return made._last is not None and made._last.decision > 0


@pytest.mark.parametrize("kind", list(KINDS))
def test_reused_statistics_are_those_of_the_last_search(kind: str) -> None:
    made = planner(KINDS[kind])
    made.plan(np.array([[0]]))
    last = made._last
    assert last is not None
    old, tables = last.graph, last.tree
    root = int(old.next_nodes[old.first[0, 0]])
    new = StateGraph(WORLD)
    taken = carry_over(old, tables, root, new)
    assert new.states[0].tolist() == old.states[root].tolist()
    back = old.find(new.states)
    np.testing.assert_array_equal(taken.values.q, tables.values.q[back])
    np.testing.assert_array_equal(taken.values.v, tables.values.v[back])
    np.testing.assert_array_equal(new.expanded, old.expanded[back])
    np.testing.assert_array_equal(taken.root_visits[0], tables.visits[root])
    for node, action in np.ndindex(new.counts.shape):
        here = slice(new.first[node, action], new.first[node, action] + new.counts[node, action])
        there = slice(old.first[back[node], action], old.first[back[node], action] + old.counts[back[node], action])
        np.testing.assert_array_equal(new.probabilities[here], old.probabilities[there])
        np.testing.assert_array_equal(new.states[new.next_nodes[here]], old.states[old.next_nodes[there]])
        np.testing.assert_array_equal(taken.values.rewards[here], tables.values.rewards[there])


@pytest.mark.parametrize("kind", list(KINDS))
def test_decisions_with_reused_trees_have_a_small_regret(kind: str) -> None:
    made, exact, state = planner(KINDS[kind]), optimal_q(TABLE, REWARDS, 0.8), 0
    rng, reused, regrets = np.random.default_rng(0), 0, []
    for _ in range(25):
        action = int(made.plan(np.array([[state]])).actions[0])
        reused += made._last is not None and made._last.decision > 0
        regrets.append(exact[state].max() - exact[state, action])
        state = int(rng.choice(12, p=TABLE[state, action]))
    assert reused >= 10
    assert np.mean(regrets) < 0.03 * np.ptp(exact)


@pytest.mark.parametrize("kind", list(KINDS))
def test_new_goals_models_episodes_and_batches_drop_the_tree(kind: str) -> None:
    made = planner(KINDS[kind])
    first = made.plan(np.array([[0]]))
    assert is_reused(made, 0)
    made.forget()
    assert not is_reused(made, 0)
    made.set_goal(arrival_goal(REWARDS))
    assert not is_reused(made, 0)
    made.set_model(WORLD, np.array([[0]]))
    assert not is_reused(made, 0)
    batch = made.plan(np.array([[0], [1]]))
    assert not is_reused(made, 0)
    made.forget()
    np.testing.assert_array_equal(made.plan(np.array([[0]])).values, first.values)
    np.testing.assert_array_equal(batch.values[0], first.values[0])


def test_a_tree_grown_too_large_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    made = planner(KINDS["lookahead"])
    made.plan(np.array([[0]]))
    monkeypatch.setattr(planners, "MAX_KEPT", 5)
    assert not is_reused(made, 0)


def test_a_goal_that_fails_leaves_no_incomplete_tree() -> None:
    made = planner(KINDS["lookahead"])
    made.set_model(TableWorld(random_table(3000, 2, 5)), np.array([[0]]))
    made.set_goal(lambda states, actions, following: np.zeros(len(actions)))
    made.plan(np.array([[0]]))

    def failing(states: np.ndarray, actions: np.ndarray, following: np.ndarray) -> np.ndarray:
        raise RuntimeError("enough")

    made._goal = failing  # not through set_goal, which drops the tree anyway
    with pytest.raises(RuntimeError, match="enough"):
        made.plan(np.array([[0]]))
    assert made._last is None
