from itertools import product

import numpy as np
import pytest

from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import MctsPlanner, ValueIterationPlanner
from mbagent.planning.trajectories import PlanTrace, TracingPlanner, likeliest_trajectories
from tests.worlds import TableWorld, arrival_goal, random_table

SETTINGS = {
    "solved": PlannerSettings(gamma=0.8),
    "search": PlannerSettings(max_states=1, lookahead_states=6, num_simulations=8),
    "rollouts": PlannerSettings(leaf_values="rollouts", backup="mean", num_simulations=40, horizon=6),
}


def trace(planner: ValueIterationPlanner, ends: tuple[int, ...] = ()) -> PlanTrace:
    planner.set_model(TableWorld(random_table(9, 2, 3), ends), np.array([[0]]))
    planner.set_goal(arrival_goal(np.random.default_rng(1).normal(size=9)))
    return planner.trace(np.array([[0]]))


def every_future(found: PlanTrace, action: int, n_steps: int) -> list[tuple[float, list[int]]]:
    """All sequences of edges by enumeration, the most probable first."""
    graph, whole = found.graph, []
    paths: list[tuple[float, list[int], int, int]] = [(1.0, [], found.root, action)]
    while paths:
        p, path, node, chosen = paths.pop()
        first = graph.first[node, chosen]
        for edge in range(first, first + graph.counts[node, chosen]):
            longer, target = [*path, edge], int(graph.next_nodes[edge])
            here = p * graph.probabilities[edge]
            if graph.terminated[edge] or len(longer) == n_steps or found.policy[target] < 0:
                whole.append((here, longer))
            else:
                paths.append((here, longer, target, int(found.policy[target])))
    return sorted(whole, key=lambda pair: -pair[0])


@pytest.mark.parametrize("ends", [(), (2, 5)])
@pytest.mark.parametrize("kind", list(SETTINGS))
def test_the_likeliest_trajectories_are_those_of_enumeration(kind: str, ends: tuple[int, ...]) -> None:
    found = trace(MctsPlanner(SETTINGS[kind]), ends)
    for n_steps, action in product((1, 2, 5), range(2)):
        expected = every_future(found, action, n_steps)
        futures = likeliest_trajectories(found, 6, n_steps)[action]
        assert len(futures) == min(6, len(expected))
        chances = [np.prod(found.graph.probabilities[path]) for path in futures]
        np.testing.assert_allclose(chances, [p for p, _ in expected[:6]])
        assert all(path in [other for _, other in expected] for path in futures)


def test_many_equally_likely_steps_do_not_make_the_search_for_trajectories_endless() -> None:
    n = 40  # 40 ** 12 trajectories of equal probability
    planner = ValueIterationPlanner(PlannerSettings())
    planner.set_model(TableWorld(np.full((n, 2, n), 1.0 / n)), np.array([[0]]))
    planner.set_goal(arrival_goal(np.arange(float(n))))
    futures = likeliest_trajectories(planner.trace(np.array([[0]])), 4, 12)
    assert [len(path) for path in futures[0]] == [12] * 4


@pytest.mark.parametrize("kind", list(SETTINGS))
def test_the_trace_has_the_same_plan(kind: str) -> None:
    planner = MctsPlanner(SETTINGS[kind])
    assert isinstance(planner, TracingPlanner)
    found = trace(planner)
    plan = planner.plan(np.array([[0]]))
    np.testing.assert_array_equal(found.plan.values, plan.values)
    np.testing.assert_array_equal(found.plan.visits, plan.visits)
    assert found.plan.actions.tolist() == plan.actions.tolist()
    assert (found.mdp_states == 9) == (kind == "solved")
