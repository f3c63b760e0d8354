import numpy as np
import pytest

from mbagent.models import SimulatorModel
from mbagent.models.base import BaseTransitionModel
from mbagent.models.mdp import ReachableMDP, StateGraph, grow_reachable
from mbagent.models.protocol import Successors
from mbagent.planning.lookahead import grow_lookahead
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.planners import ValueIterationPlanner
from mbagent.planning.value_iteration import MOST_SMALL_SAMPLES, SolvedMdp, solve
from mbagent.types import Actions, States
from mbagent_envs.geyser_runner import GeyserRunner
from tests.worlds import TableWorld, arrival_goal, optimal_q, random_table
from worlds.coupled import IndependentModel


@pytest.mark.parametrize("seed", range(5))
def test_values_of_a_complete_mdp_are_exact(seed: int) -> None:
    table, rewards = random_table(12, 3, seed), np.random.default_rng(seed).normal(size=12)
    world = TableWorld(table, ends=(11,))
    graph, complete = grow_reachable(world, np.array([[0]]), max_states=100, n_samples=4)
    values = solve(graph, arrival_goal(rewards), gamma=0.95)
    exact = optimal_q(table, rewards, 0.95, ends=(11,))
    assert complete
    inside = graph.expanded
    np.testing.assert_allclose(values.q[inside], exact[graph.states[inside, 0]], atol=1e-5)


def test_terminal_states_have_no_successors() -> None:
    table = np.zeros((3, 1, 3))
    table[0, 0, 1] = table[1, 0, 2] = table[2, 0, 2] = 1.0
    graph, complete = grow_reachable(TableWorld(table, ends=(1,)), np.array([[0]]), 10, 4)
    assert complete
    assert sorted(graph.states[:, 0]) == [0, 1]
    values = solve(graph, arrival_goal(np.array([0.0, 1.0, 100.0])), gamma=0.9)
    assert values.q[0, 0] == pytest.approx(1.0)


def test_an_endless_cost_does_not_end_at_unexpanded_states() -> None:
    n = 50
    table = np.zeros((n, 2, n))
    for s in range(n):
        table[s, 0, s] = 1.0  # stay
        table[s, 1, min(s + 1, n - 1)] = 1.0  # towards unexpanded states
    graph = StateGraph(TableWorld(table))
    graph.add(np.array([[0]]), np.zeros(1, dtype=np.int64))
    for _ in range(10):
        graph.expand(np.flatnonzero(~graph.expanded), 1, 0)
    values = solve(graph, arrival_goal(np.full(n, -1.0)), gamma=0.99)
    # Every policy costs 1 per step for ever: nothing is gained by moving to unexpanded states.
    np.testing.assert_allclose(values.v, -100.0, rtol=1e-3)


def test_solutions_of_groups_do_not_depend_on_the_batch() -> None:
    table, rewards = random_table(30, 2, 3), np.random.default_rng(3).normal(size=30) * 10
    world, goal = TableWorld(table), arrival_goal(rewards)
    settings = PlannerSettings(max_states=1, lookahead_states=12, horizon=6)
    planner = ValueIterationPlanner(settings)
    planner.set_model(world, np.array([[0]]))
    planner.set_goal(goal)
    roots = np.arange(8)[:, None]
    together = planner.plan(roots)
    for i in range(8):
        alone = planner.plan(roots[i : i + 1])
        np.testing.assert_array_equal(alone.values[0], together.values[i])
        assert alone.actions[0] == together.actions[i]


def test_more_states_than_max_states_give_no_mdp_but_a_plan() -> None:
    world = TableWorld(random_table(40, 2, 1))
    planner = ValueIterationPlanner(PlannerSettings(max_states=5))
    planner.set_model(world, np.array([[0]]))
    planner.set_goal(arrival_goal(np.arange(40.0)))
    assert planner.plan(np.array([[0], [7]])).values.shape == (2, 2)


def test_the_reachable_mdp_of_the_true_geyser_runner_is_exact() -> None:
    # 50 states: every transition probability, and the optimum the design states for a high cost.
    game = GeyserRunner(hit_cost=5.0)
    model = SimulatorModel(game)
    mdp = model.reachable_mdp(model.start_states(64))
    assert mdp.complete
    assert mdp.states.shape == (50, 15)
    assert (np.diff(mdp.offsets, axis=1) == 5).all()
    np.testing.assert_allclose(mdp.probabilities, 0.2)
    assert not mdp.terminated.any()
    position = mdp.states[:, :10].argmax(axis=1)
    for state, action in np.ndindex(50, 3):
        part = slice(mdp.offsets[state, action], mdp.offsets[state, action + 1])
        assert set(position[mdp.next_states[part]]) == {int(np.clip(position[state] + action - 1, 0, 9))}
        assert len(set(mdp.next_states[part])) == 5


class SampledGame(SimulatorModel):
    """A true model that does not list its successors: the MDP must be estimated from samples."""

    def __init__(self, game: GeyserRunner) -> None:
        super().__init__(game)
        self.lists = False


def values_of(mdp: ReachableMDP, game: GeyserRunner, gamma: float) -> dict[bytes, float]:
    """Optimal values by plain value iteration on the arrays, by state."""
    n, n_actions = len(mdp.states), mdp.offsets.shape[1] - 1
    table, rewards = np.zeros((n, n_actions, n)), np.zeros((n, n_actions, n))
    for state, action in np.ndindex(n, n_actions):
        part = slice(mdp.offsets[state, action], mdp.offsets[state, action + 1])
        table[state, action, mdp.next_states[part]] = mdp.probabilities[part]
        obs = mdp.states.astype(np.int8)
        rewards[state, action] = game.reward(np.repeat(obs[state : state + 1], n, axis=0), np.full(n, action), obs)
    v = np.zeros(n)
    for _ in range(1500):
        v = (table * (rewards + gamma * v)).sum(axis=2).max(axis=1)
    return {state.tobytes(): value for state, value in zip(mdp.states, v, strict=True)}


@pytest.mark.parametrize("hit_cost", [1.0, 5.0])
def test_the_mdp_sampled_from_the_geyser_runner_is_right_within_sampling_error(hit_cost: float) -> None:
    game, n_samples = GeyserRunner(hit_cost=hit_cost), 10_000
    listed, drawn = SimulatorModel(game), SampledGame(game)
    exact = listed.reachable_mdp(listed.start_states(64))
    sampled = drawn.reachable_mdp(drawn.start_states(64), n_samples=n_samples)
    assert sampled.complete
    assert len(sampled.probabilities) == len(exact.probabilities) == 50 * 3 * 5
    # Five standard deviations of a frequency at p = 0.2.
    assert abs(sampled.probabilities - 0.2).max() < 5 * np.sqrt(0.2 * 0.8 / n_samples)
    truth, found = values_of(exact, game, 0.99), values_of(sampled, game, 0.99)
    assert truth.keys() == found.keys()
    assert max(abs(found[state] - value) / abs(value) for state, value in truth.items()) < 0.01


def test_an_mdp_of_more_than_max_states_is_marked_as_partial() -> None:
    model = SimulatorModel(GeyserRunner())
    mdp = model.reachable_mdp(model.start_states(64), max_states=20)
    assert not mdp.complete
    expanded = np.diff(mdp.offsets, axis=1).sum(axis=1) > 0
    assert expanded.sum() == 20
    assert 20 < len(mdp.states) <= 50
    totals = np.add.reduceat(mdp.probabilities, mdp.offsets[expanded, :-1].ravel())
    np.testing.assert_allclose(totals, 1.0)


@pytest.mark.parametrize(("budget", "message"), [({"max_states": 0}, "max_states is 0"), ({"n_samples": 0}, "n_samples is 0")])
def test_an_empty_mdp_is_refused(budget: dict[str, int], message: str) -> None:
    model = SimulatorModel(GeyserRunner())
    with pytest.raises(ValueError, match=message):
        model.reachable_mdp(model.start_states(4), **budget)


def many_corridors(n_corridors: int, length: int) -> tuple[TableWorld, np.ndarray]:
    """Corridors with a prize at cell 0, from where a random cell of any corridor follows; every other corridor has no prize."""
    n = n_corridors * length
    table, rewards = np.zeros((n, 2, n)), np.zeros(n)
    for corridor, cell in np.ndindex(n_corridors, length):
        s = corridor * length + cell
        if corridor % 2 == 0 and cell == 0:
            table[s] = 1.0 / n
            rewards[s] = 1.0
            continue
        table[s, 0, corridor * length + max(cell - 1, 0)] = 1.0
        table[s, 1, corridor * length + min(cell + 1, length - 1)] = 1.0
    return TableWorld(table), rewards


@pytest.mark.parametrize("start", [1, 2, 5, 8])
def test_a_prize_that_opens_many_random_states_does_not_keep_the_agent_walking(start: int) -> None:
    # The 600 states after the prize are far more than the lookahead can expand: if it expanded them first, the corridor
    # itself would stay half unexpanded, and its unexpanded end would seem better than the prize.
    world, rewards = many_corridors(60, 10)
    planner = ValueIterationPlanner(PlannerSettings(max_states=1, lookahead_states=40))
    planner.set_model(world, np.array([[start]]))
    planner.set_goal(arrival_goal(rewards))
    for cell in range(start, 0, -1):
        assert planner.plan(np.array([[cell]])).actions[0] == 0


def test_the_lookahead_expands_certain_states_before_random_ones() -> None:
    world, _ = many_corridors(60, 10)
    graph = StateGraph(world)
    roots = graph.add(np.array([[1]]), np.zeros(1, dtype=np.int64))
    grow_lookahead(graph, roots, 30, 4, horizon=20, seed=0)
    assert set(range(10)) <= set(graph.states[graph.expanded, 0])
    assert graph.expanded.sum() == 30


def test_without_rewards_in_the_lookahead_the_agent_moves_to_unexpanded_states() -> None:
    # A corridor closed on the left; the lookahead of 6 states ends before the prize at cell 30.
    n = 40
    table = np.zeros((n, 2, n))
    for s in range(n):
        table[s, 0, max(s - 1, 0)] = table[s, 1, min(s + 1, n - 1)] = 1.0
    planner = ValueIterationPlanner(PlannerSettings(max_states=1, lookahead_states=6))
    planner.set_model(TableWorld(table), np.array([[0]]))
    planner.set_goal(arrival_goal((np.arange(n) == 30).astype(np.float64)))
    plan = planner.plan(np.array([[0], [1], [2]]))
    assert np.ptp(plan.values) == 0.0  # breaking ties does not change the values
    assert plan.actions.tolist() == [1, 1, 1]
    planner.set_goal(arrival_goal((np.arange(n) == 0).astype(np.float64)))
    assert planner.plan(np.array([[2]])).actions[0] == 0  # rewards take precedence


def test_a_small_mdp_gets_more_samples() -> None:
    drawn = SampledGame(GeyserRunner())
    mdp = SolvedMdp(drawn, drawn.start_states(64), max_states=3000, n_samples=16, seed=0)
    assert mdp.graph is not None
    assert abs(mdp.graph.probabilities - 0.2).max() < 5 * np.sqrt(0.2 * 0.8 / MOST_SMALL_SAMPLES)


def test_states_that_only_more_samples_find_do_not_prevent_a_solved_mdp() -> None:
    table = np.zeros((40, 1, 40))
    table[:, 0, 0], table[0, 0, 1:] = 1.0, 0.002  # exits of one state that only many samples find
    table[0, 0, 1] = 0.5
    table[0, 0, 0] = 1.0 - table[0, 0, 1:].sum()
    mdp = SolvedMdp(SampledWorld(table), np.array([[0]]), max_states=5, n_samples=4, seed=0)
    assert mdp.graph is not None
    assert 2 <= mdp.graph.expanded.sum() <= 5
    assert not grow_reachable(SampledWorld(table), np.array([[0]]), 5, MOST_SMALL_SAMPLES, 0)[1]


class SampledWorld(TableWorld):
    """A table with samples only, without listed successors."""

    successors = BaseTransitionModel.successors


@pytest.mark.parametrize(("n_actions", "draws"), [(8, 256), (1024, 47), (4096, 2)])
def test_with_thousands_of_actions_each_gets_fewer_samples(n_actions: int, draws: int) -> None:
    """Otherwise the outcomes of one state, each with entries for all actions, would take tens of gigabytes."""
    requested = set()

    class Coin(IndependentModel):
        def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
            requested.add(n_samples)
            return super().successors(states, actions, n_samples, seed)

    model = Coin((2,), n_actions, lambda states, actions: np.full((len(states), 1, 2), 0.5))
    graph, complete = grow_reachable(model, np.zeros((1, 1), dtype=np.int64), 10, 256)
    assert requested == {draws}
    assert complete
    assert len(graph) == 2
