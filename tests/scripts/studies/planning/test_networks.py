from dataclasses import replace

import numpy as np
import pytest

from mbagent.models.neural.model import NeuralTransitionModel
from mbagent.models.protocol import Successors
from mbagent.types import Ints
from mbagent_envs.geyser_runner import GeyserRunner
from studies.planning.network_search import MCTX, Effort, NetworkRow, planner_for, ratios
from studies.planning.networks import (
    HIT_COST,
    WIDTH,
    NetworkTask,
    PairwiseGoal,
    exact_values,
    exported,
    goals_of,
    random_play,
)
from worlds.synthetic_dbn import build_sampler

HALF = WIDTH // 2


def untrained_task() -> NetworkTask:
    goals = goals_of(2)
    solved = [exact_values(goal, NetworkTask.gamma) for goal in goals]
    states = solved[0][0][[0, 95, 199]]
    model = NeuralTransitionModel((2,) * (WIDTH + HALF), 3)
    return NetworkTask(
        random_play(GeyserRunner(width=WIDTH, hit_cost=HIT_COST), 100, 0),
        model,
        goals,
        np.stack([q[[0, 95, 199]] for _, q in solved]),
        states,
        states,
    )


def test_the_first_goal_is_the_games_own() -> None:
    game = GeyserRunner(width=WIDTH, hit_cost=HIT_COST)
    states, _ = exact_values(goals_of(0)[0], 0.5)
    actions = np.zeros(len(states), dtype=np.int64)
    expected = game.reward(states, actions, states)
    np.testing.assert_allclose(goals_of(0)[0](states, actions, states), expected)


def test_exact_values_are_those_of_a_life_at_one_column() -> None:
    # Only the last column has rewards, and staying there is optimal; from k columns away the first reward follows after k steps.
    goal = PairwiseGoal(np.eye(WIDTH + HALF)[WIDTH - 1], np.zeros((WIDTH + HALF, WIDTH + HALF)))
    states, q = exact_values(goal, 0.9)
    steps = np.maximum(WIDTH - 1 - states[:, :WIDTH].argmax(axis=1), 1)
    np.testing.assert_allclose(q.max(axis=1), 0.9 ** (steps - 1) / 0.1, atol=1e-9)


def test_regret_is_0_for_the_best_actions_and_1_on_average_for_random_ones() -> None:
    task = untrained_task()
    for goal in range(len(task.goals)):
        assert task.regrets(goal, task.q[goal].argmax(axis=1)) == 0.0
        every = np.tile(np.arange(3)[:, None], (1, 3))
        assert np.isclose(task.regrets(goal, every), 1.0)


def test_networks_are_exported_with_the_goals() -> None:
    task = untrained_task()
    arrays = exported(task)
    assert arrays["linear_goals"].shape == (3, WIDTH + HALF)
    assert arrays["starts"].shape == task.starts.shape
    assert arrays["group_others"].shape == (31, 31, 16)
    assert arrays["members"].tolist() == list(range(31))
    with pytest.raises(ValueError, match="causal conditioner"):
        exported(replace(task, model=build_sampler("sweeps", 6, 1)))


def test_random_play_has_the_length_asked_for() -> None:
    assert len(random_play(GeyserRunner(width=WIDTH), 100, 0)) == 100


def test_every_decision_pays_for_what_it_imagines(monkeypatch: pytest.MonkeyPatch) -> None:
    task, rows = untrained_task(), list[int]()
    successors = task.model.successors

    def counted(states: Ints, actions: Ints, n_samples: int, seed: int) -> Successors:
        rows.append(len(states))
        return successors(states, actions, n_samples, seed)

    monkeypatch.setattr(task.model, "successors", counted)
    planner = planner_for(task, task.goals[0], Effort(8, 2, 16), seed=0)
    planner.plan(task.starts[:1])
    once = sum(rows)
    planner.plan(task.starts[:1])
    assert sum(rows) == 2 * once > 0


def test_the_cheapest_effort_that_loses_no_more_is_taken() -> None:
    def row(search: str, n: int, regret: float, ms: float) -> NetworkRow:
        return NetworkRow(search, n, regret, 0.0, 0.0, ms, ms, n / ms, n / ms, 1.0, 1.0)

    own = [row("cheap", 4, 0.5, 0.1), row("good", 64, 0.2, 0.5), row("best", 64, 0.1, 1.0)]
    found = ratios(own, [row(MCTX, 16, 0.6, 0.2), row(MCTX, 64, 0.3, 2.0), row(MCTX, 256, 0.05, 9.0)])
    assert [r.ours for r in found[:3]] == ["cheap, 4 simulations", "good, 64 simulations", ""]
    np.testing.assert_allclose([r.ratio for r in found[:3]], [2.0, 4.0, np.nan])
    np.testing.assert_allclose([r.simulations_ratio for r in found[:3]], [np.nan, 4.0, np.nan])
