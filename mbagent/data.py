"""Transitions: the dataset, and the recorder that turns the steps of a vector environment into transitions.

Nothing here knows what a reward is for. A reset is never recorded as a transition.
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

_ABOUT = "dataset.json"

_MAPPED = 1_000_000
"""Bytes of a selection of mapped rows from which on it is mapped, too."""

Factors: TypeAlias = NDArray[np.integer[Any]]
"""Values of factors, of whatever width holds them."""


@dataclass(frozen=True)
class TransitionBatch:
    """Rows of experience.

    States are kept as narrow as they are given: a dataset keeps bits as single bytes, an eighth of what int64 takes.

    Attributes:
        before: states, int [N, F] of any width.
        actions: int64 [N], numbers of the enumerated actions.
        after: next states, as ``before``.
        terminated: bool [N]; truncation is not recorded, since it says nothing of the world.
        rewards: float64 [N], as met (kept for the learned reward; no transition model reads them).
        episodes: int64 [N], which episode a row is from.
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
        """States, int64 [N, F]; made anew at every call where they are kept narrower."""
        return self.before.astype(np.int64, copy=False)

    @property
    def next_states(self) -> NDArray[np.int64]:
        """Next states, as ``states``."""
        return self.after.astype(np.int64, copy=False)

    def select(self, rows: NDArray[Any] | slice) -> TransitionBatch:
        """The rows with the given indices or mask, as narrow as these; many rows of mapped files are in a mapped file, too."""
        return TransitionBatch(*(_taken(getattr(self, name), rows) for name in _KEPT))

    def narrowed(self, kind: np.dtype[Any]) -> TransitionBatch:
        """The same rows with states of another integer type."""
        return replace(self, before=self.before.astype(kind, copy=False), after=self.after.astype(kind, copy=False))

    def parts(self, size: int) -> Iterator[TransitionBatch]:
        """The rows, at most ``size`` at once, in their order."""
        for begin in range(0, len(self), size):
            yield self.select(slice(begin, begin + size))


@dataclass
class TransitionDataset:
    """All transitions met so far, append-only.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
        folder: where to keep the rows, in files that grow and are mapped into memory, so that there may be more than fit
            into it; None to keep them in memory. Rows that are in the folder already are the first. Rows count as soon as all
            columns of a call of ``append`` are on the disk: of one that was interrupted, none do.

    Raises:
        ValueError: the folder holds transitions of another environment.
    """

    cardinalities: tuple[int, ...]
    n_actions: int
    folder: str | os.PathLike[str] | None = None
    _chunks: list[TransitionBatch] = field(default_factory=list, repr=False)

    def __post_init__(self) -> None:
        """Begins a folder, or goes on with what is in it."""
        self.cardinalities = tuple(int(c) for c in self.cardinalities)
        if self.folder is not None:
            self._chunks = [_begun(Path(self.folder), self.cardinalities, self.n_actions, self.kind)]
        self._lock = Lock()  # rows that one thread adds while another merges the others must not be lost

    @property
    def kind(self) -> np.dtype[Any]:
        """The smallest unsigned integers that hold all values of factors."""
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
            ValueError: states of another width, or values or actions out of range.
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
                    raise ValueError(f"Another dataset has written to {folder} since this one read it; load it anew.")
                _write(folder, narrow, len(self))
            self._chunks = [_mapped(folder, n_factors, self.kind)]

    def _check(self, batch: TransitionBatch) -> None:
        """Refuses rows that are not of this dataset's kind."""
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
        """Appends all rows of another dataset, as further episodes.

        Raises:
            ValueError: it is of another kind of environment; nothing is changed then.
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
        """All rows as one batch, in the order met."""
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
        """Splits into training and validation rows by whole episodes, so that no row's neighbour leaks across.

        With fewer than ``min_episodes`` episodes, each is first cut into equal runs of consecutive steps.

        Args:
            fraction: share of episodes for validation.
            seed: which episodes.
            min_episodes: as said above.

        Returns:
            (training, validation); with a fraction of 0, or fewer than 10 rows, both are all rows.
        """
        rows = self.rows()
        if fraction == 0.0 or len(rows) < 10:
            return rows, rows
        held_out = self.held_out(fraction, seed, min_episodes)
        return rows.select(~held_out), rows.select(held_out)

    def held_out(self, fraction: float, seed: int, min_episodes: int = 10) -> NDArray[np.bool_]:
        """Which rows ``split`` holds out, bool [N]."""
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
        """Writes the table as a compressed ``.npz`` (plain arrays: any language reads it, nothing is pickled).

        Args:
            path: a path (".npz" is added where it does not end so) or an open binary file.

        Raises:
            TypeError, ValueError: ``path`` is neither.
            OSError: the file cannot be written; one that was there before is unchanged.
        """
        rows = self.rows()
        with files.writing(path, ".npz", always=True) as file:
            np.savez_compressed(
                file,
                cardinalities=np.array(self.cardinalities),
                n_actions=np.array(self.n_actions),
                allow_pickle=False,
                **{name: getattr(rows, kept) for name, kept in zip(_COLUMNS, _KEPT, strict=True)},
            )

    @classmethod
    def load(cls, path: files.Target) -> TransitionDataset:
        """Reads what ``save`` wrote; or, mapped into memory, a dataset's folder.

        Args:
            path: a path (".npz" may be left out), an open binary file, or a folder.

        Raises:
            FileNotFoundError: there is no such file.
            TypeError: ``path`` is none of these.
            ValueError: the file, or what is in the folder, is not such a table.
        """
        if path and isinstance(path, str | os.PathLike) and Path(path).is_dir() and not Path(f"{os.fspath(path)}.npz").is_file():
            about = _about(Path(path))
            return cls(tuple(about["cardinalities"]), about["n_actions"], path)
        cardinalities, n_actions, rows = _table(path)
        data = cls(cardinalities, n_actions)
        data.append(rows)
        return data


def _taken(values: NDArray[Any], rows: NDArray[Any] | slice) -> NDArray[Any]:
    """Some rows; where they are many of a mapped array, in a temporary file that is mapped."""
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
    """What a file holds that ``TransitionDataset.save`` wrote: cardinalities, number of actions and rows."""
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
            raise ValueError(f"{label} is no table of transitions that save_transitions wrote: {error}.") from error


def _about(folder: Path) -> dict[str, Any]:
    """What a dataset's folder says of its columns; ``rows`` is None in folders of before it was written down."""
    try:
        about = json.loads((folder / _ABOUT).read_text(encoding="utf-8"))
        kept = {"cardinalities": [int(c) for c in about["cardinalities"]], "n_actions": int(about["n_actions"])}
        return {**kept, "rows": None if about.get("rows") is None else int(about["rows"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder} is no folder of transitions: its {_ABOUT} cannot be read ({error}).") from error


def _begun(folder: Path, cardinalities: tuple[int, ...], n_actions: int, kind: np.dtype[Any]) -> TransitionBatch:
    """A folder's rows; makes the folder where there is none."""
    about = {"cardinalities": list(cardinalities), "n_actions": n_actions}
    if folder.is_file() or not cardinalities:
        raise ValueError(
            f"{folder} cannot hold transitions of {len(cardinalities)} factors; give a folder, and a factor at least."
        )
    if not (folder / _ABOUT).exists():
        Path(os.path.realpath(folder)).mkdir(parents=True, exist_ok=True)  # also where a link points to nothing yet
        for name in _COLUMNS:
            (folder / f"{name}.bin").touch()
        with _locked(folder):
            if not (folder / _ABOUT).exists():  # another process may have begun it meanwhile, and even written rows
                files.write(folder / _ABOUT, json.dumps({**about, "rows": _whole_rows(folder, len(cardinalities), kind)}))
    if {**_about(folder), "rows": None} != {**about, "rows": None}:
        raise ValueError(f"{folder} holds transitions of another environment; choose another folder.")
    return _mapped(folder, len(cardinalities), kind)


def _types(kind: np.dtype[Any]) -> dict[str, np.dtype[Any]]:
    """Type of each column in the files, the lower bytes first."""
    kinds = {"states": kind, "next_states": kind, "terminated": np.dtype(np.bool_), "rewards": np.dtype(np.float64)}
    return {name: kinds.get(name, np.dtype(np.int64)).newbyteorder("<") for name in _COLUMNS}


def _whole_rows(folder: Path, n_factors: int, kind: np.dtype[Any]) -> int:
    """Number of rows that all files have."""
    types = _types(kind)
    width = {name: n_factors if name in ("states", "next_states") else 1 for name in _COLUMNS}
    missing = [name for name in _COLUMNS if not (folder / f"{name}.bin").exists()]
    if missing:
        raise ValueError(f"{folder} is no folder of transitions: it lacks {missing[0]}.bin.")
    return min((folder / f"{name}.bin").stat().st_size // max(1, width[name] * types[name].itemsize) for name in _COLUMNS)


def _mapped(folder: Path, n_factors: int, kind: np.dtype[Any]) -> TransitionBatch:
    """The rows that were written as a whole; what was cut short counts for nothing."""
    types, columns, written = _types(kind), [], _about(folder)["rows"]
    n = _whole_rows(folder, n_factors, kind)
    if written is not None and n < written:
        raise ValueError(
            f"{folder} is damaged: a column holds only {n} of the {written} rows written; restore its files from a copy, or set "
            f"rows to {n} in its {_ABOUT} to go on with those."
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
    """Adds rows to the files, after the first ``n_before``; they count once ``dataset.json`` says how many there are."""
    for (name, kind), kept in zip(_types(batch.before.dtype).items(), _KEPT, strict=True):
        values = np.ascontiguousarray(getattr(batch, kept), dtype=kind)
        with (folder / f"{name}.bin").open("r+b") as file:
            file.seek(n_before * (values.nbytes // len(batch)))
            file.truncate()
            file.write(values.data)
            file.flush()
            os.fsync(file.fileno())
    files.write(folder / _ABOUT, json.dumps({**_about(folder), "rows": n_before + len(batch)}))


def _locked(folder: Path) -> AbstractContextManager[None]:
    """Lets one process at a time change a folder."""
    return files.locked(folder / f"{_COLUMNS[0]}.bin")


_FLUSH = 256

REUSE_CHANCE = 1e-3
"""Episodes that all end where the next one starts are reported from this probability on that they do by chance."""


class Experience:
    """All transitions met, with the values of open factors (see FactoredSpace) as declared, so that none is ever lost.

    Args:
        space: the observation space, without ``values``.
        n_actions: number of enumerated actions A.

    Attributes:
        dataset: the transitions, numbered as declared.
    """

    def __init__(self, space: FactoredSpace, n_actions: int) -> None:
        """See the class."""
        self.space, self.dataset = space, TransitionDataset(space.cardinalities, n_actions)
        self._coded: tuple[FactoredSpace, int, TransitionDataset] | None = None

    def coding(self) -> FactoredSpace:
        """The space whose open factors are the values met so far, before or after a step.

        Raises:
            ValueError: a variable took too many values.
        """
        if not len(self.space.open):
            return self.space
        rows = self.dataset.rows()
        return self.space.with_values(np.concatenate([rows.before, rows.after]))

    def coded(self, space: FactoredSpace) -> TransitionDataset:
        """The transitions in the factors of ``space``; the dataset itself where no factor is open."""
        if space.values is None or not len(space.open):
            return self.dataset
        n_met = len(self.dataset)
        if self._coded is None or self._coded[0] is not space or self._coded[1] != n_met:
            rows, coded = self.dataset.rows(), TransitionDataset(space.cardinalities, self.dataset.n_actions)
            coded.append(replace(rows, before=space.narrow(rows.states), after=space.narrow(rows.next_states)))
            self._coded = (space, n_met, coded)
        return self._coded[2]


class ExperienceRecorder:
    """Collects the steps of ``n_envs`` environments that reset themselves, as SB3's VecEnv do.

    Args:
        space: the observation space, without ``values``.
        dataset: where transitions go.
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
        """Every environment starts a new episode at ``obs`` (batched)."""
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
        """Adds one step of every environment, and returns it, [B].

        Args:
            actions: int64 [B], numbers of the enumerated actions.
            new_obs: what the vector environment returned: where an episode ended, already the next one's first.
            rewards: float [B].
            dones: bool [B].
            infos: SB3's: the true last observation is in ``terminal_observation``, a truncation in
                ``TimeLimit.truncated``.
        """
        assert self.states is not None
        if not np.isfinite(rewards).all():
            raise ValueError(
                "The environment returned a reward of NaN or infinity, or one beyond 3.4e38, which is more than the float32 of "
                "vector environments can hold; mend the environment or wrap its rewards."
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
            np.array(rewards, dtype=np.float64),  # copied: the vector environment may use its arrays again
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
        """Hands what was collected to the dataset."""
        if self._steps:
            names = ("states", "actions", "next_states", "terminated", "rewards", "episodes")
            self._dataset.append(TransitionBatch(*(np.concatenate([getattr(s, n) for s in self._steps]) for n in names)))
            self._steps = []

    def warn_of_reused_arrays(self) -> None:
        """Warns, once, where last observations of episodes seem to be overwritten by the resets that follow.

        That is so where all of them are the next episode's first, which is improbable by how often that one is observed.
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
        """Distinct start states met so far, int64 [S, F], in the order met."""
        starts = np.concatenate(self._starts) if self._starts else np.zeros((0, len(self._space)), dtype=np.int64)
        return distinct_rows(starts)


def warn_of_forgetting(learned: bool, data: TransitionDataset) -> None:
    """Warns where the next fit would replace what an agent has learned: transitions that it was fitted to are not at hand."""
    if learned and not len(data):
        warnings.warn(
            "This agent has weights, but not the transitions that they were learned from (it was loaded, or given weights), so "
            "learn() will replace what it knows by what the new steps tell. Save agents with include=['transitions'], or call "
            "load_transitions(path) first.",
            UserWarning,
            stacklevel=3,
        )


def distinct_rows(rows: States) -> States:
    """The distinct rows [S, F] of [N, F], in the order of their first appearance."""
    if len(rows) == 0:
        return rows
    _, first = np.unique(rows, axis=0, return_index=True)
    return rows[np.sort(first)]
