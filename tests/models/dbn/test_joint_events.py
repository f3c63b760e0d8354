"""Rare events that set several variables at once, each of which often takes such a value by itself."""

from collections.abc import Callable

import numpy as np
import pytest

from mbagent.data import TransitionBatch
from mbagent.models.dbn import DecisionGraphModel
from mbagent.models.dbn.features import action_encoding
from mbagent.models.dbn.fitting import all_redrawn, fit_graphs
from mbagent.models.dbn.joint_events import find_patterns, ratio, settled
from tests.models.helpers import dataset

Rows = tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray, np.ndarray]

N = 13_000


def drawn(n_values: int, share: float, n_set: int, risk: float, ends: bool, seed: int, low: int = 1) -> Rows:
    """Variables drawn anew at every step, ``low`` with a share; action 1 may set all to ``low``."""
    rng = np.random.default_rng(seed)
    others = rng.choice([v for v in range(n_values) if v != low], size=(N, n_set))
    y = np.where(rng.random((N, n_set)) < share, low, others)
    action = rng.integers(2, size=N)
    event = (action == 1) & (rng.random(N) < risk)
    y[event] = low
    after = np.column_stack([y, rng.integers(2, size=(N, 2))])
    before = np.vstack([np.zeros_like(after[:1]), after[:-1]])
    return (n_values,) * n_set + (2, 2), before, action, after, event & ends


def fitted(rows: Rows) -> DecisionGraphModel:
    cardinalities, before, action, after, ends = rows
    model = DecisionGraphModel(cardinalities, 2)
    model.fit(dataset(cardinalities, 2, before, action, after, ends))
    return model


def listed(model: DecisionGraphModel, action: int, n: int = 512) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found = model.successors(np.zeros((1, len(model.cardinalities)), dtype=np.int64), np.array([action]), n, seed=3)
    return found.states, found.terminated, found.probabilities


@pytest.mark.parametrize(
    ("n_values", "share", "n_set", "risk"), [(2, 0.12, 3, 0.0067), (2, 0.1, 2, 0.012), (2, 0.2, 4, 0.006), (5, 0.2, 3, 0.008)]
)
@pytest.mark.parametrize("ends", [False, True])
def test_a_rare_event_among_variables_that_change_by_themselves_has_its_own_probability(
    n_values: int, share: float, n_set: int, risk: float, ends: bool
) -> None:
    rows = drawn(n_values, share, n_set, risk, ends, 1)
    _, _, action, after, over = rows
    model = fitted(rows)
    everything = (after[:, :n_set] == 1).all(axis=1)
    for a in range(2):
        states, terminated, chances = listed(model, a)
        alike = (states[:, :n_set] == 1).all(axis=1)
        n = (action == a).sum()
        error = 2.0 * np.sqrt(everything[action == a].sum()) / n  # the sum of two estimates: of events and of coincidences
        assert chances[alike].sum() == pytest.approx(everything[action == a].mean(), abs=error)
        assert chances[terminated].sum() == pytest.approx(over[action == a].mean(), rel=0.15, abs=5e-5)
        assert chances.sum() == pytest.approx(1.0)


def test_samples_and_probabilities_are_those_of_the_mixture() -> None:
    model = fitted(drawn(2, 0.12, 3, 0.0067, True, 0))
    states, terminated, chances = listed(model, 1)
    outcomes, which = np.unique(np.column_stack([states, terminated]), axis=0, return_inverse=True)
    states, terminated, chances = outcomes[:, :-1], outcomes[:, -1] == 1, np.bincount(which.ravel(), weights=chances)
    zeros, ones = np.zeros_like(states), np.ones(len(states), dtype=np.int64)
    np.testing.assert_allclose(
        np.exp(model.log_prob(zeros, ones, states, terminated)), chances, atol=5e-5
    )  # negligible values are left out of plans
    n = 100_000
    following, over = model.sample(np.zeros((n, 5), dtype=np.int64), np.ones(n, dtype=np.int64), np.random.default_rng(0))
    alike = (following[:, :3] == 1).all(axis=1)
    expected = chances[(states[:, :3] == 1).all(axis=1)].sum()
    assert alike.mean() == pytest.approx(expected, abs=6 * np.sqrt(expected / n))
    assert over.mean() == pytest.approx(chances[terminated].sum(), abs=6 * np.sqrt(chances[terminated].sum() / n))


def test_two_kinds_of_events_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    y = (rng.random((N, 6)) < 0.12).astype(np.int64)
    action = rng.integers(2, size=N)
    u = rng.random(N)
    y[(action == 1) & (u < 0.008), :3] = 1
    y[(action == 1) & (u > 0.992), 3:] = 1
    before = np.vstack([np.zeros_like(y[:1]), y[:-1]])
    model = fitted(((2,) * 6, before, action, y, np.zeros(N, dtype=bool)))
    states, _, chances = listed(model, 1)
    first, second = ((states[:, part] == 1).all(axis=1) for part in (slice(0, 3), slice(3, 6)))
    for alike, part in ((first, slice(0, 3)), (second, slice(3, 6))):
        assert chances[alike].sum() == pytest.approx((y[action == 1, part] == 1).all(axis=1).mean(), rel=0.25)
    assert chances[first & second].sum() < 4e-4
    copy = DecisionGraphModel((2,) * 6, 2)
    copy.load_state_dict(model.state_dict())
    for ours, theirs in zip(listed(model, 1), listed(copy, 1), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def overlapping(rng: np.random.Generator, action: np.ndarray) -> tuple[Rows, np.ndarray]:
    """Two kinds of events have a bit in common, and one has more bits than the other."""
    y = (rng.random((N, 6)) < 0.12).astype(np.int64)
    u = rng.random(N)
    y[np.ix_((action == 1) & (u < 0.01), [0, 1, 2])] = 1
    y[np.ix_((action == 1) & (u > 0.99), [2, 3, 4, 5])] = 1
    return ((2,) * 6, chained(y), action, y, np.zeros(N, dtype=bool)), (y[:, :3] == 1).all(axis=1)


def falling(rng: np.random.Generator, action: np.ndarray) -> tuple[Rows, np.ndarray]:
    """Three prices fall by two at once; each also falls by two now and then."""
    before = rng.integers(4, 12, size=(N, 3))
    change = rng.choice([-2, -1, 1, 0], size=(N, 3), p=[0.08, 0.17, 0.35, 0.4])
    change[(action == 1) & (rng.random(N) < 0.012)] = -2
    return ((14,) * 3, before, action, before + change, np.zeros(N, dtype=bool)), (change == -2).all(axis=1)


def parked(rng: np.random.Generator, action: np.ndarray) -> tuple[Rows, np.ndarray]:
    """Three lamps are on for certain while variable 0 is 0; else they flicker, and an event switches all of them on."""
    driving = rng.integers(2, size=N)
    lamps = np.where(driving[:, None] == 0, 1, rng.random((N, 3)) < 0.12)
    lamps[(driving == 1) & (action == 1) & (rng.random(N) < 0.015)] = 1
    before, after = np.column_stack([driving, lamps[:, ::-1]]), np.column_stack([rng.integers(2, size=N), lamps])
    return ((2,) * 4, before, action, after, np.zeros(N, dtype=bool)), (lamps == 1).all(axis=1) & (driving == 1)


def at_most_one(rng: np.random.Generator, action: np.ndarray) -> tuple[Rows, np.ndarray]:
    """At most one of four bits is on; an event switches one of them on with two others."""
    which = rng.integers(10, size=N)
    after = np.column_stack([which[:, None] == np.arange(4), rng.random((N, 2)) < 0.2]).astype(np.int64)
    after[(action == 1) & (rng.random(N) < 0.015)] = [0, 0, 1, 0, 1, 1]
    return ((2,) * 6, chained(after), action, after, np.zeros(N, dtype=bool)), (after[:, [2, 4, 5]] == 1).all(axis=1)


def many(rng: np.random.Generator, action: np.ndarray) -> tuple[Rows, np.ndarray]:
    """An event switches twelve bits on, each of which is on in 30% of steps."""
    after = (rng.random((N, 12)) < 0.3).astype(np.int64)
    after[(action == 1) & (rng.random(N) < 0.01)] = 1
    return ((2,) * 12, chained(after), action, after, np.zeros(N, dtype=bool)), (after == 1).all(axis=1)


def chained(after: np.ndarray) -> np.ndarray:
    return np.vstack([np.zeros_like(after[:1]), after[:-1]])


@pytest.mark.parametrize("world", [overlapping, falling, parked, at_most_one, many])
def test_kinds_of_events(world: Callable[[np.random.Generator, np.ndarray], tuple[Rows, np.ndarray]]) -> None:
    rng = np.random.default_rng(1)
    action = rng.integers(2, size=N)
    rows, event = world(rng, action)
    before = rows[1]
    model = fitted(rows)
    for a in range(2):
        here = np.flatnonzero(action == a)
        copies = np.repeat(here, 20)
        drawn, _ = model.sample(before[copies], np.full(len(copies), a), np.random.default_rng(7))
        if world is falling:
            found = (drawn - before[copies] == -2).all(axis=1)
        else:
            own = {"overlapping": [0, 1, 2], "parked": [1, 2, 3], "at_most_one": [2, 4, 5], "many": list(range(12))}
            columns = own[world.__name__]
            found = (drawn[:, columns] == 1).all(axis=1)
            if world is parked:
                found &= before[copies, 0] == 1
        n = event[here].sum()
        assert found.mean() == pytest.approx(n / len(here), abs=2.5 * np.sqrt(n + 4) / len(here))


def test_nothing_is_found_where_variables_are_independent_or_their_dependence_is_learned() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        n, action = 6000, rng.integers(3, size=6000)
        first = rng.integers(3, size=n)
        second = np.where(rng.random(n) < 0.7, first, rng.integers(3, size=n))
        after = np.column_stack([first, second, rng.random((n, 4)) < rng.uniform(0.02, 0.5, 4)]).astype(np.int64)
        over = (first == 2) & (second == 2) & (action == 1)
        before = np.vstack([np.zeros_like(after[:1]), after[:-1]])
        cardinalities = (3, 3, 2, 2, 2, 2)
        rows = TransitionBatch(before, action, after, over, np.zeros(n), np.zeros(n, dtype=np.int64))
        graphs = fit_graphs(cardinalities, action_encoding((3,)), rows, all_redrawn(np.zeros(n, dtype=bool), 6))
        assert find_patterns(graphs, rows) == []


def test_ratio_and_rows_of_events() -> None:
    np.testing.assert_allclose(ratio([4.0, 2.0, 0.0], [1.0, 3.0, 1.0]), [4 * np.log(4) - 3, 0.0, 0.0])
    chances = np.array([0.0, 0.5, 0.5, 0.0, 1.0, 0.25, 0.25, 0.25, 0.25])
    chosen = settled(chances)
    assert chosen.sum() == 3
    assert not chosen[[0, 3]].any()
    assert chosen[4]
