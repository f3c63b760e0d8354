"""Encoding of any discrete Gymnasium space as an array of categorical factors (paper 2.1, "factored representations").

A space is flattened into its *elementary* spaces (those inside nested ``Dict`` and ``Tuple`` spaces), and each elementary space
is flattened into *factors*. A binary variable of the paper is a factor with two values; a ``Discrete(n)`` is one factor with
``n`` values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

MAX_CARDINALITY = 4096
"""Largest number of values of one factor; with more, no model here could be learned from data."""

MAX_DECLARED = 64
"""If a Box declares more values than this for a variable, its bounds are assumed to reflect a data type, not the real values."""

_WIDEST = 2**62
"""Largest supported number of declared values."""

Path = tuple[str | int, ...]


class OutsideSpaceError(ValueError):
    """Raised for a value outside its space.

    Args:
        cause: the problem, as the beginning of a sentence.
        remedy: advice to the caller who passed the value, as the end of the same sentence.

    Attributes:
        cause: the argument ``cause``, for messages with another remedy if the caller did not supply the value.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        """See the class."""
        super().__init__(f"{cause}; {remedy}.")
        self.cause = cause


@dataclass(frozen=True)
class Leaf:
    """One elementary space, with its path in the nested space and the numbering of its values.

    Attributes:
        path: keys and indices that lead from the nested space to this one.
        space: the space itself.
        low: each variable's lowest value, int64 [n].
        cardinalities: number of values of each variable, length n.
        shape: shape of one value of the space.
        open: whether only observed values are numbered, because too many are declared.
    """

    path: Path
    space: spaces.Space[Any]
    low: NDArray[np.int64]
    cardinalities: tuple[int, ...]
    shape: tuple[int, ...]
    open: bool

    @property
    def name(self) -> str:
        """The path as text."""
        return ".".join(str(part) for part in self.path)

    @property
    def where(self) -> str:
        """The path, for error messages; empty if the space is not nested."""
        return f" part {self.name!r}" if self.path else ""

    def encode(self, batch: Any, kind: str) -> NDArray[np.int64]:
        """Encodes this part of a batch of the whole space: numbers int64 [B, n].

        Raises:
            OutsideSpaceError: this part is missing, has the wrong shape, or holds a value outside its space.
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
                    f"{holds}, but only whole numbers from -2^61 to 2^61 are supported",
                    "make them smaller in a gymnasium.ObservationWrapper",
                )
            low, at = int(self.low[variable]), np.unravel_index(variable, self.shape)
            place = f" at index {list(map(int, at))}" if self.shape else ""
            raise OutsideSpaceError(
                f"{holds}{place}, which lies outside {self.space} ({low} to {low + self.cardinalities[variable] - 1})", own
            )
        return numbers

    def decode(self, numbers: NDArray[np.int64], wide: bool) -> NDArray[Any]:
        """Values [B, ...] of ``numbers`` int64 [B, n] (modified), in the space's data type, or as int64 if ``wide``."""
        if self.low.any():
            numbers += self.low
        dtype = np.dtype(np.int64) if wide else np.dtype(self.space.dtype)
        return numbers.reshape(len(numbers), *self.shape).astype(dtype, copy=False)


def leaves(space: spaces.Space[Any], kind: str, path: Path = ()) -> Iterator[Leaf]:
    """The elementary spaces inside ``space``, in the order of its parts.

    Raises:
        TypeError: an elementary space is not discrete; the message names the space and suggests a solution.
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
            # Python integers and a limit on the number of values prevent overflow.
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
    """Combines batched values of the elementary spaces, keyed by path, into the nested form of ``batch_space``."""
    if isinstance(space, spaces.Dict):
        return {key: assemble(part, parts, (*path, key)) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(assemble(part, parts, (*path, index)) for index, part in enumerate(space.spaces))
    return parts[path]


FactorValues = NDArray[np.int64]
"""Factor values, int [B, F]; factor f takes the values 0 ... cardinalities[f] - 1."""

_TABLED = 1024
"""Largest number of declared values for which the nearest observed values are tabulated."""

MAX_ACTIONS = 4096
"""Largest number of joint actions, since planning enumerates them."""


@dataclass(frozen=True)
class PlaneLayout:
    """How the cells of a stack of planes are laid out in a flat vector of factors.

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
    """Converts batches of a discrete space to factors and back, without loss except for unobserved values of open factors.

    An observation variable is *open* if a variable of its elementary space has too many declared values: more than 64 in a Box
    (images, for example, have 256), more than 4,096 elsewhere. Models need numbers of the observed values only. Without
    ``values``, open factors keep the declared numbers, which are not suitable for models. ``with_values`` returns a space that
    numbers each open factor's observed values in ascending order; any other value is then replaced by the nearest observed one.

    Args:
        space: Discrete, MultiDiscrete, MultiBinary, integer or boolean Box, or a Dict or Tuple of these, nested to any
            depth.
        kind: word for error messages, "observation" or "action".
        values: for each open factor, its observed values as declared numbers, ascending; None for all declared values.

    Attributes:
        space: the space itself.
        cardinalities: number of values of each factor, length F.
        names: a readable name for each factor, length F.
        open: indices of the open factors, int64 [O].
        values: as given.
        planes: the layout if the space is one stack of two-dimensional planes, else None.

    Raises:
        TypeError: the space contains a continuous or unsupported part; the message names the part and suggests a solution.
        ValueError: the space has no variable, or a variable has more than ``MAX_CARDINALITY`` observed values.
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
        """Restricts open factors to ``values``; if few values are declared, tabulates the nearest observed one of each."""
        declared = max(cardinalities[factor] for factor in self.open)
        for factor, known in zip(self.open, values, strict=True):
            if len(known) > MAX_CARDINALITY:
                raise ValueError(
                    f"The {self.kind}'s variable {self.names[factor]!r} took {len(known)} values, more than {MAX_CARDINALITY}; "
                    "reduce them in a gymnasium.ObservationWrapper, or convert them to bits with mbagent.wrappers.Bits."
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

    def encode(self, batch: Any) -> FactorValues:
        """Factors of a batch.

        Args:
            batch: in the form of ``gymnasium.vector.utils.batch_space``: one array [B, ...] for each elementary space, nested in
                Dicts and Tuples like the space.

        Returns:
            int64 [B, F].

        Raises:
            ValueError: a value lies outside the space, or the shape does not fit; the message names the part.
        """
        return self.narrow(np.concatenate([leaf.encode(batch, self.kind) for leaf in self._leaves], axis=1))

    def decode(self, factors: NDArray[Any]) -> Any:
        """The batch that ``factors`` [B, F] encode, in the form of ``batch_space`` and the space's own data types."""
        return self._decode(factors, integers=False)

    def decode_wide(self, factors: NDArray[Any], copy: bool = True) -> Any:
        """Like ``decode``, but all integers are int64 (for reward functions, since int8 sums can overflow).

        Without ``copy``, the result may contain ``factors``, which are modified.
        """
        return self._decode(factors, integers=True, copy=copy)

    def _decode(self, factors: NDArray[Any], integers: bool, copy: bool = True) -> Any:
        parts: dict[tuple[str | int, ...], NDArray[Any]] = {}
        start, numbers = 0, self.widen(factors)
        for leaf in self._leaves:
            stop = start + len(leaf.cardinalities)
            parts[leaf.path] = leaf.decode(numbers[:, start:stop].astype(np.int64, copy=copy), integers)
            start = stop
        return assemble(self.space, parts)

    def with_values(self, numbers: NDArray[Any]) -> FactoredSpace:
        """A space whose open factors have only the observed values.

        Args:
            numbers: observed states as declared numbers, int [N, F]; if N is 0, each open factor has only its lowest value.

        Raises:
            ValueError: a variable has more than ``MAX_CARDINALITY`` values.
        """
        if not len(self.open):
            return self
        rows = numbers if len(numbers) else np.zeros((1, len(self)), dtype=np.int64)
        observed = {int(factor): np.unique(rows[:, factor]) for factor in self.open}
        if self.planes is not None and len(observed) == len(self):  # all cells of a plane get the same values, for tied models
            for plane in self.planes.to_planes(np.arange(len(self))[None])[0]:
                together = np.unique(np.concatenate([observed[int(factor)] for factor in plane.ravel()]))
                observed |= dict.fromkeys(plane.ravel().tolist(), together)
        return FactoredSpace(self.space, self.kind, [observed[int(factor)] for factor in self.open])

    def same_factors(self, other: FactoredSpace) -> bool:
        """Whether the open factors of both spaces have the same values."""
        own, others = self.value_arrays(), other.value_arrays()
        return own.keys() == others.keys() and all(np.array_equal(own[name], others[name]) for name in own)

    def value_arrays(self) -> dict[str, NDArray[np.int64]]:
        """Values of open factors, concatenated ("space.values"), and how many each factor has ("space.counts"); else empty."""
        if self._nearest is None or self.values is None:
            return {}
        return {"space.values": np.concatenate(self.values), "space.counts": np.array([len(known) for known in self.values])}

    def from_value_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> FactoredSpace:
        """The space restored from the ``value_arrays`` in ``arrays``; this space if ``arrays`` does not contain them.

        Raises:
            ValueError: the arrays belong to another space.
        """
        if "space.values" not in arrays or "space.counts" not in arrays:
            return self
        values, counts = (np.asarray(arrays[name]) for name in ("space.values", "space.counts"))
        if len(counts) != len(self.open) or counts.sum() != len(values) or (counts < 1).any():
            raise ValueError("The values of open variables are those of another observation space.")
        return FactoredSpace(self.space, self.kind, np.split(values, np.cumsum(counts)[:-1]))

    def narrow(self, numbers: NDArray[np.int64]) -> FactorValues:
        """Factors int64 [B, F] of declared ``numbers``; open factors take the nearest observed value, the lower one in a tie."""
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
        """The declared numbers, int [B, F], that correspond to ``factors``; the inverse of ``narrow`` for observed values."""
        if self._nearest is None:
            return factors
        numbers = factors.astype(np.int64)
        numbers[:, self.open] = self._known[np.arange(len(self.open)), factors[:, self.open]]
        return numbers


def _nearest(known: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each number, the index of the nearest value in ``known`` (ascending); the lower one in a tie."""
    above = np.minimum(np.searchsorted(known, numbers), len(known) - 1)
    below = np.maximum(above - 1, 0)
    return np.where(np.abs(numbers - known[below]) <= np.abs(known[above] - numbers), below, above)


class ActionEnumeration:
    """Numbering of the joint actions of a discrete action space, 0 ... n - 1.

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
        """The actions with the numbers ``indices`` [B], as a batch in the space's own form."""
        return self.factored.decode(self._factors(indices))

    def decode_wide(self, indices: NDArray[Any]) -> Any:
        """As ``decode``, with all integers as int64 (for reward functions)."""
        return self.factored.decode_wide(self._factors(indices))

    def _factors(self, indices: NDArray[Any]) -> FactorValues:
        if len(self.factored) == 1:
            return np.asarray(indices, dtype=np.int64)[:, None]
        return np.stack(np.unravel_index(np.asarray(indices), self.factored.cardinalities), axis=1).astype(np.int64)


def _plane_layout(space: spaces.Space[Any]) -> PlaneLayout | None:
    """The layout if ``space`` is one stack of planes (two or three dimensions, planes of at least 3 by 3 cells), else None.

    With three dimensions, if either the first two sizes or the last two sizes are equal, but not both, the remaining axis is the
    channel axis. Otherwise the channel axis is the last axis if it is smaller than the first axis, else the first axis.
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
    """An observation or action ``value`` as a batch, and whether ``value`` was a single one.

    Raises:
        OutsideSpaceError: ``value`` is not numeric, or its shape fits neither one value of ``space`` nor a batch of values.
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
        OutsideSpaceError: ``value`` does not have the form of one value of ``space``.
    """
    batch, single = as_batch(space, value, kind)
    if not single:
        raise OutsideSpaceError(f"The {kind} {value!r} has one dimension more than {space} declares", f"pass one {kind}")
    return batch


def _all_single(parts: list[tuple[Any, bool]], kind: str) -> bool:
    """Whether all parts are single values; raises OutsideSpaceError if only some are, or if batches differ in length."""
    if len({single for _, single in parts}) > 1:
        raise OutsideSpaceError(
            f"Some parts of the {kind} are batches and some are not", f"give one {kind}, or a batch of all parts"
        )
    lengths = {len(batch) for batch, _ in parts if not isinstance(batch, dict | tuple)}
    if len(lengths) > 1:
        raise OutsideSpaceError(f"The parts of the {kind} are batches of unequal length, {sorted(lengths)}", "give each as many")
    return all(single for _, single in parts)


def _refuse_returned(space: spaces.Space[Any], value: Any) -> None:
    """Raises OutsideSpaceError if the observation is the whole tuple returned by ``reset`` or ``step``."""
    returned = isinstance(value, tuple) and len(value) in (2, 5) and isinstance(value[-1], dict)
    if returned and not (isinstance(space, spaces.Tuple) and isinstance(space.spaces[-1], spaces.Dict)):
        method = "reset" if len(value) == 2 else "step"
        raise OutsideSpaceError(f"The observation is the whole tuple that {method}() returned", "pass its first element")


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """A discrete space as JSON data.

    Raises:
        TypeError: this type of space is not supported.
    """
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {
            "type": "MultiDiscrete",
            "nvec": space.nvec.tolist(),
            "start": space.start.tolist(),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.MultiBinary):
        n = space.n
        return {
            "type": "MultiBinary",
            "n": int(n) if isinstance(n, int | np.integer) else [int(k) for k in n],
        }
    if isinstance(space, spaces.Box):
        return {
            "type": "Box",
            "low": space.low.tolist(),
            "high": space.high.tolist(),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": [[key, space_to_json(part)] for key, part in space.spaces.items()]}
    if isinstance(space, spaces.Tuple):
        return {"type": "Tuple", "spaces": [space_to_json(part) for part in space.spaces]}
    raise TypeError(f"The space {space} cannot be written as JSON.")


def space_from_json(data: Mapping[str, Any]) -> spaces.Space[Any]:
    """The space written by ``space_to_json``.

    Raises:
        ValueError: the type of space is unknown.
    """
    kind = data.get("type")
    if kind == "Discrete":
        return spaces.Discrete(data["n"], start=data["start"])
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(np.array(data["nvec"]), start=np.array(data["start"]), dtype=np.dtype(data["dtype"]).type)
    if kind == "MultiBinary":
        return spaces.MultiBinary(data["n"] if isinstance(data["n"], int) else tuple(data["n"]))
    if kind == "Box":
        dtype = np.dtype(data["dtype"])
        return spaces.Box(np.array(data["low"], dtype=dtype), np.array(data["high"], dtype=dtype), dtype=dtype.type)
    if kind == "Dict":
        return spaces.Dict([(key, space_from_json(part)) for key, part in data["spaces"]])
    if kind == "Tuple":
        return spaces.Tuple([space_from_json(part) for part in data["spaces"]])
    raise ValueError(f"The file names an unknown space {kind!r}; it was written by another program or version.")
