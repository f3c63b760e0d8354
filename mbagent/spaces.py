"""Any discrete Gymnasium space as an array of categorical factors (paper section 2.1, "factored representations").

A space is flattened into *leaves* (the elementary spaces inside nested ``Dict`` and ``Tuple`` spaces) and every leaf
into *factors*: a binary variable of the paper is a factor with two values, a ``Discrete(n)`` is one factor with ``n``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Factors = NDArray[np.int64]
"""Factor values, int [B, F]; factor f takes the values 0 ... cardinalities[f] - 1."""

MAX_CARDINALITY = 4096
"""More values than this in one factor is refused: no model here could learn them from data."""

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


@dataclass(frozen=True)
class _Leaf:
    """One elementary space: its path in the nested space and how its values become factors."""

    path: tuple[str | int, ...]
    space: spaces.Space[Any]
    low: NDArray[np.int64]
    cardinalities: tuple[int, ...]
    shape: tuple[int, ...]

    @property
    def name(self) -> str:
        return ".".join(str(part) for part in self.path)


class FactoredSpace:
    """Translates between batches of a discrete space and arrays of factors; the two directions are exact inverses.

    Args:
        space: Discrete, MultiDiscrete, MultiBinary, integer or boolean Box, or a Dict or Tuple of these, nested at
            will.
        kind: word for error messages, "observation" or "action".

    Attributes:
        space: the space itself.
        cardinalities: number of values of each factor, length F.
        names: a readable name for each factor, length F.
        planes: the layout when the space is one stack of two-dimensional planes, else None.

    Raises:
        TypeError: the space holds a continuous or unsupported part; the message names it and the way out.
        ValueError: a factor has more than ``MAX_CARDINALITY`` values.
    """

    def __init__(self, space: spaces.Space[Any], kind: str = "observation") -> None:
        """See the class."""
        self.space = space
        self.kind = kind
        self._leaves = list(_leaves(space, (), kind))
        if not any(leaf.cardinalities for leaf in self._leaves):
            raise ValueError(f"The {kind} space {space} holds no variable; there is nothing to learn about.")
        self.cardinalities: tuple[int, ...] = tuple(c for leaf in self._leaves for c in leaf.cardinalities)
        self.names: tuple[str, ...] = tuple(_factor_names(self._leaves, kind))
        self.planes = _plane_layout(space)

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
        columns = []
        for leaf in self._leaves:
            values = np.asarray(_descend(batch, leaf.path, self.kind))
            if values.shape[1:] != leaf.shape or values.ndim == 0:
                raise ValueError(
                    f"The {self.kind} batch{_at(leaf)} has shape {values.shape}, but {leaf.space} needs "
                    f"(batch, {', '.join(map(str, leaf.shape))}); pass a batch of {self.kind}s of the environment's space."
                )
            flat = values.reshape(len(values), len(leaf.cardinalities))
            if flat.dtype.kind not in "iub" and not np.array_equal(flat, np.floor(flat)):
                raise ValueError(f"The {self.kind}{_at(leaf)} holds values that are not whole numbers; {leaf.space} has none.")
            factors = flat.astype(np.int64) - leaf.low
            outside = (factors < 0) | (factors >= np.asarray(leaf.cardinalities))
            if outside.any():
                bad = flat[outside][0]
                raise ValueError(
                    f"The {self.kind}{_at(leaf)} holds the value {bad}, which lies outside {leaf.space}; "
                    f"pass {self.kind}s of the environment's own space."
                )
            columns.append(factors)
        return np.concatenate(columns, axis=1)

    def decode(self, factors: NDArray[Any]) -> Any:
        """The batch, laid out as ``batch_space`` does and in the space's own data types, that [B, F] factors stand for."""
        return self._decode(factors, integers=False)

    def decode_wide(self, factors: NDArray[Any]) -> Any:
        """As ``decode``, with every integer widened to int64 (what reward functions get: int8 sums overflow)."""
        return self._decode(factors, integers=True)

    def _decode(self, factors: NDArray[Any], integers: bool) -> Any:
        parts: dict[tuple[str | int, ...], NDArray[Any]] = {}
        start = 0
        for leaf in self._leaves:
            stop = start + len(leaf.cardinalities)
            values = factors[:, start:stop].astype(np.int64)  # a copy: what is made of it may be changed
            if leaf.low.any():
                values += leaf.low
            dtype = np.dtype(np.int64) if integers else np.dtype(leaf.space.dtype)
            parts[leaf.path] = values.reshape(len(factors), *leaf.shape).astype(dtype, copy=False)
            start = stop
        return _assemble(self.space, (), parts)


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
        self.n = int(np.prod([float(c) for c in self.factored.cardinalities]))
        if self.n > MAX_ACTIONS:
            raise ValueError(
                f"The action space {space} has {self.n} joint actions, more than the {MAX_ACTIONS} that planning can "
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


def _leaves(space: spaces.Space[Any], path: tuple[str | int, ...], kind: str) -> Iterator[_Leaf]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from _leaves(part, (*path, key), kind)
        return
    if isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from _leaves(part, (*path, index), kind)
        return
    low, sizes = _value_range(space, path, kind)
    shape = tuple(space.shape or ())
    too_many = [size for size in sizes if size > MAX_CARDINALITY]
    if too_many:
        raise ValueError(
            f"The {kind} space's part {space} has a variable with {too_many[0]} values, more than {MAX_CARDINALITY}; "
            "narrow its range in a gymnasium.ObservationWrapper."
        )
    yield _Leaf(path, space, low, tuple(sizes), shape)


def _value_range(space: spaces.Space[Any], path: tuple[str | int, ...], kind: str) -> tuple[NDArray[np.int64], list[int]]:
    """Lowest value [n] and number of values [n] of each variable of an elementary space."""
    if isinstance(space, spaces.Discrete):
        return np.array([int(space.start)], dtype=np.int64), [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return space.start.ravel().astype(np.int64), [int(n) for n in space.nvec.ravel()]
    if isinstance(space, spaces.MultiBinary):
        n = int(np.prod(space.shape))
        return np.zeros(n, dtype=np.int64), [2] * n
    where = f" part {'.'.join(map(str, path))!r}" if path else ""
    if isinstance(space, spaces.Box) and kind == "observation":
        if space.dtype is not None and np.dtype(space.dtype).kind in "iub":
            bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)  # Python's integers: no overflow
            return space.low.ravel().astype(np.int64), [int(high) - int(low) + 1 for low, high in bounds]
        raise TypeError(
            f"The observation space{where} {space} is continuous, and this agent models discrete variables; "
            "wrap the environment with gymnasium.wrappers.DiscretizeObservation (a Box with finite bounds; clip others first)."
        )
    way_out = " wrap the environment with gymnasium.wrappers.DiscretizeAction." if kind == "action" else ""
    raise TypeError(
        f"The {kind} space{where} {space} is not discrete: Discrete, MultiDiscrete, MultiBinary"
        f"{', integer Box, Dict and Tuple' if kind == 'observation' else ''} are supported;"
        f"{way_out or ' convert it in a gymnasium.ObservationWrapper.'}"
    )


def _factor_names(leaves: Sequence[_Leaf], kind: str) -> Iterator[str]:
    for leaf in leaves:
        base = leaf.name or kind
        if len(leaf.cardinalities) == 1 and not leaf.shape:
            yield base
            continue
        for index in np.ndindex(*leaf.shape):
            yield f"{base}[{','.join(map(str, index))}]"


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


def _at(leaf: _Leaf) -> str:
    return f" part {leaf.name!r}" if leaf.path else ""


def _descend(batch: Any, path: tuple[str | int, ...], kind: str) -> Any:
    for key in path:
        missing = isinstance(batch, Mapping) and key not in batch
        if missing or not isinstance(batch, Mapping | Sequence):
            raise ValueError(f"The {kind} batch has no part {key!r}; pass batched leaves for every part of the space.")
        batch = batch[key]  # type: ignore[index]  # a str for a Mapping, an int for a Sequence
    return batch


def _assemble(space: spaces.Space[Any], path: tuple[str | int, ...], parts: Mapping[Any, NDArray[Any]]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _assemble(part, (*path, key), parts) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_assemble(part, (*path, index), parts) for index, part in enumerate(space.spaces))
    return parts[path]
