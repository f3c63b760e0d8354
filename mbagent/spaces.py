"""Any discrete Gymnasium space as an array of categorical factors (paper section 2.1, "factored representations").

A space is flattened into *leaves* (the elementary spaces inside nested ``Dict`` and ``Tuple`` spaces) and every leaf
into *factors*: a binary variable of the paper is a factor with two values, a ``Discrete(n)`` is one factor with ``n``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.leaves import MAX_CARDINALITY, OutsideSpaceError, assemble, factor_names, leaves

Factors = NDArray[np.int64]
"""Factor values, int [B, F]; factor f takes the values 0 ... cardinalities[f] - 1."""

_TABLED = 1024
"""Up to so many declared values of an open factor are looked up in a table."""

MAX_ACTIONS = 4096
"""More joint actions than this is refused: planning enumerates them."""


@dataclass(frozen=True)
class PlaneLayout:
    """Where the cells of a stack of planes lie in a flat row of factors.

    Attributes:
        channels: number of planes C.
        height: rows H.
        width: columns W.
        channels_last: whether the observation is [H, W, C] rather than [C, H, W].
    """

    channels: int
    height: int
    width: int
    channels_last: bool = False

    def to_planes(self, factors: NDArray[Any]) -> NDArray[Any]:
        """Reshapes [B, F, ...] into [B, C, H, W, ...]."""
        rest = factors.shape[2:]
        if self.channels_last:
            cells = factors.reshape(len(factors), self.height, self.width, self.channels, *rest)
            return np.moveaxis(cells, 3, 1)
        return factors.reshape(len(factors), self.channels, self.height, self.width, *rest)


class FactoredSpace:
    """Translates between batches of a discrete space and arrays of factors; the two directions are exact inverses.

    A variable with very many declared values (a Box of more than 64, as images declare 256; else more than 4,096) is
    *open*: only the values that are met count. Without ``values`` it is numbered as declared, which no model should be
    given; ``with_values`` gives the space whose open factors are the values met, in order. A value that is not among them
    is then taken for the nearest that is.

    Args:
        space: Discrete, MultiDiscrete, MultiBinary, integer or boolean Box, or a Dict or Tuple of these, nested at
            will.
        kind: word for error messages, "observation" or "action".
        values: numbers of the values met by each open factor, ascending; None for all that are declared.

    Attributes:
        space: the space itself.
        cardinalities: number of values of each factor, length F.
        names: a readable name for each factor, length F.
        open: the open factors, int64 [O].
        values: as given.
        planes: the layout when the space is one stack of two-dimensional planes, else None.

    Raises:
        TypeError: the space holds a continuous or unsupported part; the message names it and the way out.
        ValueError: there is no variable, or one has met more than ``MAX_CARDINALITY`` values.
    """

    def __init__(
        self, space: spaces.Space[Any], kind: str = "observation", values: Sequence[NDArray[np.int64]] | None = None
    ) -> None:
        """See the class."""
        self.space = space
        self.kind = kind
        self._leaves = list(leaves(space, kind))
        if not any(leaf.cardinalities for leaf in self._leaves):
            raise ValueError(f"The {kind} space {space} holds no variable; there is nothing to learn about.")
        cardinalities = [c for leaf in self._leaves for c in leaf.cardinalities]
        self.open = np.flatnonzero([leaf.open for leaf in self._leaves for _ in leaf.cardinalities]).astype(np.int64)
        self.names: tuple[str, ...] = tuple(factor_names(self._leaves, kind))
        self.planes = _plane_layout(space)
        self.values = None if values is None else tuple(np.asarray(each, dtype=np.int64) for each in values)
        self._nearest: NDArray[np.int64] | None = None
        if self.values is not None and len(self.open):
            self._count_only(self.values, cardinalities)
        self.cardinalities: tuple[int, ...] = tuple(cardinalities)

    def _count_only(self, values: tuple[NDArray[np.int64], ...], cardinalities: list[int]) -> None:
        """Gives open factors the values met; where few are declared, with a table of the nearest to look up."""
        declared = max(cardinalities[factor] for factor in self.open)
        for factor, known in zip(self.open, values, strict=True):
            if len(known) > MAX_CARDINALITY:
                raise ValueError(
                    f"The {self.kind}'s variable {self.names[factor]!r} took {len(known)} values, more than {MAX_CARDINALITY}; "
                    "make them fewer in a gymnasium.ObservationWrapper, or see them as bits with mbagent.wrappers.Bits."
                )
            cardinalities[factor] = len(known)
        most = max(map(len, values))
        self._known = np.stack([np.pad(known, (0, most - len(known)), mode="edge") for known in values])
        tabled = values if declared <= _TABLED else ()
        rows = [_nearest(known, np.arange(declared)) for known in tabled]
        self._nearest = np.array(rows, dtype=np.int64).reshape(len(rows), declared if rows else 0)

    def __len__(self) -> int:
        """Number of factors F."""
        return len(self.cardinalities)

    def encode(self, batch: Any) -> Factors:
        """Factors of a batch.

        Args:
            batch: laid out as ``gymnasium.vector.utils.batch_space`` does: arrays [B, ...], in Dicts and Tuples by
                leaf.

        Returns:
            int64 [B, F].

        Raises:
            ValueError: a value lies outside the space, or the shape does not fit; the message says which part.
        """
        return self.narrow(np.concatenate([leaf.encode(batch, self.kind) for leaf in self._leaves], axis=1))

    def decode(self, factors: NDArray[Any]) -> Any:
        """The batch, laid out as ``batch_space`` does and in the space's own data types, that [B, F] factors stand for."""
        return self._decode(factors, integers=False)

    def decode_wide(self, factors: NDArray[Any]) -> Any:
        """As ``decode``, with every integer widened to int64 (what reward functions get: int8 sums overflow)."""
        return self._decode(factors, integers=True)

    def _decode(self, factors: NDArray[Any], integers: bool) -> Any:
        parts: dict[tuple[str | int, ...], NDArray[Any]] = {}
        start, numbers = 0, self.widen(factors)
        for leaf in self._leaves:
            stop = start + len(leaf.cardinalities)
            parts[leaf.path] = leaf.decode(numbers[:, start:stop].astype(np.int64), integers)  # a copy, which may be changed
            start = stop
        return assemble(self.space, parts)

    def with_values(self, numbers: NDArray[Any]) -> FactoredSpace:
        """The space whose open factors are the values met.

        Args:
            numbers: what was met, int [N, F], numbered as declared; the lowest values where N is 0.

        Raises:
            ValueError: a variable took more than ``MAX_CARDINALITY`` values.
        """
        if not len(self.open):
            return self
        rows = numbers if len(numbers) else np.zeros((1, len(self)), dtype=np.int64)
        met = {int(factor): np.unique(rows[:, factor]) for factor in self.open}
        if self.planes is not None and len(met) == len(self):  # a plane's cells have the same values, so that they can share
            for plane in self.planes.to_planes(np.arange(len(self))[None])[0]:
                together = np.unique(np.concatenate([met[int(factor)] for factor in plane.ravel()]))
                met |= dict.fromkeys(plane.ravel().tolist(), together)
        return FactoredSpace(self.space, self.kind, [met[int(factor)] for factor in self.open])

    def same_factors(self, other: FactoredSpace) -> bool:
        """Whether the factors of both have the same values."""
        own, others = self.value_arrays(), other.value_arrays()
        return own.keys() == others.keys() and all(np.array_equal(own[name], others[name]) for name in own)

    def value_arrays(self) -> dict[str, NDArray[np.int64]]:
        """The open factors' values as arrays, "space.values" one after the other and how many each has; empty without any."""
        if self._nearest is None or self.values is None:
            return {}
        return {"space.values": np.concatenate(self.values), "space.counts": np.array([len(known) for known in self.values])}

    def from_value_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> FactoredSpace:
        """The space whose ``value_arrays`` these are; this one, where there are none among them.

        Raises:
            ValueError: they are of another space.
        """
        if "space.values" not in arrays or "space.counts" not in arrays:
            return self
        values, counts = (np.asarray(arrays[name]) for name in ("space.values", "space.counts"))
        if len(counts) != len(self.open) or counts.sum() != len(values) or (counts < 1).any():
            raise ValueError("The values of open variables are those of another observation space.")
        return FactoredSpace(self.space, self.kind, np.split(values, np.cumsum(counts)[:-1]))

    def narrow(self, numbers: NDArray[np.int64]) -> Factors:
        """Factors int64 [B, F] of numbers as declared: the nearest of the values met, the lower of two."""
        if self._nearest is None:
            return numbers
        factors = numbers.copy()
        if len(self._nearest):
            factors[:, self.open] = self._nearest[np.arange(len(self.open)), numbers[:, self.open]]
            return factors
        for factor, known in zip(self.open, self.values or (), strict=True):
            factors[:, factor] = _nearest(known, numbers[:, factor])
        return factors

    def widen(self, factors: NDArray[Any]) -> NDArray[Any]:
        """Numbers as declared, int [B, F], of factors."""
        if self._nearest is None:
            return factors
        numbers = factors.astype(np.int64)
        numbers[:, self.open] = self._known[np.arange(len(self.open)), factors[:, self.open]]
        return numbers


def _nearest(known: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which of ``known``, ascending, is nearest to each number; the lower of two."""
    above = np.minimum(np.searchsorted(known, numbers), len(known) - 1)
    below = np.maximum(above - 1, 0)
    return np.where(np.abs(numbers - known[below]) <= np.abs(known[above] - numbers), below, above)


class ActionEnumeration:
    """A discrete action space as one list of joint actions, numbered 0 ... n - 1.

    Args:
        space: a Discrete, MultiDiscrete or MultiBinary action space.

    Attributes:
        factored: the action space's factors.
        n: number of joint actions A.

    Raises:
        TypeError: the space is not discrete.
        ValueError: there are more than ``MAX_ACTIONS`` joint actions.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        """See the class."""
        if isinstance(space, spaces.Dict | spaces.Tuple):
            raise TypeError(
                f"The action space {space} is a {type(space).__name__}: Discrete, MultiDiscrete and MultiBinary are supported; "
                "make it one MultiDiscrete in a gymnasium.ActionWrapper."
            )
        self.factored = FactoredSpace(space, kind="action")
        self.n = math.prod(self.factored.cardinalities)
        if self.n > MAX_ACTIONS:
            many = f"{self.n:,}" if self.n < 10**12 else f"about 10^{len(str(self.n)) - 1}"
            raise ValueError(
                f"The action space {space} has {many} joint actions, more than the {MAX_ACTIONS:,} that planning can "
                "enumerate; merge or drop actions in a gymnasium.ActionWrapper."
            )

    def encode(self, batch: Any) -> NDArray[np.int64]:
        """Action numbers [B] of a batch in the space's own form."""
        factors = self.factored.encode(batch)
        indices: NDArray[np.int64] = np.ravel_multi_index(tuple(factors.T), self.factored.cardinalities).astype(np.int64)
        return indices

    def decode(self, indices: NDArray[Any]) -> Any:
        """The batch of actions, in the space's own form, with the numbers ``indices`` [B]."""
        return self.factored.decode(self._factors(indices))

    def decode_wide(self, indices: NDArray[Any]) -> Any:
        """As ``decode``, integers as int64 (for reward functions)."""
        return self.factored.decode_wide(self._factors(indices))

    def _factors(self, indices: NDArray[Any]) -> Factors:
        if len(self.factored) == 1:
            return np.asarray(indices, dtype=np.int64)[:, None]
        return np.stack(np.unravel_index(np.asarray(indices), self.factored.cardinalities), axis=1).astype(np.int64)


def _plane_layout(space: spaces.Space[Any]) -> PlaneLayout | None:
    """The layout if ``space`` is one stack of planes: two or three dimensions, cells at least 3 by 3.

    Of three dimensions, the channel axis is the one whose size differs where the other two (the first two or the last two)
    are equal; else the first, unless the last is strictly the smaller.
    """
    if not isinstance(space, spaces.MultiBinary | spaces.Box | spaces.MultiDiscrete):
        return None
    shape = tuple(space.shape or ())
    if len(shape) == 2:
        shape = (1, *shape)
        last = False
    elif len(shape) == 3:
        square_first, square_last = shape[0] == shape[1], shape[1] == shape[2]
        last = square_first if square_first != square_last else shape[2] < shape[0]
    else:
        return None
    channels, height, width = (shape[2], shape[0], shape[1]) if last else shape
    return PlaneLayout(channels, height, width, last) if min(height, width) >= 3 else None


def as_batch(space: spaces.Space[Any], value: Any, kind: str = "observation") -> tuple[Any, bool]:
    """An observation (or action) as a batch, and whether it was a single one.

    Raises:
        OutsideSpaceError: it is not made of numbers, or its shape is neither that of one value of ``space`` nor of a batch.
    """
    if kind == "observation":
        _refuse_returned(space, value)
    own = f"pass {kind}s as the environment's {kind}_space declares them"
    if isinstance(space, spaces.Dict):
        if not isinstance(value, Mapping):
            raise OutsideSpaceError(f"The {kind} must be a dict with the keys {sorted(space.spaces)}, got {value!r}", own)
        lacking, surplus = space.spaces.keys() - value.keys(), value.keys() - space.spaces.keys()
        if lacking or surplus:
            what = f"lacks the key {min(lacking)!r}" if lacking else f"has the undeclared key {min(map(str, surplus))!r}"
            raise OutsideSpaceError(f"The {kind} {what} (declared are {sorted(space.spaces)})", own)
        parts = {key: as_batch(part, value[key], kind) for key, part in space.spaces.items()}
        return {key: batch for key, (batch, _) in parts.items()}, _all_single(list(parts.values()), kind)
    if isinstance(space, spaces.Tuple):
        if not isinstance(value, tuple | list) or len(value) != len(space.spaces):
            raise OutsideSpaceError(f"The {kind} must be a tuple of {len(space.spaces)} parts, got {value!r}", own)
        pairs = [as_batch(part, each, kind) for part, each in zip(space.spaces, value, strict=True)]
        return tuple(batch for batch, _ in pairs), _all_single(pairs, kind)
    try:
        array, shape = np.asarray(value), tuple(space.shape or ())
    except ValueError:
        array, shape = np.asarray(None), tuple(space.shape or ())  # rows of unequal length
    if array.dtype.kind not in "biuf":
        raise OutsideSpaceError(f"The {kind} must be numbers of {space}, got {value!r}", own)
    if array.shape == shape:
        return array[None], True
    if array.shape[1:] == shape and array.ndim == len(shape) + 1:
        return array, False
    batched = f"(batch, {', '.join(map(str, shape))})"
    raise OutsideSpaceError(f"The {kind} has shape {array.shape}, but {space} needs {shape}, or {batched} for a batch", own)


def one_as_batch(space: spaces.Space[Any], value: Any, kind: str = "observation") -> Any:
    """One observation (or action) as a batch of one.

    Raises:
        OutsideSpaceError: it is none of ``space``, or a batch.
    """
    batch, single = as_batch(space, value, kind)
    if not single:
        raise OutsideSpaceError(f"The {kind} {value!r} has one dimension more than {space} declares", f"pass one {kind}")
    return batch


def _all_single(parts: list[tuple[Any, bool]], kind: str) -> bool:
    """Whether all parts are single values; OutsideSpaceError if they are not all alike, or batches of unequal length."""
    if len({single for _, single in parts}) > 1:
        raise OutsideSpaceError(
            f"Some parts of the {kind} are batches and some are not", f"give one {kind}, or a batch of all parts"
        )
    lengths = {len(batch) for batch, _ in parts if not isinstance(batch, dict | tuple)}
    if len(lengths) > 1:
        raise OutsideSpaceError(f"The parts of the {kind} are batches of unequal length, {sorted(lengths)}", "give each as many")
    return all(single for _, single in parts)


def _refuse_returned(space: spaces.Space[Any], value: Any) -> None:
    """Raises OutsideSpaceError if what is given for an observation is all that ``reset`` or ``step`` returned."""
    returned = isinstance(value, tuple) and len(value) in (2, 5) and isinstance(value[-1], dict)
    if returned and not (isinstance(space, spaces.Tuple) and isinstance(space.spaces[-1], spaces.Dict)):
        method = "reset" if len(value) == 2 else "step"
        raise OutsideSpaceError(f"The observation is the whole tuple that {method}() returned", "pass its first element")
