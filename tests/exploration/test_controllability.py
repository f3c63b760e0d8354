"""Which factors, and which of their values, actions have a say in."""

import numpy as np

from mbagent.exploration.controllability import MOST_COUNTED_STEPS, StateAbstraction, find_controllable, find_reached
from mbagent.types import Ints

ALONE, DOOR, GUARD, LAMP = 0, 1, 2, 3


def ring(n_steps: int, seed: int = 0) -> tuple[Ints, Ints, Ints]:
    """A place on a ring of six that actions move along, a door that only place 3 opens, a guard who walks by himself, a lamp."""
    rng = np.random.default_rng(seed)
    actions, states = rng.integers(3, size=n_steps), np.zeros((n_steps + 1, 4), dtype=np.int64)
    for t, action in enumerate(actions):
        place, _, guard, lamp = states[t]
        door = int(rng.random() < (0.9 if place == 3 else 0.1))
        states[t + 1] = (place + action - 1) % 6, door, (guard + rng.integers(2)) % 4, lamp ^ int(rng.random() < 0.3)
    return states[:-1], actions, states[1:]


def test_a_place_hangs_on_actions_and_what_hangs_on_the_place_is_reached() -> None:
    for n_steps in (600, 3000, 2 * MOST_COUNTED_STEPS):
        before, actions, after = ring(n_steps)
        found = find_controllable(before, actions, after, 3)
        np.testing.assert_array_equal(np.flatnonzero(found.directly), [ALONE])
        np.testing.assert_array_equal(np.flatnonzero(find_reached(found, before, actions, after)), [ALONE, DOOR])
        assert set(found.classes[GUARD].values()) == {0}
        assert sorted(found.classes[ALONE].values()) == list(range(6))


def test_what_seldom_changes_is_kept_apart_until_it_can_be_told() -> None:
    before, actions, after = ring(600)
    before[:, LAMP], after[:, LAMP] = np.arange(600) // 100 % 2, np.arange(1, 601) // 100 % 2
    found = find_controllable(before, actions, after, 3)
    assert set(found.classes[LAMP].values()) == {0, 1}
    view = StateAbstraction(found, np.zeros(4, dtype=np.bool_))
    np.testing.assert_array_equal(view.factors, [ALONE, LAMP])
    np.testing.assert_array_equal(view(before), before[:, [ALONE, LAMP]])


def test_values_that_change_into_each_other_whatever_is_done_are_taken_for_one() -> None:
    rng, n = np.random.default_rng(0), 4000  # five cells with a player (9), whom actions move, and snow (5) that falls and melts
    snow, at = rng.random((n + 1, 5)) < 0.5, np.zeros(n + 1, dtype=np.int64)
    actions = rng.integers(2, size=n)
    for t in range(n):
        at[t + 1] = np.clip(at[t] + 2 * actions[t] - 1, 0, 4)
    cells = np.where(np.arange(5) == at[:, None], 9, 5 * snow)
    found = find_controllable(cells[:-1], actions, cells[1:], 2)
    assert found.directly.all()
    view = StateAbstraction(found, np.zeros(5, dtype=np.bool_))
    assert len(np.unique(view(cells), axis=0)) == 5  # where the player is, and no more
    assert view(np.full((1, 5), 12)).tolist() == [[10] * 5]  # a value never met is none of the known ones
    assert view.same_as(StateAbstraction(found, np.zeros(5, dtype=np.bool_)))
    assert not view.same_as(StateAbstraction(found, np.ones(5, dtype=np.bool_)))
    assert not view.same_as(None)


def test_where_actions_do_nothing_nothing_is_steered() -> None:
    bits = np.random.default_rng(0).integers(2, size=(3000, 30))
    actions = np.random.default_rng(1).integers(4, size=2999)
    found = find_controllable(bits[:-1], actions, bits[1:], 4)
    assert not found.directly.any()
    assert not find_reached(found, bits[:-1], actions, bits[1:]).any()


def test_very_many_actions_or_values_are_no_harm() -> None:
    before, actions, after = ring(3000)
    found = find_controllable(before, actions * 1000, after, 4096)
    assert found.directly[ALONE]
    large = np.column_stack([before, before[:, LAMP] * 10**9])
    found = find_controllable(large, actions, np.column_stack([after, after[:, LAMP] * 10**9]), 3)
    assert not found.directly[4]
    np.testing.assert_array_equal(StateAbstraction(found, np.zeros(5, dtype=np.bool_)).factors, [ALONE, 4])
