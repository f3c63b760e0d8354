"""The rules of the board games, checked by hand."""

import numpy as np

from mbagent_envs.random_keys import derive
from worlds.board_games import BoardWorld, PushedBox, Switch, TwoPlayers

UP, RIGHT, DOWN, LEFT = range(4)


def board(world: BoardWorld, *things: tuple[int, int, int]) -> np.ndarray:
    """A state with bits on at (plane, row, column)."""
    obs = world.blank(1)
    for plane, row, column in things:
        world.planes(obs)[0, plane, row * world.size + column] = 1
    return obs


def after(world: BoardWorld, obs: np.ndarray, action: int, plane: int) -> set[tuple[int, int]]:
    """Cells of a plane that are on after a step."""
    following = world.transition(obs, np.array([action]), derive(1, np.arange(1)))
    return {(int(c) // world.size, int(c) % world.size) for c in np.flatnonzero(world.planes(following)[0, plane])}


def test_two_players_move_together_and_walls_stop_each() -> None:
    world = TwoPlayers()
    obs = board(world, (0, 2, 2), (0, 4, 0), (1, 2, 3), (2, 5, 5))
    assert after(world, obs, RIGHT, 0) == {(2, 2), (4, 1)}
    assert after(world, obs, LEFT, 0) == {(2, 1), (4, 0)}
    assert after(world, obs, RIGHT, 1) == {(2, 3)}
    assert world.over(board(world, (0, 1, 1), (0, 3, 3), (2, 3, 3)))[0]
    assert not world.over(obs)[0]


def test_a_box_is_pushed_where_there_is_room_behind_it() -> None:
    world = PushedBox()
    obs = board(world, (0, 2, 1), (2, 2, 2))
    assert (after(world, obs, RIGHT, 0), after(world, obs, RIGHT, 2)) == ({(2, 2)}, {(2, 3)})
    assert (after(world, obs, UP, 0), after(world, obs, UP, 2)) == ({(1, 1)}, {(2, 2)})
    for blocked in (board(world, (0, 2, 1), (2, 2, 2), (1, 2, 3)), board(world, (0, 2, 4), (2, 2, 5))):
        player = {(int(c) // 6, int(c) % 6) for c in np.flatnonzero(world.planes(blocked)[0, 0])}
        assert after(world, blocked, RIGHT, 0) == player
    assert world.over(board(world, (0, 2, 2), (2, 0, 5)))[0]
    starts = world.initial(derive(3, np.arange(500)))
    assert (world.planes(starts)[:, [0, 2]].sum(axis=2) == 1).all()
    assert not (world.planes(starts)[:, 0] & world.planes(starts)[:, 2]).any()


def test_walls_block_only_while_the_switch_is_off() -> None:
    world = Switch()
    obs = board(world, (0, 2, 2), (1, 2, 3), (2, 0, 0))
    assert after(world, obs, RIGHT, 0) == {(2, 2)}
    obs[:, -1] = 1
    assert after(world, obs, RIGHT, 0) == {(2, 3)}
    many = np.repeat(obs, 4000, axis=0)
    flipped = world.transition(many, np.full(4000, UP), derive(2, np.arange(4000)))[:, -1] == 0
    assert abs(flipped.mean() - 0.1) < 5 * np.sqrt(0.09 / 4000)
