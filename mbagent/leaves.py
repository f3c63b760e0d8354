"""The elementary spaces inside a discrete space, nested at will, and how their values become numbers from 0 on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

MAX_CARDINALITY = 4096
"""More values than this in one factor are refused: no model here could learn them from data."""

MAX_DECLARED = 64
"""A Box that declares more values than this for a variable says how they are stored, not which there are."""

_WIDEST = 2**62
"""Values are numbered up to here."""

Path = tuple[str | int, ...]


class OutsideSpaceError(ValueError):
    """A value that is not one of its space.

    Args:
        cause: what is wrong, as the beginning of a sentence.
        remedy: what a caller who passed the value should do, as its end.

    Attributes:
        cause: as given; whoever knows that the value is not the caller's names another remedy.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        """See the class."""
        super().__init__(f"{cause}; {remedy}.")
        self.cause = cause


@dataclass(frozen=True)
class Leaf:
    """One elementary space: its path in the nested space and how its values become numbers.

    Attributes:
        path: keys and indices that lead to it.
        space: the space itself.
        low: each variable's lowest value, int64 [n].
        cardinalities: how many values each variable has, length n.
        shape: of one value of the space.
        open: whether only the values that are met count, as there are too many that could be.
    """

    path: Path
    space: spaces.Space[Any]
    low: NDArray[np.int64]
    cardinalities: tuple[int, ...]
    shape: tuple[int, ...]
    open: bool

    @property
    def name(self) -> str:
        """The path, as text."""
        return ".".join(str(part) for part in self.path)

    @property
    def where(self) -> str:
        """The path, for error messages; empty where the space is not nested."""
        return f" part {self.name!r}" if self.path else ""

    def encode(self, batch: Any, kind: str) -> NDArray[np.int64]:
        """Numbers int64 [B, n] of a batch of the whole space.

        Raises:
            OutsideSpaceError: this part is missing, of another shape, or holds a value outside its space.
        """
        values = np.asarray(_descend(batch, self.path, kind))
        if values.shape[1:] != self.shape or values.ndim == 0:
            raise OutsideSpaceError(
                f"The {kind} batch{self.where} has shape {values.shape}, but {self.space} needs "
                f"(batch, {', '.join(map(str, self.shape))})",
                f"pass a batch of {kind}s of the environment's space",
            )
        flat, own = values.reshape(len(values), len(self.cardinalities)), f"pass {kind}s of the environment's own space"
        if flat.dtype.kind not in "iub" and not np.array_equal(flat, np.floor(flat)):
            odd = flat[flat != np.floor(flat)][0]
            raise OutsideSpaceError(f"The {kind}{self.where} holds the value {odd}, but {self.space} has whole numbers only", own)
        numbers = flat.astype(np.int64) - self.low
        outside = (numbers < 0) | (numbers >= np.asarray(self.cardinalities))
        if outside.any():
            row, variable = np.argwhere(outside)[0]
            holds = f"The {kind}{self.where} holds the value {flat[row, variable]}"
            if _WIDEST in self.cardinalities:
                raise OutsideSpaceError(
                    f"{holds}, but only whole numbers from -2^61 to 2^61 are told apart",
                    "make them smaller in a gymnasium.ObservationWrapper",
                )
            low, at = int(self.low[variable]), np.unravel_index(variable, self.shape)
            place = f" at index {list(map(int, at))}" if self.shape else ""
            raise OutsideSpaceError(
                f"{holds}{place}, which lies outside {self.space} ({low} to {low + self.cardinalities[variable] - 1})", own
            )
        return numbers

    def decode(self, numbers: NDArray[np.int64], wide: bool) -> NDArray[Any]:
        """Values [B, ...] of numbers int64 [B, n], which are changed; of the space's data type, or int64 if ``wide``."""
        if self.low.any():
            numbers += self.low
        dtype = np.dtype(np.int64) if wide else np.dtype(self.space.dtype)
        return numbers.reshape(len(numbers), *self.shape).astype(dtype, copy=False)


def leaves(space: spaces.Space[Any], kind: str, path: Path = ()) -> Iterator[Leaf]:
    """The elementary spaces inside ``space``, in its own order.

    Raises:
        TypeError: one is not discrete; the message names it and the way out.
    """
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from leaves(part, kind, (*path, key))
        return
    if isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from leaves(part, kind, (*path, index))
        return
    low, sizes = _value_range(space, path, kind)
    most = MAX_DECLARED if isinstance(space, spaces.Box) else MAX_CARDINALITY
    yield Leaf(path, space, low, tuple(sizes), tuple(space.shape or ()), kind == "observation" and max(sizes, default=0) > most)


def _value_range(space: spaces.Space[Any], path: Path, kind: str) -> tuple[NDArray[np.int64], list[int]]:
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
            # Python's integers, and no more values than can be numbered: no overflow.
            lows = [max(int(low), -_WIDEST // 2) for low in space.low.ravel().tolist()]
            highs = [int(high) for high in space.high.ravel().tolist()]
            return np.array(lows, dtype=np.int64), [min(high - low + 1, _WIDEST) for low, high in zip(lows, highs, strict=True)]
        raise TypeError(
            f"The observation space{where} {space} is continuous, and this agent models discrete variables; wrap the "
            "environment with gymnasium.wrappers.DiscretizeObservation(env, bins, multidiscrete=True) (a Box with finite bounds; "
            "clip others first: docs/environments.md shows how)."
        )
    way_out = " wrap the environment with gymnasium.wrappers.DiscretizeAction(env, bins)." if kind == "action" else ""
    raise TypeError(
        f"The {kind} space{where} {space} is not discrete: Discrete, MultiDiscrete, MultiBinary"
        f"{', integer Box, Dict and Tuple' if kind == 'observation' else ''} are supported;"
        f"{way_out or ' convert it in a gymnasium.ObservationWrapper.'}"
    )


def factor_names(parts: Sequence[Leaf], kind: str) -> Iterator[str]:
    """A readable name for each variable."""
    for leaf in parts:
        base = leaf.name or kind
        if len(leaf.cardinalities) == 1 and not leaf.shape:
            yield base
            continue
        for index in np.ndindex(*leaf.shape):
            yield f"{base}[{','.join(map(str, index))}]"


def _descend(batch: Any, path: Path, kind: str) -> Any:
    for key in path:
        missing = isinstance(batch, Mapping) and key not in batch
        if missing or not isinstance(batch, Mapping | Sequence):
            raise OutsideSpaceError(f"The {kind} batch has no part {key!r}", "pass batched leaves for every part of the space")
        batch = batch[key]  # type: ignore[index]  # a str for a Mapping, an int for a Sequence
    return batch


def assemble(space: spaces.Space[Any], parts: Mapping[Path, NDArray[Any]], path: Path = ()) -> Any:
    """Batched values of the elementary spaces, by path, laid out as ``batch_space`` does."""
    if isinstance(space, spaces.Dict):
        return {key: assemble(part, parts, (*path, key)) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(assemble(part, parts, (*path, index)) for index, part in enumerate(space.spaces))
    return parts[path]
