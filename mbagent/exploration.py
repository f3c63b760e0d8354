"""How to act while learning. Nothing here ever sees a reward."""

from __future__ import annotations

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


EXPLORATIONS = {"auto": RandomExploration, "random": RandomExploration}
"""What the ``exploration`` argument of the agent may name."""
