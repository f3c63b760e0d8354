from collections import Counter
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mbagent_envs import Maneuverer
from mbagent_envs.random_keys import derive
from tests.envs.helpers import start_states, wandered_states


def board(*rows: str) -> npt.NDArray[np.int8]:
    """Read a picture: @ player, # wall, * target, & both player and target."""
    cells = np.array([list(row) for row in rows])
    return np.array([(cells == "@") | (cells == "&"), cells == "#", (cells == "*") | (cells == "&")]).astype(np.int8)


def reached(walls: npt.NDArray[np.int8], start: tuple[int, int]) -> set[tuple[int, int]]:
    size = len(walls)
    found, waiting = {start}, [start]
    while waiting:
        row, column = waiting.pop()
        for cell in ((row - 1, column), (row, column + 1), (row + 1, column), (row, column - 1)):
            if cell not in found and min(cell) >= 0 and max(cell) < size and not walls[cell]:
                found.add(cell)
                waiting.append(cell)
    return found


def step(obs: npt.NDArray[np.int8], action: str, key: int = 0) -> npt.NDArray[np.int8]:
    game = Maneuverer(size=obs.shape[1])
    after = game.transition(obs[None], np.array([game.action_names.index(action)]), derive(key, 0))
    return after.reshape(obs.shape)


def test_actions_are_up_right_down_left_and_walls_and_edges_block() -> None:
    assert Maneuverer().action_names == ("up", "right", "down", "left")
    middle = board("#..", ".@.", "..*")
    np.testing.assert_array_equal(step(middle, "up"), board("#@.", "...", "..*"))
    np.testing.assert_array_equal(step(middle, "right"), board("#..", "..@", "..*"))
    np.testing.assert_array_equal(step(middle, "down"), board("#..", "...", ".@*"))
    np.testing.assert_array_equal(step(middle, "left"), board("#..", "@..", "..*"))
    corner = board("@#.", "*..", "...")
    np.testing.assert_array_equal(step(corner, "up"), corner)
    np.testing.assert_array_equal(step(corner, "right"), corner)
    np.testing.assert_array_equal(step(corner, "left"), corner)
    np.testing.assert_array_equal(step(corner, "down"), board(".#.", "&..", "..."))


def test_reward_is_standing_on_the_target_afterwards() -> None:
    game = Maneuverer(size=3)
    before, on = board("@*.", "...", "..."), board(".&.", "...", "...")
    action = np.array([1])
    assert game.reward(before[None], action, step(before, "right")[None]) == 1
    assert game.reward(before[None], action, step(before, "down")[None]) == 0
    for key in range(50):  # the new layout has the target elsewhere
        assert game.reward(on[None], action, step(on, "right", key)[None]) == 0


def test_a_step_from_the_target_draws_a_new_layout_for_any_action() -> None:
    on = board("....", "..&.", "....", "....")
    for action, key in product(("up", "right", "down", "left"), range(20)):
        after = step(on, action, key)
        np.testing.assert_array_equal(after[0], on[0])
        np.testing.assert_array_equal(after, step(on, "up", key))
    assert len({step(on, "up", key).tobytes() for key in range(200)}) > 150


@pytest.mark.parametrize("game", [Maneuverer(), Maneuverer(size=4, wall_density=0.7)], ids=repr)
def test_the_target_is_another_cell_that_can_be_reached(game: Maneuverer) -> None:
    for obs in (*start_states(game, 300), *wandered_states(game, 300, steps=30)):
        player, target = np.argwhere(obs[0]), np.argwhere(obs[2])
        assert len(player) == len(target) == 1
        assert tuple(target[0]) in reached(obs[1], tuple(player[0]))
    assert not any((obs[0] & obs[2]).any() for obs in start_states(game, 300))


@pytest.mark.parametrize("density", [0.0, 0.2, 0.6, 0.95])
@pytest.mark.parametrize("player", [(0, 0), (1, 1), (0, 1)])
def test_layouts_have_the_distribution_of_drawing_again(density: float, player: tuple[int, int]) -> None:
    """Enumerate 3 x 3 boards with a reachable cell, divide the weight of each among its targets, and compare."""
    size, n = 3, 60_000
    others = [cell for cell in product(range(size), repeat=2) if cell != player]
    exact: dict[bytes, float] = {}
    for bits in product((0, 1), repeat=len(others)):
        obs = np.zeros((3, size, size), dtype=np.int8)
        obs[0][player] = 1
        for cell, bit in zip(others, bits, strict=True):
            obs[1][cell] = bit
        targets = reached(obs[1], player) - {player}
        chance = density ** sum(bits) * (1 - density) ** (len(bits) - sum(bits))
        for target in targets:
            obs[2] = 0
            obs[2][target] = 1
            exact[obs.tobytes()] = chance / len(targets)
    total = sum(exact.values())
    on = np.zeros((3, size, size), dtype=np.int8)
    on[0][player] = on[2][player] = 1
    game = Maneuverer(size=size, wall_density=density)
    drawn = game.transition(np.repeat(on[None], n, axis=0), np.zeros(n, dtype=np.int64), derive(0, np.arange(n)))
    counts = Counter(row.tobytes() for row in drawn)
    assert counts.keys() <= exact.keys()
    expected = np.array([n * exact[layout] / total for layout in exact])
    got = np.array([counts[layout] for layout in exact])
    frequent = expected > 5
    chi_square = ((got - expected)[frequent] ** 2 / expected[frequent]).sum()
    assert chi_square < frequent.sum() + 5 * np.sqrt(2 * frequent.sum())
    assert abs(got[~frequent].sum() - expected[~frequent].sum()) < 5 * np.sqrt(expected[~frequent].sum() + 1)


def test_players_start_anywhere() -> None:
    places = start_states(Maneuverer(), 18_000)[:, 0].mean(axis=0)
    assert np.abs(places - 1 / 36).max() < 5 * np.sqrt(1 / 36 / 18_000)


def test_almost_full_boards_are_drawn_at_once() -> None:
    game = Maneuverer(size=8, wall_density=1 - 1e-12)
    obs = start_states(game, 1000)
    assert (obs[:, 1].sum(axis=(1, 2)) == 8 * 8 - 2).all()  # the player, and one adjacent cell
    game.check_observations(obs)


def test_other_goals_are_as_documented() -> None:
    game = Maneuverer(size=3)
    boards = np.array(
        [
            board("@..", "..#", "..*"),
            board("...", ".@#", "..*"),
            board("...", "..#", ".@*"),
            board("...", "..#", "..&"),
            board(".@.", "..#", "..*"),
        ]
    )
    none = np.zeros(5, dtype=np.int64)
    start = np.repeat(boards[:1], 5, axis=0)
    goals = {name: goal(start, none, boards).tolist() for name, goal in game.reward_functions.items()}
    assert goals["corner"] == [1, 0, 0, 0, 0]
    assert goals["next to target"] == [0, 0, 1, 0, 0]
    assert goals["keep moving"] == [0, 1, 1, 1, 1]
    assert goals["nook"] == [1, 0, 0, 1, 0]


def test_too_many_successors_raise_an_error() -> None:
    with pytest.raises(NotImplementedError, match="too many to list; sample them with transition"):
        Maneuverer(size=3).transition_distribution(board("&..", "...", "..."), 0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"size": 1}, ValueError, "size must be at least 2, but it is 1"),
        ({"size": 6.0}, TypeError, "size must be an integer"),
        ({"size": True}, TypeError, "size must be an integer"),
        ({"wall_density": 1}, ValueError, r"wall_density must be in \[0, 1\), but it is 1"),
        ({"wall_density": 1.5}, ValueError, r"wall_density must be in"),
        ({"wall_density": -0.1}, ValueError, r"wall_density must be in"),
        ({"wall_density": float("nan")}, ValueError, "wall_density must be in"),
        ({"wall_density": "0.2"}, TypeError, "wall_density must be a number"),
        ({"wall_density": False}, TypeError, "wall_density must be a number"),
    ],
)
def test_invalid_arguments_are_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Maneuverer(**arguments)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (("@@*", "...", "..."), r"plane 0 must hold exactly one 1 \(the player\)"),
        (("@..", "...", "..."), r"plane 2 must hold exactly one 1 \(the target\)"),
        (("@#*", "##.", "..."), "the player must be able to reach the target"),
    ],
)
def test_invalid_boards_are_refused(rows: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Maneuverer(size=3).check_observations(board(*rows)[None])


def test_nobody_stands_in_a_wall() -> None:
    for rows, name in ((("@*.", "...", "..."), "player"), (("*@.", "...", "..."), "target")):
        obs = board(*rows)
        obs[1, 0, 0] = 1
        with pytest.raises(ValueError, match=f"the {name} must not stand in a wall"):
            Maneuverer(size=3).check_observations(obs[None])
