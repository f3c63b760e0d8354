"""The protocol of transition models (paper section 2).

"A sufficient condition to say an agent has learned an approximate model of its environment is when it can sample from
a distribution approximately similar to the real transition probability distribution. With this ability it can make
predictions and inferences, calculate statistical moments, and generate an arbitrarily large finite state machine
representation of the reachable state space."
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionDataset
from mbagent.models.fit_report import FitReport
from mbagent.types import Actions, Bools, Floats, Keys, Randomness, States
from mbagent_envs.random_keys import derive, hash_rows

LARGEST_NUMBER = 2**62
"""Upper bound of the numbers of actions, and of action sequences that are one action of a model."""


@dataclass(frozen=True)
class Successors:
    """Possible next states of each row, in CSR layout: those of row b are ``offsets[b]:offsets[b + 1]``.

    Attributes:
        offsets: int64 [B + 1].
        states: int64 [M, F].
        terminated: bool [M].
        probabilities: float64 [M], summing to one over each row.
    """

    offsets: NDArray[np.int64]
    states: States
    terminated: Bools
    probabilities: Floats

    @property
    def rows(self) -> NDArray[np.int64]:
        """Row to which each successor belongs, int64 [M]."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


@runtime_checkable
class TransitionModel(Protocol):
    """A model of P(next state, terminated | state, action) for factored states.

    Shapes: B batch, F factors. Actions are indices of enumerated actions.
    """

    cardinalities: tuple[int, ...]
    n_actions: int

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Fits the model to transitions, without rewards. ``progress`` is called with the completed share, 0 to 1."""
        ...

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """Samples next_states int64 [B, F] and terminated bool [B]."""
        ...

    def marginals(self, states: States, actions: Actions) -> Floats:
        """The predictor's output: probabilities [B, sum of cardinalities], factor after factor."""
        ...

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """Exact log-probability [B]; models without exact probabilities raise NotImplementedError."""
        ...

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """Successors for planning: all if they are few, else ``n_samples`` samples."""
        ...

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All weights, as arrays only."""
        ...

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restores the weights that ``state_dict`` returned."""
        ...


def as_keys(rng: Randomness, n: int) -> Keys:
    """Keys uint64 [n] from a generator or from keys.

    Raises:
        ValueError: the number of keys is not n.
    """
    if isinstance(rng, np.random.Generator):
        return rng.integers(0, 2**64, size=n, dtype=np.uint64)
    if len(rng) != n:
        raise ValueError(f"{len(rng)} random keys were given for {n} rows; give one key for each row.")
    return rng


def merge_draws(rows: NDArray[np.int64], n_rows: int, states: States, terminated: Bools, weights: Floats) -> Successors:
    """Adds up the weights of equal (row, state, terminated); within each row, outcomes keep the order of their first sample.

    Args:
        rows: int64 [M], ascending: the row of each sample.
        n_rows: number of rows B; each must have a sample.
        states: int64 [M, F].
        terminated: bool [M].
        weights: float [M] above zero, normalised here.
    """
    tags = derive(hash_rows(states), rows, terminated.astype(np.int64))
    _, first, inverse = np.unique(tags, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    kept = first[order]
    mass = np.bincount(rank[inverse], weights=weights, minlength=len(kept))
    counts = np.bincount(rows[kept], minlength=n_rows)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    totals = np.bincount(rows[kept], weights=mass, minlength=n_rows)
    return Successors(offsets, states[kept], terminated[kept], mass / totals[rows[kept]])
