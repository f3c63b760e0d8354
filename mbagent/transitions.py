"""What was seen: a growing table of transitions. Nothing decides here, and nothing here knows a reward's meaning."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_COLUMNS = ("states", "actions", "next_states", "terminated", "rewards", "episodes")


@dataclass(frozen=True)
class TransitionBatch:
    """Rows of experience.

    Attributes:
        states: int64 [N, F].
        actions: int64 [N], numbers of the enumerated actions.
        next_states: int64 [N, F].
        terminated: bool [N]; truncation is not recorded, since it says nothing of the world.
        rewards: float64 [N], as met (kept for the learned reward; no transition model reads them).
        episodes: int64 [N], which episode a row is from.
    """

    states: NDArray[np.int64]
    actions: NDArray[np.int64]
    next_states: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    rewards: NDArray[np.float64]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of rows N."""
        return len(self.actions)

    def select(self, rows: NDArray[Any]) -> TransitionBatch:
        """The rows with the given indices or mask."""
        return TransitionBatch(*(getattr(self, name)[rows] for name in _COLUMNS))


@dataclass
class TransitionDataset:
    """All transitions met so far, append-only.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
    """

    cardinalities: tuple[int, ...]
    n_actions: int
    _chunks: list[TransitionBatch] = field(default_factory=list, repr=False)

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
            ValueError: states of another width, or actions out of range.
        """
        if batch.states.shape != (len(batch), len(self.cardinalities)) or batch.next_states.shape != batch.states.shape:
            raise ValueError(
                f"These transitions have states of shape {batch.states.shape} and next states of shape "
                f"{batch.next_states.shape}, but this dataset holds {len(self.cardinalities)} factors; "
                "they come from another environment."
            )
        if len(batch) and not (batch.actions.min() >= 0 and batch.actions.max() < self.n_actions):
            raise ValueError(
                f"These transitions have actions outside 0 ... {self.n_actions - 1}; they come from another environment."
            )
        self._chunks.append(batch)

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
        rows, own = other.rows(), self.rows().episodes
        first = int(own.max()) + 1 if len(own) else 0
        self.append(replace(rows, episodes=rows.episodes + first))

    def rows(self) -> TransitionBatch:
        """All rows as one batch, in the order met."""
        if not self._chunks:
            n = len(self.cardinalities)
            ints, none = np.zeros((0, n), dtype=np.int64), np.zeros(0, dtype=np.int64)
            return TransitionBatch(ints, none, ints, none.astype(np.bool_), none.astype(np.float64), none)
        if len(self._chunks) > 1:
            merged = (np.concatenate([getattr(chunk, name) for chunk in self._chunks]) for name in _COLUMNS)
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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the table as a compressed ``.npz`` (plain arrays: any language reads it, nothing is pickled)."""
        rows = self.rows()
        largest = max((*self.cardinalities, 2)) - 1
        small = np.min_scalar_type(largest)
        np.savez_compressed(
            Path(path),
            cardinalities=np.array(self.cardinalities),
            n_actions=np.array(self.n_actions),
            allow_pickle=False,
            **{name: _narrow(getattr(rows, name), name, small) for name in _COLUMNS},
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TransitionDataset:
        """Reads what ``save`` wrote.

        Raises:
            ValueError: the file is not such a table.
        """
        with np.load(Path(path), allow_pickle=False) as archive:
            missing = [name for name in (*_COLUMNS, "cardinalities", "n_actions") if name not in archive]
            if missing:
                raise ValueError(f"{path} is no table of transitions: it lacks {', '.join(missing)}.")
            data = cls(tuple(int(c) for c in archive["cardinalities"]), int(archive["n_actions"]))
            wide = {name: archive[name] for name in _COLUMNS}
        for name in ("states", "actions", "next_states", "episodes"):
            wide[name] = wide[name].astype(np.int64)
        data.append(TransitionBatch(**wide))
        return data


def _narrow(values: NDArray[Any], name: str, small: np.dtype[Any]) -> NDArray[Any]:
    return values.astype(small) if name in ("states", "next_states") else values
