"""Flat Monte Carlo, step by step and with forecasts of several steps."""

from typing import Any

import numpy as np
import pytest

from mbagent import ModelLearningAgent
from mbagent.models.neural.forecasts import DirectForecastModel
from mbagent.planning.flat_monte_carlo import FlatMonteCarlo, forecast_returns, random_returns
from mbagent.planning.planner import PlannerSettings
from mbagent_envs.random_keys import derive, uniforms
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
def test_exact_forecasts_have_the_mean_return_of_simulations_step_by_step(ends: tuple[int, ...]) -> None:
    table, rewards, n = random_table(6, 2, 0), np.arange(6.0), 20_000
    world, goal = TableWorld(table, ends), arrival_goal(rewards)
    model = DirectForecastModel(world, lambda k: StringWorld(table, ends, k), (2, 3, 4))
    model.load_state_dict({"known": np.array([2, 3, 4])})
    starts, first, keys = np.zeros((n, 1), dtype=np.int64), np.ones(n, dtype=np.int64), derive(1, np.arange(n))
    stepwise = random_returns(world, goal, starts, keys, 5, 0.9, first)
    forecast = forecast_returns(model, goal, starts, derive(2, keys), 5, 0.9, first)
    error = np.sqrt((stepwise.var() + forecast.var()) / n)
    assert abs(stepwise.mean() - forecast.mean()) < 5 * error


class CoinWorld(TableWorld):
    """Coins that are tossed at every step, also as a model of n steps. Coin i uses random number i of the key."""

    def __init__(self, n_actions: int = 2) -> None:
        super().__init__(np.ones((2, n_actions, 2)))
        self.cardinalities = (2, 2, 2)

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: Any) -> tuple[np.ndarray, np.ndarray]:
        return (uniforms(rng, 3) < 0.5).astype(np.int64), np.zeros(len(states), dtype=np.bool_)

    def state_dict(self) -> dict[str, np.ndarray]:
        return {}

    def load_state_dict(self, state: Any) -> None:
        pass


@pytest.mark.parametrize("coin", [0, 1, 2])
def test_no_random_number_decides_both_an_action_and_an_outcome(coin: int) -> None:
    n = 20_000
    model = DirectForecastModel(CoinWorld(), lambda k: CoinWorld(2**k), (2,))
    model.load_state_dict({"known": np.array([2])})

    def goal(states: np.ndarray, actions: np.ndarray, following: np.ndarray) -> np.ndarray:
        hit: np.ndarray = ((actions == 0) & (following[:, coin] == 0)).astype(np.float64)
        return hit

    starts, first = np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=np.int64)
    returns = forecast_returns(model, goal, starts, derive(1, np.arange(n)), 3, 1.0, first)
    assert abs(returns.mean() - (0.5 + 0.25 + 0.25)) < 5 * returns.std() / np.sqrt(n)


def test_the_steps_after_a_forecast_have_random_numbers_of_their_own() -> None:
    n = 4000
    model = DirectForecastModel(CoinWorld(), lambda k: CoinWorld(2**k), (2,))
    model.load_state_dict({"known": np.array([2])})
    starts, keys = np.zeros((n, 3), dtype=np.int64), derive(3, np.arange(n))
    ends = [model.forecast(starts, np.zeros((n, steps), dtype=np.int64), keys)[0][:, 0] for steps in range(2, 8)]
    agreement = [(ends[0] == later).mean() for later in ends[1:]]
    assert max(abs(share - 0.5) for share in agreement) < 5 * 0.5 / np.sqrt(n)


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
