"""Counter-based random numbers: every row of a batch has its own key, independent of the other rows.

A key is a 64-bit unsigned integer. Its random numbers are a pure function of (key, index): they depend neither on the
other rows of a batch nor on earlier draws, so a simulation gives the same outcome alone, in a batch, on another
thread, or repeated later. The mixing function is the finaliser of splitmix64 (Steele, Lea and Flood 2014, "Fast
splittable pseudorandom number generators"), applied to a counter.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from mbagent_envs.jit import compiled
from mbagent_envs.types import Keys

_GAMMA = np.uint64(0x9E3779B97F4A7C15)  # step of splitmix64: 2**64 / golden ratio, odd
_SALT_GAMMA = np.uint64(0xD1342543DE82EF95)  # another odd step, so that derived keys do not repeat their parent's stream
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_ONE = np.uint64(1)
_TO_UNIT = 2.0**-53  # the upper 53 bits fill a float64's mantissa


@compiled
def mix(value: np.uint64) -> np.uint64:
    """Scramble one 64-bit word (a bijection); for compiled code."""
    value = (value ^ (value >> np.uint64(30))) * _M1
    value = (value ^ (value >> np.uint64(27))) * _M2
    return value ^ (value >> np.uint64(31))


@compiled
def uniform_at(key: np.uint64, index: int) -> float:
    """Return number ``index`` of ``key``, as ``uniforms(key, n)[0, index]`` does; for compiled code."""
    word = mix(mix(key) + (np.uint64(index) + _ONE) * _GAMMA)
    return float(word >> np.uint64(11)) * _TO_UNIT


@compiled
def derive_one(key: np.uint64, salt: np.uint64) -> np.uint64:
    """Return the key derived from one key and one salt, like ``derive(key, salt)[0]``; for compiled code."""
    return mix(mix(key ^ _SALT_GAMMA) + (salt + _ONE) * _SALT_GAMMA)


@compiled
def _derive_rows(keys: Keys, salts: Keys, out: Keys) -> None:
    key_step, salt_step = min(keys.shape[0] - 1, 1), min(salts.shape[0] - 1, 1)  # 0 if one is used for all rows
    for row in range(out.shape[0]):
        out[row] = derive_one(keys[row * key_step], salts[row * salt_step])


@compiled
def fill_row(key: np.uint64, out: npt.NDArray[np.float64]) -> None:
    """Write the first numbers of ``key`` to ``out``, vectorised; for compiled code."""
    start = mix(key)
    for index in range(out.shape[0]):
        word = mix(start + (np.uint64(index) + _ONE) * _GAMMA)
        out[index] = float(word >> np.uint64(11)) * _TO_UNIT


@compiled
def _fill_uniforms(keys: Keys, out: npt.NDArray[np.float64]) -> None:
    for row in range(out.shape[0]):
        fill_row(keys[row], out[row])


def as_keys(keys: npt.ArrayLike) -> Keys:
    """Return ``keys`` as a uint64 array of at least one axis; negative integers wrap around.

    Raises:
        TypeError: if ``keys`` are not integers.
    """
    array = np.asarray(keys)
    if array.dtype.kind not in "iu":
        raise TypeError(f"keys must be integers (uint64), but they are {array.dtype}; draw them with draw_keys(rng, n).")
    return np.atleast_1d(array.astype(np.uint64, copy=False))


def uniforms(keys: npt.ArrayLike, n: int) -> npt.NDArray[np.float64]:
    """Draw ``n`` numbers for every key.

    Args:
        keys: uint64 ``[B]``.
        n: numbers per key.

    Returns:
        float64 ``[B, n]`` in [0, 1); row ``b`` depends only on ``keys[b]``, and a larger ``n`` only appends
        columns.
    """
    rows = np.ascontiguousarray(as_keys(keys))
    out = np.empty((rows.shape[0], n), dtype=np.float64)
    _fill_uniforms(rows, out)
    return out


def derive(keys: npt.ArrayLike, *salt: npt.ArrayLike) -> Keys:
    """Return new keys, independent of the given ones and of each other, one for each (key, salt ...).

    Args:
        keys: uint64 ``[B]``, or one integer.
        *salt: integers, or arrays ``[B]`` of them, that identify the purpose (a step number, an action); their
            order matters.

    Returns:
        uint64 ``[B]`` (``[1]`` if all arguments are single integers).

    Raises:
        TypeError: if an argument is not an integer or an array of integers.
        ValueError: if lengths above 1 differ.
    """
    result = as_keys(keys)
    for part in salt:
        salts = as_keys(part)
        rows = len(salts) if len(result) == 1 else len(result)
        if result.ndim != 1 or salts.ndim != 1 or len(salts) not in (1, rows):
            raise ValueError(f"keys {result.shape} and salt {salts.shape} must have one axis of equal length.")
        derived = np.empty(rows, dtype=np.uint64)
        _derive_rows(result, salts, derived)
        result = derived
    return result


def draw_keys(rng: np.random.Generator, n: int) -> Keys:
    """Draw ``n`` new keys, uint64 ``[n]``, from a generator."""
    return rng.integers(0, 2**64, size=n, dtype=np.uint64)


def hash_rows(values: NDArray[Any]) -> NDArray[np.uint64]:
    """A 64-bit hash [N] of each integer row [N, F]; equal rows have equal hashes."""
    weights = derive(np.arange(values.shape[1], dtype=np.uint64), 0x5851F42D)
    mixed = values.astype(np.uint64) + np.uint64(1)
    return derive((mixed * (weights | np.uint64(1))).sum(axis=1, dtype=np.uint64), 1)
