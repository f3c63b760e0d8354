"""Invariants of planes: which are found, which outcomes are removed, and that no sample violates them."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from mbagent.models.dbn import LocalGraphModel
from mbagent.models.dbn.features import action_encoding, make_layout
from mbagent.models.dbn.planes.invariants import (
    NO_INVARIANTS,
    Invariants,
    all_kept,
    enforced,
    find_invariants,
    radix,
    with_invariants,
)
from mbagent.models.protocol import Successors
from mbagent.spaces import FactoredSpace
from tests.models.helpers import dataset

SIZE = 4
KINDS, COLOURS = 3, 4
SPACE = FactoredSpace(spaces.MultiDiscrete(np.broadcast_to([[[KINDS]], [[COLOURS]]], (2, SIZE, SIZE)).copy()))


def crowd(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A red ball (1, 1) and a blue box (2, 3) that move to random free neighbouring cells; action 1 may end the episode."""
    rng, rows = np.random.default_rng(seed), []
    places = [(0, 0), (2, 2)]

    def show() -> np.ndarray:
        board = np.zeros((2, SIZE, SIZE), dtype=np.int64)
        for place, kind, colour in zip(places, (1, 2), (1, 3), strict=True):
            board[:, place[0], place[1]] = kind, colour
        return board.ravel()

    for _ in range(n):
        before, action = show(), int(rng.integers(2))
        for i in range(2):
            y, x = places[i]
            near = [(y + a, x + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
            free = [p for p in near if min(p) >= 0 and max(p) < SIZE and p not in places]
            places[i] = free[int(rng.integers(len(free)))]
        over = action == 1 and rng.random() < 0.05
        after = show()
        if over:
            after[:] = 0  # the last state violates all invariants
        rows.append((before, action, after, over))
        if over:
            places = [(0, 0), (2, 2)]
    before, actions, after, ends = (np.array(part) for part in zip(*rows, strict=True))
    return before, actions, after, ends


def fitted() -> tuple[LocalGraphModel, np.ndarray]:
    before, actions, after, ends = crowd(3000, 0)
    model = LocalGraphModel(SPACE, 2)
    model.fit(dataset(SPACE.cardinalities, 2, before, actions, after, ends))
    return model, before


def test_counts_and_combinations_are_found() -> None:
    before, actions, after, ends = crowd(2000, 1)
    assert SPACE.planes is not None
    rows = dataset(SPACE.cardinalities, 2, before, actions, after, ends).rows()
    invariants = find_invariants(rows, SPACE.planes, (KINDS, COLOURS))
    assert {(int(c), int(v)) for c, v in invariants.counts} == {(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 3)}
    assert set(np.flatnonzero(invariants.observed)) == {0, 1 + KINDS, 2 + 3 * KINDS}
    few = find_invariants(rows.select(slice(50)), SPACE.planes, (KINDS, COLOURS))
    assert len(few.counts) == 0


def test_combinations_are_no_invariant_while_new_ones_are_observed() -> None:
    rng, n = np.random.default_rng(0), 300
    before = rng.integers(20, size=(n, 2 * SIZE * SIZE))
    space = FactoredSpace(spaces.MultiDiscrete(np.full((2, SIZE, SIZE), 20)))
    assert space.planes is not None
    rows = dataset(space.cardinalities, 1, before, np.zeros(n, dtype=np.int64), np.roll(before, 1, axis=0)).rows()
    assert find_invariants(rows, space.planes, (20, 20)).none


def test_outcomes_that_violate_an_invariant_are_removed_and_others_renormalised() -> None:
    cells, weights = np.arange(2).reshape(1, 1, 2), radix((3,))
    layout = replace(make_layout((3, 3), (), action_encoding((1,))), cells=cells, weights=weights)
    invariants = NO_INVARIANTS._replace(counts=np.array([[0, 1]]))
    states = np.array([[1, 0], [0, 0]])
    following = np.array([[1, 0], [0, 1], [1, 1], [0, 0], [0, 0], [1, 0]])
    over = np.array([False, False, False, True, False, False])
    found = Successors(np.array([0, 4, 6]), following, over, np.array([0.1, 0.3, 0.4, 0.2, 0.5, 0.5]))
    kept = enforced(with_invariants(layout, invariants), states, found)
    np.testing.assert_array_equal(kept.offsets, [0, 3, 4])
    np.testing.assert_array_equal(kept.states, [[1, 0], [0, 1], [0, 0], [0, 0]])
    np.testing.assert_allclose(kept.probabilities, [0.2, 0.6, 0.2, 1.0])
    impossible = invariants._replace(observed=np.array([False, False, True]))
    assert (
        len(enforced(with_invariants(layout, impossible), states, found).states) == 6
    )  # no outcome satisfies it: none is removed


def test_samples_satisfy_the_invariants_and_probabilities_take_them_into_account() -> None:
    model, states = fitted()
    layout, rng = model.fitted.layout, np.random.default_rng(0)
    assert len(layout.counts) > 0
    some, actions = states[:400], rng.integers(2, size=400)
    drawn, over = model.sample(some, actions, rng)
    assert all_kept(layout, some, drawn)[~over].all()
    found = model.successors(some[:50], actions[:50], 256, 0)
    rows, on = found.rows, ~found.terminated
    assert all_kept(layout, some[rows], found.states)[on].all()
    np.testing.assert_allclose(np.bincount(rows, weights=found.probabilities), 1.0)
    determined = np.exp(model.log_prob(some[rows], actions[rows], found.states, found.terminated))
    totals = np.bincount(rows, weights=determined)
    assert totals.max() < 1.05
    assert totals.min() > 0.6  # 256 draws do not cover all possible outcomes
    broken = some[:1].copy()
    broken[0, 0] = 1 - broken[0, 0]
    assert model.log_prob(some[:1], actions[:1], broken, np.array([False]))[0] == -np.inf


def test_samples_do_not_depend_on_other_rows() -> None:
    model, states = fitted()
    keys = np.arange(60, dtype=np.uint64)
    together = model.sample(states[:60], np.zeros(60, dtype=np.int64), keys)
    for b in (0, 17, 59):
        alone = model.sample(states[b : b + 1], np.zeros(1, dtype=np.int64), keys[b : b + 1])
        np.testing.assert_array_equal(alone[0][0], together[0][b])


def test_invariants_are_saved_and_damaged_ones_refused() -> None:
    model, states = fitted()
    other = LocalGraphModel(SPACE, 2)
    weights = model.state_dict()
    other.load_state_dict(weights)
    np.testing.assert_array_equal(other.fitted.layout.counts, model.fitted.layout.counts)
    actions = np.zeros(100, dtype=np.int64)
    for expected, found in zip(
        model.sample(states[:100], actions, np.random.default_rng(1)),
        other.sample(states[:100], actions, np.random.default_rng(1)),
        strict=True,
    ):
        np.testing.assert_array_equal(expected, found)
    for name, array in (("counts", np.array([[0, 9]])), ("met", np.ones(5, dtype=np.bool_))):
        with pytest.raises(ValueError, match="planes do not have"):
            other.load_state_dict({**weights, name: array})
    larger = FactoredSpace(spaces.MultiDiscrete(np.broadcast_to([[[KINDS]], [[COLOURS]]], (2, 6, 6)).copy()))
    carried = model.for_space(larger)
    np.testing.assert_array_equal(carried.fitted.layout.counts, model.fitted.layout.counts)


def test_none_indicates_missing_invariants() -> None:
    assert NO_INVARIANTS.none
    assert not Invariants(np.array([[0, 1]]), NO_INVARIANTS.observed).none
