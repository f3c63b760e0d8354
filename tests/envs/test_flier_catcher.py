from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mbagent_envs import FlierCatcher
from mbagent_envs.random_keys import derive
from tests.envs.helpers import start_states, wandered_states


def board(*rows: str) -> npt.NDArray[np.int8]:
    """Read a picture: @ player, < flier, & both."""
    cells = np.array([list(row) for row in rows])
    return np.array([(cells == "@") | (cells == "&"), (cells == "<") | (cells == "&")]).astype(np.int8)


def step(obs: npt.NDArray[np.int8], action: str, spawn_rate: float = 0.0) -> npt.NDArray[np.int8]:
    game = FlierCatcher(height=obs.shape[1], width=obs.shape[2], spawn_rate=spawn_rate)
    after = game.transition(obs[None], np.array([game.action_names.index(action)]), derive(0, 0))
    return after.reshape(obs.shape)


def test_starts_anywhere_in_the_first_column_without_fliers() -> None:
    obs = start_states(FlierCatcher(), 6000)
    assert np.abs(obs[:, 0, :, 0].mean(axis=0) - 1 / 6).max() < 0.025
    assert not obs[:, 1].any()


def test_player_and_fliers_move() -> None:
    before = board("@.<.", "<..<", "..<.")
    np.testing.assert_array_equal(step(before, "stay"), board("@<..", "..<.", ".<.."))
    np.testing.assert_array_equal(step(before, "down"), board(".<..", "@.<.", ".<.."))
    np.testing.assert_array_equal(step(before, "up"), board("@<..", "..<.", ".<.."))
    bottom = board("....", "....", "@...")
    np.testing.assert_array_equal(step(bottom, "down"), bottom)
    assert FlierCatcher().action_names == ("up", "stay", "down")
    assert FlierCatcher(stay=False).action_names == ("up", "down")


def test_new_fliers_appear_at_the_given_rate_in_any_row() -> None:
    game, n = FlierCatcher(spawn_rate=0.3), 20_000
    after = game.transition(start_states(game, n), np.ones(n, dtype=np.int64), derive(1, np.arange(n)))
    assert not after[:, 1, :, :-1].any()
    per_row = after[:, 1, :, -1].mean(axis=0)
    assert np.abs(per_row - 0.05).max() < 5 * np.sqrt(0.05 / n)
    assert after[:, 1].sum(axis=(1, 2)).max() == 1


def test_reward_is_1_for_a_flier_at_the_players_next_cell() -> None:
    game = FlierCatcher(height=3, width=4)
    before = board("@...", ".<..", "....")
    for action, reward in (("down", 1), ("stay", 0), ("up", 0)):
        number = np.array([game.action_names.index(action)])
        assert game.reward(before[None], number, step(before, action)[None]) == reward


def test_other_goals_are_as_documented() -> None:
    game = FlierCatcher(height=3, width=4)
    boards = np.array(
        [
            board("&...", "....", "...."),
            board("@<..", "<...", "...."),
            board("....", "&...", "...."),
            board("....", ".<..", "&<.."),
        ]
    )
    none = np.zeros(4, dtype=np.int64)
    goals = {name: goal(boards, none, boards).tolist() for name, goal in game.reward_functions.items()}
    assert goals["default"] == [1, 0, 1, 1]
    assert goals["avoid"] == [-1, 0, -1, -1]
    assert goals["top row"] == [1, 1, 0, 0]
    assert goals["catch low"] == [-1, 0, 1, 1]  # of three rows the upper one is the upper half
    assert goals["follow"] == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"height": 1}, ValueError, "height must be at least 2, but it is 1"),
        ({"width": 1}, ValueError, "width must be at least 2, but it is 1"),
        ({"height": 6.5}, TypeError, "height must be an integer"),
        ({"width": True}, TypeError, "width must be an integer"),
        ({"spawn_rate": 1.01}, ValueError, r"spawn_rate must be in \[0, 1\], but it is 1.01"),
        ({"spawn_rate": -1}, ValueError, "spawn_rate must be in"),
        ({"spawn_rate": None}, TypeError, "spawn_rate must be a number"),
        ({"stay": "yes"}, TypeError, "stay must be True or False"),
    ],
)
def test_invalid_arguments_are_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        FlierCatcher(**arguments)


def test_invalid_boards_are_refused() -> None:
    game = FlierCatcher(height=3, width=4)
    game.check_observations(wandered_states(game, 100))
    for wrong in (board(".@..", "....", "...."), board("@...", "@...", "....")):
        with pytest.raises(ValueError, match="plane 0 must hold exactly one 1, in its first column"):
            game.check_observations(wrong[None])
    with pytest.raises(ValueError, match="at most one 1 in each column"):
        game.check_observations(board("@..<", "...<", "....")[None])
