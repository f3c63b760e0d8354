"""Base classes of models: successors and moments from samples (paper section 2), and models of known rules."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent.data import TransitionDataset
from mbagent.models.fit_report import FitReport as FitReport
from mbagent.models.mdp import ReachableMDP, reachable_mdp
from mbagent.models.protocol import Successors, merge_draws
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs.random_keys import derive


class BaseTransitionModel(ABC):
    """Methods that every model has if it can sample.

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
        """Successors for planning: ``n_samples`` samples for each row, equal ones merged.

        All rows share random numbers, so that actions and states differ only in their effects.

        Args:
            states: int64 [B, F].
            actions: int64 [B].
            n_samples: number of samples for each row.
            seed: of the random numbers.
        """
        keys = derive(seed, np.arange(n_samples))
        rows = np.repeat(np.arange(len(states)), n_samples)
        next_states, terminated = self.sample(states[rows], actions[rows], np.tile(keys, len(states)))
        return merge_draws(rows, len(states), next_states, terminated, np.full(len(rows), 1.0 / n_samples))

    def reachable_mdp(self, start: States, max_states: int = 10_000, n_samples: int = 32, seed: int = 0) -> ReachableMDP:
        """The MDP reachable from ``start`` int64 [B, F]; see ``mdp.reachable_mdp``."""
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
            n_samples: number of samples for each row, at least 2.
            seed: of the random numbers.

        Raises:
            ValueError: ``n_samples`` is less than 2.

        Returns:
            (mean [B, ...], variance [B, ...]), the unbiased sample moments.
        """
        if n_samples < 2:
            raise ValueError(f"Moments need at least 2 draws for each row to have a variance, got n_samples={n_samples}.")
        rows = np.repeat(np.arange(len(states)), n_samples)
        keys = derive(seed, np.arange(len(rows)))
        next_states, _ = self.sample(states[rows], actions[rows], keys)
        values = np.asarray(of(next_states) if of else next_states, dtype=np.float64)
        values = values.reshape(len(states), n_samples, *values.shape[1:])
        return values.mean(axis=1), values.var(axis=1, ddof=1)


class ExactModel(BaseTransitionModel):
    """A model of known rules: ``fit`` does nothing and ``state_dict`` is empty; see BaseTransitionModel for the arguments."""

    def fit(self, data: TransitionDataset, *, seed: int = 0, progress: Callable[[float], None] | None = None) -> FitReport:
        """Does nothing: the rules are known."""
        if progress is not None:
            progress(1.0)
        return FitReport(n_train=len(data), n_validation=0, epochs=0, seconds=0.0)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Empty."""
        return {}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Accepts an empty mapping only.

        Raises:
            ValueError: the mapping contains weights.
        """
        if state:
            raise ValueError(f"A model of known rules has no weights, but was given {sorted(state)[0]!r} and perhaps more.")
