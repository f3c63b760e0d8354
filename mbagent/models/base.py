"""What a model of the world is: the protocol, and the parts that every model shares (paper section 2).

"A sufficient condition to say an agent has learned an approximate model of its environment is when it can sample from
a distribution approximately similar to the real transition probability distribution. With this ability it can make
predictions and inferences, calculate statistical moments, and generate an arbitrarily large finite state machine
representation of the reachable state space."
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent.models.fit_report import FitReport as FitReport
from mbagent.transitions import TransitionDataset
from mbagent_envs.random_keys import derive

if TYPE_CHECKING:
    from mbagent.models.reachable import ReachableMDP

States: TypeAlias = NDArray[np.int64]
Actions: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Keys: TypeAlias = NDArray[np.uint64]
Randomness: TypeAlias = np.random.Generator | Keys
"""A Generator, or keys uint64 [B], one a row, so that no row's draw depends on another row."""

LARGEST_NUMBER = 2**62
"""Actions, and strings of actions that are one action of a model, are numbered up to here."""


@dataclass(frozen=True)
class Successors:
    """Possible next states of each row, in compressed rows: those of row b are ``offsets[b]:offsets[b + 1]``.

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
        """Which row each successor belongs to, int64 [M]."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


@runtime_checkable
class TransitionModel(Protocol):
    """A model of P(next state, terminated | state, action) over factored states.

    Shapes: B batch, F factors. Actions are numbers of the enumerated actions.
    """

    cardinalities: tuple[int, ...]
    n_actions: int

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Learns from the transitions; rewards are never read. ``progress`` is told the share done, 0 ... 1."""
        ...

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """Draws next_states int64 [B, F] and terminated bool [B]."""
        ...

    def marginals(self, states: States, actions: Actions) -> Floats:
        """The predictor's output: probabilities [B, sum of cardinalities], factor after factor."""
        ...

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """Log-probability [B], exact; a model that has none raises NotImplementedError, saying so."""
        ...

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """Next states worth planning for: all of them where they are few, else ``n_samples`` draws."""
        ...

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All weights, as arrays only."""
        ...

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Takes over what ``state_dict`` returned."""
        ...


def as_keys(rng: Randomness, n: int) -> Keys:
    """Keys uint64 [n] from either form of randomness.

    Raises:
        ValueError: keys of another length.
    """
    if isinstance(rng, np.random.Generator):
        return rng.integers(0, 2**64, size=n, dtype=np.uint64)
    if len(rng) != n:
        raise ValueError(f"{len(rng)} random keys were given for {n} rows; give one key a row.")
    return rng


class BaseTransitionModel(ABC):
    """What every model can do once it can sample.

    Args:
        cardinalities: number of values of each state factor, length F.
        n_actions: number of enumerated actions A.
    """

    def __init__(self, cardinalities: tuple[int, ...], n_actions: int) -> None:
        """See the class."""
        self.cardinalities = tuple(int(c) for c in cardinalities)
        self.n_actions = int(n_actions)

    @abstractmethod
    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """See TransitionModel."""

    @abstractmethod
    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""

    @abstractmethod
    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""

    @abstractmethod
    def state_dict(self) -> dict[str, NDArray[Any]]:
        """See TransitionModel."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See TransitionModel."""

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        raise NotImplementedError(f"{type(self).__name__} can sample, but has no exact probabilities.")

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """Next states worth planning for: ``n_samples`` draws a row, equal ones merged.

        All rows share their random numbers, so that two actions, or two states, differ by their effects and not by
        luck.

        Args:
            states: int64 [B, F].
            actions: int64 [B].
            n_samples: draws for each row.
            seed: which random numbers.
        """
        keys = derive(seed, np.arange(n_samples))
        rows = np.repeat(np.arange(len(states)), n_samples)
        next_states, terminated = self.sample(states[rows], actions[rows], np.tile(keys, len(states)))
        return merge_draws(rows, len(states), next_states, terminated, np.full(len(rows), 1.0 / n_samples))

    def reachable_mdp(self, start: States, max_states: int = 10_000, n_samples: int = 32, seed: int = 0) -> ReachableMDP:
        """The finite-state machine reachable from ``start`` int64 [B, F]; see ``reachable.reachable_mdp``."""
        from mbagent.models.reachable import reachable_mdp  # noqa: PLC0415 - reachable.py builds on this module

        return reachable_mdp(self, start, max_states, n_samples, seed)

    def moments(
        self,
        states: States,
        actions: Actions,
        of: Callable[[States], Floats] | None = None,
        n_samples: int = 1000,
        seed: int = 0,
    ) -> tuple[Floats, Floats]:
        """Mean and variance over next states (the paper's "calculate statistical moments", section 2).

        Args:
            states: int64 [B, F].
            actions: int64 [B].
            of: function of next states [N, F] to floats [N, ...]; None for the factors themselves.
            n_samples: draws for each row, at least 2.
            seed: which random numbers.

        Raises:
            ValueError: fewer draws, which have no variance.

        Returns:
            (mean [B, ...], variance [B, ...]), the unbiased sample moments.
        """
        if n_samples < 2:
            raise ValueError(f"Moments need at least 2 draws a row to have a variance, got n_samples={n_samples}.")
        rows = np.repeat(np.arange(len(states)), n_samples)
        keys = derive(seed, np.arange(len(rows)))
        next_states, _ = self.sample(states[rows], actions[rows], keys)
        values = np.asarray(of(next_states) if of else next_states, dtype=np.float64)
        values = values.reshape(len(states), n_samples, *values.shape[1:])
        return values.mean(axis=1), values.var(axis=1, ddof=1)


def hash_rows(values: NDArray[Any]) -> NDArray[np.uint64]:
    """A 64-bit hash [N] of each integer row [N, F]; equal rows have equal hashes."""
    weights = derive(np.arange(values.shape[1], dtype=np.uint64), 0x5851F42D)
    mixed = values.astype(np.uint64) + np.uint64(1)
    return derive((mixed * (weights | np.uint64(1))).sum(axis=1, dtype=np.uint64), 1)


def merge_draws(rows: NDArray[np.int64], n_rows: int, states: States, terminated: Bools, weights: Floats) -> Successors:
    """Adds up the weights of equal (row, state, terminated); each row's order is that of the first draw.

    Args:
        rows: int64 [M], ascending: which row a draw belongs to.
        n_rows: number of rows B; each must have a draw.
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
