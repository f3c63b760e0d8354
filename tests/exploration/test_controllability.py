"""Tests of controllable factors and of the classes of their values."""

import numpy as np

from mbagent.exploration.controllability import MOST_COUNTED_STEPS, StateAbstraction, find_controllable, find_reached
from mbagent.types import Ints

ALONE, DOOR, GUARD, LAMP = 0, 1, 2, 3


def ring(n_steps: int, seed: int = 0) -> tuple[Ints, Ints, Ints]:
    """A position on a ring of six that actions change, a door that only position 3 opens, an uncontrolled guard, and a lamp."""
    rng = np.random.default_rng(seed)
    actions, states = rng.integers(3, size=n_steps), np.zeros((n_steps + 1, 4), dtype=np.int64)
    for t, action in enumerate(actions):
        place, _, guard, lamp = states[t]
        door = int(rng.random() < (0.9 if place == 3 else 0.1))
        states[t + 1] = (place + action - 1) % 6, door, (guard + rng.integers(2)) % 4, lamp ^ int(rng.random() < 0.3)
    return states[:-1], actions, states[1:]


def test_a_factor_that_depends_on_actions_and_one_that_depends_on_it_are_found() -> None:
    for n_steps in (600, 3000, 2 * MOST_COUNTED_STEPS):
        before, actions, after = ring(n_steps)
        found = find_controllable(before, actions, after, 3)
        np.testing.assert_array_equal(np.flatnonzero(found.directly), [ALONE])
        np.testing.assert_array_equal(np.flatnonzero(find_reached(found, before, actions, after)), [ALONE, DOOR])
        assert set(found.classes[GUARD].values()) == {0}
        assert sorted(found.classes[ALONE].values()) == list(range(6))


def test_values_that_rarely_change_are_kept_apart() -> None:
    before, actions, after = ring(600)
    before[:, LAMP], after[:, LAMP] = np.arange(600) // 100 % 2, np.arange(1, 601) // 100 % 2
    found = find_controllable(before, actions, after, 3)
    assert set(found.classes[LAMP].values()) == {0, 1}
    view = StateAbstraction(found, np.zeros(4, dtype=np.bool_))
    np.testing.assert_array_equal(view.factors, [ALONE, LAMP])
    np.testing.assert_array_equal(view(before), before[:, [ALONE, LAMP]])


def test_values_that_change_into_each_other_independently_of_actions_form_a_class() -> None:
    rng, n = np.random.default_rng(0), 4000  # five cells with a player (9), moved by actions, and random snow (5)
    snow, at = rng.random((n + 1, 5)) < 0.5, np.zeros(n + 1, dtype=np.int64)
    actions = rng.integers(2, size=n)
    for t in range(n):
        at[t + 1] = np.clip(at[t] + 2 * actions[t] - 1, 0, 4)
    cells = np.where(np.arange(5) == at[:, None], 9, 5 * snow)
    found = find_controllable(cells[:-1], actions, cells[1:], 2)
    assert found.directly.all()
    view = StateAbstraction(found, np.zeros(5, dtype=np.bool_))
    assert len(np.unique(view(cells), axis=0)) == 5  # the position of the player only
    assert view(np.full((1, 5), 12)).tolist() == [[10] * 5]  # an unobserved value is in a class of its own
    assert view.same_as(StateAbstraction(found, np.zeros(5, dtype=np.bool_)))
    assert not view.same_as(StateAbstraction(found, np.ones(5, dtype=np.bool_)))
    assert not view.same_as(None)


def test_without_effects_of_actions_no_factor_is_controllable() -> None:
    bits = np.random.default_rng(0).integers(2, size=(3000, 30))
    actions = np.random.default_rng(1).integers(4, size=2999)
    found = find_controllable(bits[:-1], actions, bits[1:], 4)
    assert not found.directly.any()
    assert not find_reached(found, bits[:-1], actions, bits[1:]).any()


def test_many_actions_or_large_values_are_supported() -> None:
    before, actions, after = ring(3000)
    found = find_controllable(before, actions * 1000, after, 4096)
    assert found.directly[ALONE]
    large = np.column_stack([before, before[:, LAMP] * 10**9])
    found = find_controllable(large, actions, np.column_stack([after, after[:, LAMP] * 10**9]), 3)
    assert not found.directly[4]
    np.testing.assert_array_equal(StateAbstraction(found, np.zeros(5, dtype=np.bool_)).factors, [ALONE, 4])
