from typing import Any

import numpy as np
import pytest

from mbagent_envs import GeyserRunner
from mbagent_envs.random_keys import derive
from tests.envs.helpers import start_states, wandered_states


def state(game: GeyserRunner, position: int, erupting: int) -> Any:
    obs = np.zeros(game.observation_space.shape, dtype=np.int8)
    obs[position] = obs[game.width + erupting] = 1
    return obs


def step(game: GeyserRunner, position: int, erupting: int, action: str, key: int = 0) -> tuple[int, int, float]:
    obs, number = state(game, position, erupting)[None], np.array([game.action_names.index(action)])
    after = game.transition(obs, number, derive(key, 0))
    reward = game.reward(obs, number, after)[0]
    return int(after[0, : game.width].argmax()), int(after[0, game.width :].argmax()), float(reward)


def test_starts_at_the_left_with_any_eruption() -> None:
    obs = start_states(GeyserRunner(), 5000)
    assert (obs[:, 0] == 1).all()
    assert np.abs(obs[:, 10:].mean(axis=0) - 0.2).max() < 0.03


def test_moves_and_stops_at_the_edges() -> None:
    game = GeyserRunner(mode="deterministic")
    assert game.action_names == ("left", "stay", "right")
    assert GeyserRunner(stay=False).action_names == ("left", "right")
    assert [step(game, 3, 0, name)[0] for name in game.action_names] == [2, 3, 4]
    assert step(game, 0, 0, "left")[0] == 0
    assert step(game, 9, 0, "right")[0] == 9
    assert step(GeyserRunner(stay=False), 3, 0, "right")[0] == 4


@pytest.mark.parametrize(
    ("width", "cycle"),
    [(10, [0, 2, 4, 1, 3]), (4, [0, 1]), (8, [0, 3, 2, 1]), (12, [0, 5, 4, 3, 2, 1]), (6, [0, 2, 1])],
)
def test_the_fixed_cycle_visits_every_geyser(width: int, cycle: list[int]) -> None:
    game = GeyserRunner(mode="deterministic", width=width)
    erupting, seen = 0, []
    for _ in cycle:
        seen.append(erupting)
        erupting = step(game, 0, erupting, "stay")[1]
    assert seen == cycle
    assert erupting == 0


def test_random_eruptions_are_uniform_and_independent_of_the_last() -> None:
    game = GeyserRunner()
    obs = np.repeat(state(game, 0, 3)[None], 5000, axis=0)
    after = game.transition(obs, np.ones(5000, dtype=np.int64), derive(0, np.arange(5000)))
    assert np.abs(after[:, 10:].mean(axis=0) - 0.2).max() < 0.03


def test_reward_is_the_position_less_the_cost_of_a_hit() -> None:
    game = GeyserRunner(mode="deterministic", hit_cost=5)
    assert step(game, 3, 0, "right") == (4, 2, 4 / 9)
    assert step(game, 6, 0, "right") == (7, 2, 7 / 9 - 5)  # geyser 2 stands at column 7
    assert step(game, 8, 0, "right") == (9, 2, 1.0)


def test_other_goals_are_as_documented() -> None:
    game = GeyserRunner()
    at = np.array([state(game, p, 2) for p in (0, 4, 5, 6, 7, 8, 9)])  # the eruption is at column 7
    none = np.zeros(len(at), dtype=np.int64)
    goals = {name: goal(at, none, at).tolist() for name, goal in game.reward_functions.items()}
    assert goals["left"] == [1, 0, 0, 0, 0, 0, 0]
    assert goals["middle"] == [0, 1, 1, 0, 0, 0, 0]
    assert goals["spray"] == [0, 0, 0, 1, 1, 1, 0]
    assert goals["right edge"] == [0, 0, 0, 0, 0, 0, 1]
    edges = np.array([state(game, p, k) for p, k in ((4, 0), (5, 0), (3, 0), (9, 4), (8, 4), (0, 4))])
    assert game.reward_functions["spray"](edges, none[:6], edges).tolist() == [1, 1, 0, 1, 1, 0]


def test_the_scene_shows_all_positions() -> None:
    game = GeyserRunner()
    kinds = [(s.kind, s.column) for s in game.scene(state(game, 2, 1)).sprites]
    assert ("player", 2) in kinds
    assert ("geyser", 6) in kinds
    assert ("player hit", 6) in [(s.kind, s.column) for s in game.scene(state(game, 6, 1)).sprites]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"mode": "random"}, ValueError, "mode must be 'stochastic' or 'deterministic', but it is 'random'"),
        ({"mode": None}, ValueError, "mode must be"),
        ({"width": 7}, ValueError, "width must be even.*7; take 8"),
        ({"width": 2}, ValueError, "width must be at least 4"),
        ({"width": -10}, ValueError, "width must be at least 4"),
        ({"width": 10.0}, TypeError, "width must be an integer"),
        ({"width": True}, TypeError, "width must be an integer"),
        ({"width": "10"}, TypeError, "width must be an integer"),
        ({"hit_cost": float("nan")}, ValueError, "hit_cost must be a finite number"),
        ({"hit_cost": float("inf")}, ValueError, "hit_cost must be a finite number"),
        ({"hit_cost": "2"}, TypeError, "hit_cost must be a number"),
        ({"hit_cost": False}, TypeError, "hit_cost must be a number"),
        ({"stay": 1}, TypeError, "stay must be True or False"),
    ],
)
def test_invalid_arguments_are_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GeyserRunner(**arguments)


def test_two_positions_or_two_eruptions_are_no_state() -> None:
    game = GeyserRunner()
    obs = wandered_states(game, 1)
    for bits, message in ((slice(0, 10), "the position"), (slice(10, 15), "the eruption")):
        wrong = obs.copy()
        wrong[:, bits] = 1
        with pytest.raises(ValueError, match=message):
            game.check_observations(wrong)
