import json
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from hypothesis import given, settings
from hypothesis import strategies as st

from mbagent.spaces import ActionEnumeration, FactoredSpace, space_from_json, space_to_json

BOOLEAN_BOX = spaces.Box(np.zeros(3, np.bool_), np.ones(3, np.bool_), dtype=np.bool_)  # type: ignore[arg-type]
ELEMENTARY = st.one_of(
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 9), st.integers(-5, 5)),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 5), min_size=1, max_size=4)),
    st.builds(lambda a, b: spaces.MultiDiscrete(np.array([[a, b], [b, a]])), st.integers(1, 5), st.integers(1, 5)),
    st.builds(spaces.MultiBinary, st.one_of(st.integers(1, 6), st.tuples(st.integers(1, 3), st.integers(1, 3)))),
    st.builds(lambda low, n: spaces.Box(low, low + n, (2, 2), dtype=np.int32), st.integers(-4, 4), st.integers(0, 5)),
    st.builds(lambda n, start: spaces.MultiDiscrete([n, n + 1], start=[start, 0]), st.integers(1, 5), st.integers(-5, 5)),
    st.just(BOOLEAN_BOX),
)
OPEN = st.one_of(
    st.just(spaces.Box(0, 255, (4, 4, 3), dtype=np.uint8)),
    st.builds(lambda k: spaces.Box(-(2**k), 2**k, (3,), dtype=np.int64), st.integers(6, 60)),
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(5000, 10**9), st.integers(-5, 5)),
    st.builds(lambda n: spaces.MultiDiscrete([n, 3]), st.integers(5000, 10**9)),
)
"""Spaces with open variables, of which only observed values are numbered."""
NESTED: st.SearchStrategy[spaces.Space[Any]] = st.recursive(
    ELEMENTARY,
    lambda inner: st.one_of(
        st.builds(spaces.Tuple, st.lists(inner, min_size=1, max_size=3)),
        st.builds(spaces.Dict, st.dictionaries(st.sampled_from("abc"), inner, min_size=1, max_size=3)),
    ),
    max_leaves=5,
)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one.dtype == other.dtype and np.array_equal(one, other)


@given(space=NESTED, seed=st.integers(0, 1000))
@settings(max_examples=60)
def test_encoding_and_decoding_are_exact_inverses(space: spaces.Space[Any], seed: int) -> None:
    factored = FactoredSpace(space)
    batched = batch_space(space, 4)
    batched.seed(seed)
    batch = batched.sample()
    factors = factored.encode(batch)
    assert factors.shape == (4, len(factored))
    assert (factors >= 0).all()
    assert (factors < factored.cardinalities).all()
    assert same(factored.decode(factors), batch)
    np.testing.assert_array_equal(factored.encode(factored.decode_wide(factors)), factors)
    assert len(factored.names) == len(set(factored.names)) == len(factored)


@given(inner=st.lists(st.one_of(OPEN, ELEMENTARY), min_size=1, max_size=3), alone=OPEN, seed=st.integers(0, 1000))
@settings(max_examples=60)
def test_observed_values_have_exact_inverses_and_others_the_nearest(
    inner: list[spaces.Space[Any]], alone: spaces.Space[Any], seed: int
) -> None:
    for space in (alone, spaces.Tuple(inner)):
        declared = FactoredSpace(space)
        batched = batch_space(space, 6)
        batched.seed(seed)
        batch, others = batched.sample(), batched.sample()
        numbers = declared.encode(batch)
        observed = declared.with_values(numbers)
        factors = observed.encode(batch)
        assert (factors >= 0).all()
        assert (factors < observed.cardinalities).all()
        assert same(observed.decode(factors), batch)
        np.testing.assert_array_equal(observed.widen(factors), numbers)
        new, known = declared.encode(others), observed.widen(observed.encode(others))
        for factor in declared.open:
            column = new[:, factor, None]
            values = np.unique(
                observed.widen(np.arange(max(observed.cardinalities))[:, None] % observed.cardinalities)[:, factor]
            )
            np.testing.assert_array_equal(np.abs(column - known[:, factor, None])[:, 0], np.abs(column - values).min(axis=1))
        again = declared.from_value_arrays(observed.value_arrays())
        assert again.same_factors(observed)
        assert again.cardinalities == observed.cardinalities


def test_cells_of_a_plane_share_their_values() -> None:
    space = FactoredSpace(spaces.Box(0, 255, (3, 3, 2), dtype=np.uint8))
    seen = np.zeros((2, 3, 3, 2), dtype=np.uint8)
    seen[0, 0, 0], seen[1, 2, 1] = (7, 9), (8, 0)
    assert space.with_values(space.encode(seen)).cardinalities == (3, 2) * 9  # 0, 7 and 8; 0 and 9


def test_numbers_beyond_the_supported_range_are_refused() -> None:
    space = FactoredSpace(spaces.Box(-(2**63), 2**63 - 1, (1,), dtype=np.int64))
    assert space.decode(space.encode(np.array([[2**61 - 1], [-(2**61)]])))[:, 0].tolist() == [2**61 - 1, -(2**61)]
    with pytest.raises(ValueError, match=r"to 2\^61 are supported"):
        space.encode(np.array([[2**62]]))


def test_too_many_observed_values_are_refused() -> None:
    space = FactoredSpace(spaces.Discrete(100_000))
    with pytest.raises(ValueError, match="took 5000 values"):
        space.with_values(np.arange(5000)[:, None])


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(4, start=2),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiDiscrete(np.array([[2, 3], [1, 2]]), start=np.array([[0, -1], [5, 0]])),
        spaces.MultiBinary((2, 2)),
    ],
    ids=str,
)
def test_every_joint_action_has_a_number(space: spaces.Space[Any]) -> None:
    actions = ActionEnumeration(space)
    numbers = np.arange(actions.n)
    batch = actions.decode(numbers)
    assert all(space.contains(action) for action in batch)
    np.testing.assert_array_equal(actions.encode(batch), numbers)


@pytest.mark.parametrize(
    ("space", "kind", "error", "message"),
    [
        (spaces.Box(0.0, 1.0, (2,)), "observation", TypeError, "DiscretizeObservation"),
        (spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Box(0.0, 1.0)}), "observation", TypeError, "'b'"),
        (spaces.Text(5), "observation", TypeError, "Text"),
        (spaces.Box(-1.0, 1.0, (1,)), "action", TypeError, "DiscretizeAction"),
    ],
)
def test_unsupported_spaces_are_refused_with_a_solution(
    space: spaces.Space[Any], kind: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        FactoredSpace(space, kind)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.MultiBinary(13), "8,192 joint actions"),
        (spaces.MultiBinary(2000), "about 10.602"),
        (spaces.Discrete(5000), "5,000 joint"),
    ],
    ids=str,
)
def test_too_many_joint_actions_are_refused(space: spaces.Space[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActionEnumeration(space)


@pytest.mark.parametrize("batch", [np.array([0, 5]), np.array([-1]), np.array([0.5]), np.zeros((2, 1)), np.array(1)])
def test_values_outside_the_space_are_refused(batch: Any) -> None:
    with pytest.raises(ValueError, match="observation"):
        FactoredSpace(spaces.Discrete(5)).encode(batch)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.MultiBinary((3, 6, 6)), (3, 6, 6, False)),
        (spaces.Box(0, 9, (7, 7, 3), dtype=np.uint8), (3, 7, 7, True)),
        (spaces.Box(0, 1, (4, 5), dtype=np.uint8), (1, 4, 5, False)),
        (spaces.MultiBinary(9), None),
        (spaces.MultiDiscrete(np.full((2, 2), 2)), None),
    ],
)
def test_planes_are_recognised(space: spaces.Space[Any], expected: tuple[int, int, int, bool] | None) -> None:
    planes = FactoredSpace(space).planes
    found = None if planes is None else (planes.channels, planes.height, planes.width, planes.channels_last)
    assert found == expected


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([3, 4], start=[1, 0]),
        spaces.MultiBinary(3),
        spaces.MultiBinary((3,)),
        spaces.MultiBinary((2, 3)),
        spaces.Box(0, 3, (2, 2), dtype=np.uint8),
        spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Tuple([spaces.MultiBinary(2), spaces.Discrete(3)])}),
    ],
)
def test_spaces_survive_json(space: spaces.Space[Any]) -> None:
    assert space_from_json(json.loads(json.dumps(space_to_json(space)))) == space
