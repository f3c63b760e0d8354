"""Structs in compiled code: every kind of attribute, nested structs, functions of the class, copies and errors."""

import copy
import pickle
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbagent_envs.jit import compiled
from mbagent_envs.structs import Struct, is_struct


class Scale(Struct):
    factor: float
    offsets: NDArray[Any]


@compiled
def twice(values: "Values", i: int) -> float:
    return float(2.0 * values.table[0, i])


class Values(Struct):
    table: NDArray[np.float64]
    words: NDArray[np.uint64]
    on: NDArray[np.bool_]
    n: int
    flag: bool
    key: np.uint64
    scale: Scale

    weighed = staticmethod(twice)


class Halves(Values):
    @staticmethod
    @compiled
    def weighed(values: "Values", i: int) -> float:
        return float(0.5 * values.table[0, i])


def made(kind: type[Values] = Values) -> Values:
    scale = Scale(1.5, np.arange(3, dtype=np.int32))
    return kind(
        np.arange(6.0).reshape(2, 3),
        np.array([2**63 + 1], np.uint64),
        np.array([True, False]),
        -7,
        True,
        np.uint64(2**64 - 1),
        scale,
    )


@compiled
def read(values: Values) -> tuple[float, int, int, bool, int, int, int, float, int]:
    shape = values.table.shape
    return (
        values.table[1, 2],
        shape[0],
        shape[1],
        values.on[0],
        values.n,
        int(values.flag),
        len(values.words),
        values.scale.factor,
        values.scale.offsets[2],
    )


@compiled
def last_bits(values: Values) -> tuple[int, int]:
    return int(values.words[0] & np.uint64(1)), int(values.key >> np.uint64(63))


@compiled
def fill(values: Values, number: float) -> None:
    for i in range(values.table.shape[1]):
        values.table[0, i] = number + values.scale.factor


@compiled
def weigh(values: Values, i: int) -> float:
    return values.weighed(values, i)


def test_attributes_are_read_as_they_were_given() -> None:
    assert read(made()) == (5.0, 2, 3, True, -7, 1, 1, 1.5, 2)
    assert last_bits(made()) == (1, 1)
    empty = replace(made(), on=np.array([True]), table=np.zeros((2, 3)))
    assert read(empty)[0] == 0.0


def test_contents_of_arrays_can_be_changed_and_attributes_cannot() -> None:
    values = made()
    fill(values, 2.0)
    np.testing.assert_array_equal(values.table, [[3.5, 3.5, 3.5], [3.0, 4.0, 5.0]])
    with pytest.raises(FrozenInstanceError):
        values.n = 3  # type: ignore[misc]
    assert replace(values, n=3).table is values.table


def test_a_function_of_the_class_is_chosen_by_the_class() -> None:
    assert weigh(made(), 2) == 4.0
    assert weigh(made(Halves), 2) == 1.0


def test_types_depend_on_class_and_types_of_attributes_only() -> None:
    assert made()._numba_type_ is made()._numba_type_
    assert made()._numba_type_ != made(Halves)._numba_type_
    assert made()._numba_type_ != replace(made(), words=np.zeros((1, 1), np.uint64))._numba_type_
    assert is_struct(made()._numba_type_, Values)
    assert not is_struct(made()._numba_type_, Halves)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda values: pickle.loads(pickle.dumps(values))])
def test_copies_have_arrays_of_their_own(copied: Any) -> None:
    values = made()
    other = copied(values)
    fill(values, 100.0)
    assert read(other) == read(made())
    assert other.table[0, 0] == 0.0


def test_arrays_that_are_not_contiguous_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Scale\.offsets has to be a contiguous array"):
        Scale(1.0, np.arange(6)[::2])


@pytest.mark.parametrize("value", [np.float32(1.5), None, "1.5", [1.5], 1j])
def test_values_that_no_struct_can_have_are_refused(value: Any) -> None:
    with pytest.raises(TypeError, match=r"Scale\.factor has to be an array, a float, an integer or a struct, not"):
        Scale(value, np.arange(6))
