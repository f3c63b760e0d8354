"""Flat Monte Carlo, step by step and with forecasts of several steps."""

import numpy as np
import pytest

from mbagent import ModelLearningAgent
from mbagent.models.forecasts import DirectForecastModel
from mbagent.planning.flat_monte_carlo import FlatMonteCarlo
from mbagent.planning.planner import PlannerSettings
from mbagent.planning.rollouts import forecast_returns, random_returns
from mbagent_envs.random_keys import derive
from tests.worlds import TableWorld, arrival_goal, random_table


def settings(forecasts: str) -> PlannerSettings:
    return PlannerSettings(num_simulations=64, horizon=5, forecasts=forecasts)  # type: ignore[arg-type]


class StringWorld(TableWorld):
    """The exact model of ``n`` steps of a table world."""

    def __init__(self, table: np.ndarray, ends: tuple[int, ...], n: int) -> None:
        n_states, n_actions, _ = table.shape
        stays = np.eye(n_states)[:, None].repeat(n_actions, axis=1)
        single = np.where(np.isin(np.arange(n_states), ends)[:, None, None], stays, table)
        many = np.empty((n_states, n_actions**n, n_states))
        for number in range(n_actions**n):
            product = np.eye(n_states)
            for k in range(n):
                product = product @ single[:, number // n_actions**k % n_actions]
            many[:, number] = product
        super().__init__(many, ends)


@pytest.mark.parametrize("ends", [(), (3,)])
def test_exact_forecasts_give_the_mean_return_of_going_step_by_step(ends: tuple[int, ...]) -> None:
    table, rewards, n = random_table(6, 2, 0), np.arange(6.0), 20_000
    world, goal = TableWorld(table, ends), arrival_goal(rewards)
    model = DirectForecastModel(world, lambda k: StringWorld(table, ends, k), (2, 3, 4))
    model.load_state_dict({"known": np.array([2, 3, 4])})
    starts, first, keys = np.zeros((n, 1), dtype=np.int64), np.ones(n, dtype=np.int64), derive(1, np.arange(n))
    stepwise = random_returns(world, goal, starts, keys, 5, 0.9, first)
    forecast = forecast_returns(model, goal, starts, derive(2, keys), 5, 0.9, first)
    error = np.sqrt((stepwise.var() + forecast.var()) / n)
    assert abs(stepwise.mean() - forecast.mean()) < 5 * error


def test_a_model_without_forecasts_is_refused() -> None:
    planner = FlatMonteCarlo(settings("direct"))
    planner.set_model(TableWorld(random_table(4, 2, 0)), np.array([[0]]))
    planner.set_goal(arrival_goal(np.arange(4.0)))
    with pytest.raises(ValueError, match="model='direct'"):
        planner.plan(np.array([[0]]))
    direct = {"forecasts": "direct"}
    with pytest.raises(ValueError, match="model='direct'"):
        ModelLearningAgent("FlatMonteCarloPolicy", "FrozenLake-v1", policy_kwargs=direct)
    with pytest.raises(ValueError, match="FlatMonteCarloPolicy"):
        ModelLearningAgent("MctsPolicy", "FrozenLake-v1", model="direct", policy_kwargs=direct)
