"""Decisions with a time budget; a simulated clock makes them reproducible."""

import time

import numpy as np
import pytest

from mbagent.planning import planners
from mbagent.planning.flat_monte_carlo import FlatMonteCarlo
from mbagent.planning.planner import Planner, PlannerSettings
from mbagent.planning.planners import MctsPlanner
from tests.worlds import TableWorld, arrival_goal, random_table


class Clock:
    """Advances by one second at every call."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def planner(made: Planner) -> Planner:
    made.set_model(TableWorld(random_table(12, 2, 5)), np.array([[0]]))
    made.set_goal(arrival_goal(np.arange(12.0)))
    return made


def simulations(made: Planner, n_roots: int, monkeypatch: pytest.MonkeyPatch) -> float:
    monkeypatch.setattr(time, "perf_counter", Clock())
    return float(planner(made).plan(np.arange(n_roots)[:, None]).visits[0].sum())


@pytest.mark.parametrize("planner_class", [MctsPlanner, FlatMonteCarlo])
def test_more_time_gives_more_simulations_and_every_decision_has_a_batch(
    planner_class: type[Planner], monkeypatch: pytest.MonkeyPatch
) -> None:
    def of(budget: float, n_roots: int = 1) -> float:
        settings = PlannerSettings(max_states=1, lookahead_states=3, batch_size=4, time_budget=budget, num_simulations=1)
        return simulations(planner_class(settings), n_roots, monkeypatch)

    assert of(1e-9) == 4
    assert 4 < of(10.0) < of(40.0)
    assert of(10.0, n_roots=4) == of(40.0)  # the budget is for each decision


def test_rollouts_respect_the_time_budget_too(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = PlannerSettings(leaf_values="rollouts", backup="mean", batch_size=4, time_budget=20.0)
    assert simulations(MctsPlanner(settings), 1, monkeypatch) > 8


def test_a_search_ends_at_its_maximum_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planners, "MAX_SEARCHED", 1)
    settings = PlannerSettings(max_states=1, lookahead_states=3, batch_size=4, time_budget=1e6)
    assert simulations(MctsPlanner(settings), 1, monkeypatch) == 4


def test_a_solved_mdp_needs_no_time() -> None:
    plan = planner(MctsPlanner(PlannerSettings(time_budget=1e6))).plan(np.array([[0]]))
    assert plan.visits.sum() == 0.0


@pytest.mark.parametrize("budget", [0, -1.0, float("nan"), float("inf"), True, "1"])
def test_a_budget_that_is_no_time_is_refused(budget: object) -> None:
    with pytest.raises(ValueError, match="time_budget must be a finite number of seconds above 0"):
        PlannerSettings(time_budget=budget)  # type: ignore[arg-type]
