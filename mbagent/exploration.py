"""How to act while learning. Nothing here ever sees a reward."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import Actions, States


class Exploration(Protocol):
    """Chooses the actions of the learning phase."""

    def act(self, states: States, rng: np.random.Generator) -> Actions:
        """Action numbers int64 [B] for states int64 [B, F]."""
        ...


class RandomExploration:
    """Every action equally often, as the paper's agents explore (section 4.4).

    Args:
        n_actions: number of enumerated actions.
    """

    def __init__(self, n_actions: int) -> None:
        """See the class."""
        self.n_actions = n_actions

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        return rng.integers(self.n_actions, size=len(states))


class PersistentExploration:
    """Random actions that are kept for a while, each step with probability ``keep``.

    For worlds in which single steps lead nowhere, as those made from continuous ones: what pushes now this way, now that, stays
    where it is.

    Args:
        n_actions: number of enumerated actions.
        keep: probability that the last action goes on, at least 0 and below 1.

    Raises:
        ValueError: ``keep`` is out of range.
    """

    def __init__(self, n_actions: int, keep: float = 0.95) -> None:
        """See the class."""
        if not 0.0 <= keep < 1.0:
            raise ValueError(f"keep must be a probability below 1, got {keep}.")
        self.n_actions, self.keep = n_actions, keep
        self._last = np.zeros(0, dtype=np.int64)

    def act(self, states: States, rng: np.random.Generator) -> NDArray[np.int64]:
        """See Exploration."""
        new = rng.integers(self.n_actions, size=len(states))
        again = rng.random(len(states)) < self.keep
        if len(self._last) == len(states):
            new = np.where(again, self._last, new)
        self._last = new
        return new.copy()


EXPLORATIONS: dict[str, Callable[[int], Exploration]] = {
    "auto": RandomExploration,
    "random": RandomExploration,
    "persistent": PersistentExploration,
}
"""What the ``exploration`` argument of the agent may name."""
