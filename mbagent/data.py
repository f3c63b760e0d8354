"""Transitions: the dataset, and the recorder that turns the steps of a vector environment into transitions.

Rewards are stored but not interpreted here. A reset is never recorded as a transition.
"""

from __future__ import annotations

import json
import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent import files
from mbagent.environments import blaming_environment
from mbagent.locks import Lock
from mbagent.spaces import FactoredSpace, one_as_batch
from mbagent.types import Actions, States
from mbagent_envs.random_keys import hash_rows

_COLUMNS = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
_KEPT = ("before", "actions", "after", "terminated", "rewards", "episodes")

_DESCRIPTION = "dataset.json"

_MAPPED = 1_000_000
"""Smallest size in bytes at which a selection of rows of a mapped array is itself stored in a mapped file."""

Factors: TypeAlias = NDArray[np.integer[Any]]
"""Values of factors, of any integer type."""


@dataclass(frozen=True)
class TransitionBatch:
    """A batch of transitions, one per row.

    States keep their given integer type: a dataset, for example, stores bits as uint8, an eighth of the size of int64.

    Attributes:
        before: states, [N, F], of any integer type.
        actions: int64 [N], numbers of the enumerated actions.
        after: next states, as ``before``.
        terminated: bool [N]; truncation is not recorded, since it is not part of the dynamics.
        rewards: float64 [N], as observed (for the learned reward; transition models do not use them).
        episodes: int64 [N], episode number of each row.
    """

    before: Factors
    actions: NDArray[np.int64]
    after: Factors
    terminated: NDArray[np.bool_]
    rewards: NDArray[np.float64]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of rows N."""
        return len(self.actions)

    @property
    def states(self) -> NDArray[np.int64]:
        """States, int64 [N, F]; a new array at each access if they are stored as a narrower type."""
        return self.before.astype(np.int64, copy=False)

    @property
    def next_states(self) -> NDArray[np.int64]:
        """Next states, as ``states``."""
        return self.after.astype(np.int64, copy=False)

    def select(self, rows: NDArray[Any] | slice) -> TransitionBatch:
        """Rows by index or mask, in the same types; large selections from memory-mapped arrays are memory-mapped too."""
        return TransitionBatch(*(_selected(getattr(self, name), rows) for name in _KEPT))

    def narrowed(self, kind: np.dtype[Any]) -> TransitionBatch:
        """The same rows, with states converted to the given integer type."""
        return replace(self, before=self.before.astype(kind, copy=False), after=self.after.astype(kind, copy=False))

    def parts(self, size: int) -> Iterator[TransitionBatch]:
        """The rows in order, in batches of at most ``size``."""
        for begin in range(0, len(self), size):
            yield self.select(slice(begin, begin + size))


@dataclass
class TransitionDataset:
    """All transitions observed so far, append-only.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        folder: folder that stores the rows in growing, memory-mapped files, so that the data may be larger than memory; None to
            keep the rows in memory. Rows already in the folder come first. An ``append`` takes effect only when all of its
            columns are on disk, so an interrupted call adds no rows.

    Raises:
        ValueError: the folder holds transitions of another environment.
    """

    cardinalities: tuple[int, ...]
    n_actions: int
    folder: str | os.PathLike[str] | None = None
    _chunks: list[TransitionBatch] = field(default_factory=list, repr=False)

    def __post_init__(self) -> None:
        """Creates the folder, or opens the existing one."""
        self.cardinalities = tuple(int(c) for c in self.cardinalities)
        if self.folder is not None:
            self._chunks = [_open_folder(Path(self.folder), self.cardinalities, self.n_actions, self.kind)]
        self._lock = Lock()  # rows that one thread appends while another merges chunks must not be lost

    @property
    def kind(self) -> np.dtype[Any]:
        """The smallest unsigned integer type that can represent all values of all factors."""
        return np.min_scalar_type(max((*self.cardinalities, 2)) - 1)

    def __len__(self) -> int:
        """Number of transitions."""
        return sum(len(chunk) for chunk in self._chunks)

    @property
    def n_episodes(self) -> int:
        """Number of distinct episodes."""
        return len(np.unique(self.rows().episodes)) if len(self) else 0

    def append(self, batch: TransitionBatch) -> None:
        """Adds rows.

        Raises:
            ValueError: the number of factors is wrong, or values or actions are out of range.
        """
        self._check(batch)
        with self._lock:
            self._add(batch.narrowed(self.kind))

    def _add(self, narrow: TransitionBatch) -> None:
        if self.folder is None:
            self._chunks.append(narrow)
        elif len(narrow):
            folder, n_factors = Path(self.folder), len(self.cardinalities)
            with _locked(folder):
                if len(_mapped(folder, n_factors, self.kind)) != len(self):
                    raise ValueError(f"Another dataset has written to {folder} since this one read it; load it again.")
                _write(folder, narrow, len(self))
            self._chunks = [_mapped(folder, n_factors, self.kind)]

    def _check(self, batch: TransitionBatch) -> None:
        """Raises ValueError if rows do not have this dataset's factors and actions."""
        n, n_factors = len(batch), len(self.cardinalities)
        if batch.before.shape != (n, n_factors) or batch.after.shape != batch.before.shape:
            raise ValueError(
                f"These transitions have states of shape {batch.before.shape} and next states of shape "
                f"{batch.after.shape}, but this dataset holds {n_factors} factors; they come from another environment."
            )
        if any(len(getattr(batch, name)) != n for name in _KEPT) or {batch.before.dtype.kind, batch.after.dtype.kind} - set(
            "iub"
        ):
            raise ValueError("Transitions need columns of one length, and states that are whole numbers.")
        if n and not (batch.actions.min() >= 0 and batch.actions.max() < self.n_actions):
            raise ValueError(
                f"These transitions have actions outside 0 ... {self.n_actions - 1}; they come from another environment."
            )
        for values in (batch.before, batch.after) if n else ():
            wrong = (values.min(axis=0) < 0) | (values.max(axis=0) >= np.asarray(self.cardinalities))
            if wrong.any():
                factor = int(wrong.argmax())
                raise ValueError(
                    f"These transitions have values of factor {factor} outside 0 ... {self.cardinalities[factor] - 1}; they come "
                    "from another environment."
                )

    def take(self, other: TransitionDataset) -> None:
        """Appends all rows of another dataset as new episodes.

        Raises:
            ValueError: the other dataset has different factors or actions; this dataset is unchanged.
        """
        if (other.cardinalities, other.n_actions) != (self.cardinalities, self.n_actions):
            raise ValueError(
                f"These transitions have {len(other.cardinalities)} factors and {other.n_actions} actions, this dataset "
                f"{len(self.cardinalities)} and {self.n_actions}; they come from another environment."
            )
        with self._lock:
            rows, own = other.rows(), self.rows().episodes
            first = int(own.max()) + 1 if len(own) else 0
            self.append(replace(rows, episodes=rows.episodes + first))

    def rows(self) -> TransitionBatch:
        """All rows as one batch, in the order in which they were observed."""
        if not self._chunks:
            n = len(self.cardinalities)
            ints, none = np.zeros((0, n), dtype=self.kind), np.zeros(0, dtype=np.int64)
            return TransitionBatch(ints, none, ints, none.astype(np.bool_), none.astype(np.float64), none)
        with self._lock:
            if len(self._chunks) > 1:
                merged = (np.concatenate([getattr(chunk, name) for chunk in self._chunks]) for name in _KEPT)
                self._chunks = [TransitionBatch(*merged)]
            return self._chunks[0]

    def split(self, fraction: float, seed: int, min_episodes: int = 10) -> tuple[TransitionBatch, TransitionBatch]:
        """Splits the rows into training and validation by whole episodes, so that consecutive steps of an episode stay together.

        With fewer than ``min_episodes`` episodes, the rows are instead cut into ``min_episodes`` runs of consecutive steps.

        Args:
            fraction: share of episodes for validation.
            seed: seed of the selection of episodes.
            min_episodes: see above.

        Returns:
            (training, validation); both contain all rows if ``fraction`` is 0 or there are fewer than 10 rows.
        """
        rows = self.rows()
        if fraction == 0.0 or len(rows) < 10:
            return rows, rows
        held_out = self.held_out(fraction, seed, min_episodes)
        return rows.select(~held_out), rows.select(held_out)

    def held_out(self, fraction: float, seed: int, min_episodes: int = 10) -> NDArray[np.bool_]:
        """Mask of the rows that ``split`` holds out, bool [N]."""
        rows = self.rows()
        if fraction == 0.0 or len(rows) < 10:
            return np.zeros(len(rows), dtype=np.bool_)
        _, groups = np.unique(rows.episodes, return_inverse=True)
        if groups.max() + 1 < min_episodes:
            groups = np.arange(len(rows)) * min_episodes // len(rows)
        n_groups = int(groups.max()) + 1
        order = np.random.default_rng(seed).permutation(n_groups)
        result: NDArray[np.bool_] = np.isin(groups, order[: max(1, round(fraction * n_groups))])
        return result

    def save(self, path: files.Target) -> None:
        """Writes the dataset as a compressed ``.npz`` of plain arrays, without pickled objects.

        Args:
            path: a path (".npz" is appended if missing), or an open binary file.

        Raises:
            TypeError, ValueError: ``path`` is neither.
            OSError: the file cannot be written; if ``path`` is a path, an existing file there is unchanged.
        """
        rows = self.rows()
        with files.writing(path, ".npz", always=True) as file:
            columns = {name: getattr(rows, kept) for name, kept in zip(_COLUMNS, _KEPT, strict=True)}
            sizes = {"cardinalities": np.array(self.cardinalities), "n_actions": np.array(self.n_actions)}
            files.write_arrays(file, {**sizes, **columns}, compressed=True)

    @classmethod
    def load(cls, path: files.Target) -> TransitionDataset:
        """Reads a file written by ``save``, or opens a dataset's folder with memory mapping.

        Args:
            path: a path (".npz" may be omitted), an open binary file, or a folder.

        Raises:
            FileNotFoundError: there is no such file.
            TypeError: ``path`` is none of these.
            ValueError: the file or the folder does not contain a dataset.
        """
        if path and isinstance(path, str | os.PathLike) and Path(path).is_dir() and not Path(f"{os.fspath(path)}.npz").is_file():
            about = _read_description(Path(path))
            return cls(tuple(about["cardinalities"]), about["n_actions"], path)
        cardinalities, n_actions, rows = _table(path)
        data = cls(cardinalities, n_actions)
        data.append(rows)
        return data


def _selected(values: NDArray[Any], rows: NDArray[Any] | slice) -> NDArray[Any]:
    """The selected rows; a large selection from a memory-mapped array is itself mapped to a temporary file."""
    if not isinstance(values, np.memmap) or isinstance(rows, slice):
        return values[rows]
    numbers = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
    shape = (len(numbers), *values.shape[1:])
    if np.prod(shape) * values.itemsize < _MAPPED:
        return np.asarray(values[numbers])
    with tempfile.TemporaryFile() as file:
        result: NDArray[Any] = np.memmap(file, dtype=values.dtype, mode="w+", shape=shape)
    step = max(1, _MAPPED // max(1, values[:1].nbytes))
    for begin in range(0, len(numbers), step):
        result[begin : begin + step] = values[numbers[begin : begin + step]]
    return result


def _table(source: files.Target) -> tuple[tuple[int, ...], int, TransitionBatch]:
    """Cardinalities, number of actions and rows from a file written by ``TransitionDataset.save``."""
    with files.reading(source, ".npz") as file:
        label = getattr(file, "name", "The file")
        try:
            table = files.arrays(file)
            missing = [name for name in (*_COLUMNS, "cardinalities", "n_actions") if name not in table]
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}")
            columns: Any = (table[name].astype(np.int64) if name in ("actions", "episodes") else table[name] for name in _COLUMNS)
            return tuple(int(c) for c in table["cardinalities"]), int(table["n_actions"]), TransitionBatch(*columns)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{label} is not a table of transitions written by save_transitions: {error}.") from error


def _read_description(folder: Path) -> dict[str, Any]:
    """Description stored in a dataset's folder; ``rows`` is None if the version that wrote it stored no row count."""
    try:
        about = json.loads((folder / _DESCRIPTION).read_text(encoding="utf-8"))
        kept = {"cardinalities": [int(c) for c in about["cardinalities"]], "n_actions": int(about["n_actions"])}
        return {**kept, "rows": None if about.get("rows") is None else int(about["rows"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder} is not a folder of transitions: its {_DESCRIPTION} cannot be read ({error}).") from error


def _open_folder(folder: Path, cardinalities: tuple[int, ...], n_actions: int, kind: np.dtype[Any]) -> TransitionBatch:
    """A folder's rows; creates the folder if it does not exist."""
    about = {"cardinalities": list(cardinalities), "n_actions": n_actions}
    if folder.is_file() or not cardinalities:
        raise ValueError(
            f"{folder} cannot hold transitions of {len(cardinalities)} factors; give a folder, and at least one factor."
        )
    if not (folder / _DESCRIPTION).exists():
        Path(os.path.realpath(folder)).mkdir(parents=True, exist_ok=True)  # also for a link whose target does not exist yet
        for name in _COLUMNS:
            (folder / f"{name}.bin").touch()
        with _locked(folder):
            if not (folder / _DESCRIPTION).exists():  # another process may have created it in the meantime, and even written rows
                files.write(folder / _DESCRIPTION, json.dumps({**about, "rows": _whole_rows(folder, len(cardinalities), kind)}))
    if {**_read_description(folder), "rows": None} != {**about, "rows": None}:
        raise ValueError(f"{folder} holds transitions of another environment; choose another folder.")
    return _mapped(folder, len(cardinalities), kind)


def _types(kind: np.dtype[Any]) -> dict[str, np.dtype[Any]]:
    """Little-endian data type of each column in the files."""
    kinds = {"states": kind, "next_states": kind, "terminated": np.dtype(np.bool_), "rewards": np.dtype(np.float64)}
    return {name: kinds.get(name, np.dtype(np.int64)).newbyteorder("<") for name in _COLUMNS}


def _whole_rows(folder: Path, n_factors: int, kind: np.dtype[Any]) -> int:
    """Number of rows that are complete in every column file."""
    types = _types(kind)
    width = {name: n_factors if name in ("states", "next_states") else 1 for name in _COLUMNS}
    missing = [name for name in _COLUMNS if not (folder / f"{name}.bin").exists()]
    if missing:
        raise ValueError(f"{folder} is not a folder of transitions: it lacks {missing[0]}.bin.")
    return min((folder / f"{name}.bin").stat().st_size // max(1, width[name] * types[name].itemsize) for name in _COLUMNS)


def _mapped(folder: Path, n_factors: int, kind: np.dtype[Any]) -> TransitionBatch:
    """The completely written rows, with memory-mapped states; rows of an interrupted write are ignored."""
    types, columns, written = _types(kind), [], _read_description(folder)["rows"]
    n = _whole_rows(folder, n_factors, kind)
    if written is not None and n < written:
        raise ValueError(
            f"{folder} is damaged: a column holds only {n} of the {written} rows written; restore its files from a copy, or set "
            f"rows to {n} in its {_DESCRIPTION} to go on with those."
        )
    n = n if written is None else written
    for name in _COLUMNS:
        shape = (n, n_factors) if name in ("states", "next_states") else (n,)
        wide, path = len(shape) == 2, folder / f"{name}.bin"
        empty = n == 0 or n_factors == 0
        mapped = np.zeros(shape, dtype=types[name]) if empty else np.memmap(path, dtype=types[name], mode="r", shape=shape)
        columns.append(mapped if wide else np.array(mapped))
    return TransitionBatch(*columns)


def _write(folder: Path, batch: TransitionBatch, n_before: int) -> None:
    """Writes new rows after the first ``n_before``; they become valid when ``dataset.json`` has the new row count."""
    for (name, kind), kept in zip(_types(batch.before.dtype).items(), _KEPT, strict=True):
        values = np.ascontiguousarray(getattr(batch, kept), dtype=kind)
        with (folder / f"{name}.bin").open("r+b") as file:
            file.seek(n_before * (values.nbytes // len(batch)))
            file.truncate()
            file.write(values.data)
            file.flush()
            os.fsync(file.fileno())
    files.write(folder / _DESCRIPTION, json.dumps({**_read_description(folder), "rows": n_before + len(batch)}))


def _locked(folder: Path) -> AbstractContextManager[None]:
    """Lock that lets only one process at a time change a folder."""
    return files.locked(folder / f"{_COLUMNS[0]}.bin")


_FLUSH = 256

REUSE_CHANCE = 1e-3
"""A warning is given if all episodes end in the next one's start state and the probability of that by chance is below this."""


class Experience:
    """All observed transitions; open factors (see FactoredSpace) keep their declared numbers, so that no value is lost.

    Args:
        space: the observation space, without ``values``.
        n_actions: number of enumerated actions A.

    Attributes:
        dataset: the transitions, with values as declared numbers.
    """

    def __init__(self, space: FactoredSpace, n_actions: int) -> None:
        """See the class."""
        self.space, self.dataset = space, TransitionDataset(space.cardinalities, n_actions)
        self._coded: tuple[FactoredSpace, int, TransitionDataset] | None = None

    def coding(self) -> FactoredSpace:
        """The space with open factors restricted to the values observed so far in states or next states.

        Raises:
            ValueError: a variable has too many observed values.
        """
        if not len(self.space.open):
            return self.space
        rows = self.dataset.rows()
        return self.space.with_values(np.concatenate([rows.before, rows.after]))

    def coded(self, space: FactoredSpace) -> TransitionDataset:
        """The transitions, encoded in the factors of ``space``; the dataset itself if no factor is open."""
        if space.values is None or not len(space.open):
            return self.dataset
        n_rows = len(self.dataset)
        if self._coded is None or self._coded[0] is not space or self._coded[1] != n_rows:
            rows, coded = self.dataset.rows(), TransitionDataset(space.cardinalities, self.dataset.n_actions)
            coded.append(replace(rows, before=space.narrow(rows.states), after=space.narrow(rows.next_states)))
            self._coded = (space, n_rows, coded)
        return self._coded[2]


class ExperienceRecorder:
    """Records the steps of ``n_envs`` environments that reset automatically, as in SB3's VecEnv.

    Args:
        space: the observation space, without ``values``.
        dataset: receives the transitions.
        n_envs: number of environments B.

    Attributes:
        states: int64 [B, F], the current state of every environment; None before ``reset``.
    """

    def __init__(self, space: FactoredSpace, dataset: TransitionDataset, n_envs: int) -> None:
        """See the class."""
        self._space, self._dataset = space, dataset
        self._steps: list[TransitionBatch] = []
        self._starts: list[States] = []
        self._ends_at_starts = True
        rows = dataset.rows().episodes
        self._next_episode = int(rows.max()) + 1 if len(rows) else 0
        self._episodes = np.zeros(n_envs, dtype=np.int64)
        self.states: States | None = None

    def reset(self, obs: Any) -> None:
        """Starts a new episode in every environment from the batch of observations ``obs``."""
        with blaming_environment():
            self.states = self._space.encode(obs)
        self._begin(np.arange(len(self.states)))

    def _begin(self, which: NDArray[np.int64]) -> None:
        assert self.states is not None
        self._episodes[which] = self._next_episode + np.arange(len(which))
        self._next_episode += len(which)
        self._starts.append(self.states[which])

    def record(
        self,
        actions: Actions,
        new_obs: Any,
        rewards: NDArray[Any],
        dones: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> TransitionBatch:
        """Records one step of every environment and returns these B transitions.

        Args:
            actions: int64 [B], numbers of the enumerated actions.
            new_obs: observations from the vector environment's step; where an episode ended, the first observation of the next
                one.
            rewards: float [B].
            dones: bool [B].
            infos: as in SB3: ``terminal_observation`` holds the last observation of an episode, ``TimeLimit.truncated`` whether
                it was truncated.

        Raises:
            ValueError: a reward or an observation is invalid, or ``infos`` lacks the last observation of an episode.
        """
        assert self.states is not None
        if not np.isfinite(rewards).all():
            raise ValueError(
                "The environment returned a reward of NaN or infinity, or one beyond 3.4e38, which is more than the float32 of "
                "vector environments can hold; fix the environment or wrap its rewards."
            )
        ended, terminated = np.flatnonzero(dones), np.array(dones, dtype=np.bool_)
        with blaming_environment():
            following = self._space.encode(new_obs)
            next_states = following.copy() if len(ended) else following
            for i in ended:
                last = infos[i].get("terminal_observation")
                if last is None:
                    raise ValueError(
                        f"The vector environment ended an episode without infos[{i}]['terminal_observation'], as SB3's have it; "
                        "add it, or make the environment's step return a new info dict each time."
                    )
                next_states[i] = self._space.encode(one_as_batch(self._space.space, last))[0]
                terminated[i] = not infos[i].get("TimeLimit.truncated", False)
        step = TransitionBatch(
            self.states,
            actions.astype(np.int64),
            next_states,
            terminated,
            np.array(rewards, dtype=np.float64),  # copied, since the vector environment may reuse its arrays
            self._episodes.copy(),
        )
        self._steps.append(step)
        self.states = following
        if len(ended):
            self._ends_at_starts &= np.array_equal(next_states[ended], following[ended])
            self._begin(ended)
        if len(self._steps) >= _FLUSH:
            self.flush()
        return step

    def flush(self) -> None:
        """Appends the recorded steps to the dataset."""
        if self._steps:
            names = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
            self._dataset.append(TransitionBatch(*(np.concatenate([getattr(s, n) for s in self._steps]) for n in names)))
            self._steps = []

    def warn_of_reused_arrays(self) -> None:
        """Warns once if resets appear to overwrite the last observations of the preceding episodes.

        This is assumed if every episode's last observation equals the next one's first, and these start states are so rare that
        this is unlikely by chance.
        """
        if not self._ends_at_starts or len(self._starts) < 2 or isinstance(self._space.space, spaces.Discrete):
            return  # numbers cannot be overwritten
        observed, starts = np.sort(hash_rows(self._dataset.rows().states)), hash_rows(np.concatenate(self._starts[1:]))
        counts = np.searchsorted(observed, starts, side="right") - np.searchsorted(observed, starts, side="left")
        if np.log(np.maximum(counts, 1) / len(observed)).sum() > np.log(REUSE_CHANCE):
            return
        self._ends_at_starts = False
        warnings.warn(
            f"All {len(starts)} episodes so far ended with the observation that the next one starts with, so the environment "
            "probably returns an array that its reset overwrites; make its step and reset return copies (return obs.copy()), or "
            "ignore this if its episodes do end where they start.",
            UserWarning,
            stacklevel=3,
        )

    def starts(self) -> States:
        """Distinct start states observed so far, int64 [S, F], in order of first appearance."""
        starts = np.concatenate(self._starts) if self._starts else np.zeros((0, len(self._space)), dtype=np.int64)
        return distinct_rows(starts)


def warn_of_forgetting(learned: bool, data: TransitionDataset) -> None:
    """Warns if the next fit would discard the learned weights because the transitions they were fitted to are not available."""
    if learned and not len(data):
        warnings.warn(
            "This agent has weights, but not the transitions that they were learned from (it was loaded, or given weights), so "
            "learn() will replace what it knows by a fit to the new steps only. Save agents with include=['transitions'], or "
            "call load_transitions(path) first.",
            UserWarning,
            stacklevel=3,
        )


def distinct_rows(rows: States) -> States:
    """The distinct rows [S, F] of ``rows`` [N, F], in order of first appearance."""
    if len(rows) == 0:
        return rows
    _, first = np.unique(rows, axis=0, return_index=True)
    return rows[np.sort(first)]
