"""The true model: a game's own rules as a transition model, for comparison with learned models."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import ExactModel
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import thin
from mbagent.spaces import FactoredSpace
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs import Game
from mbagent_envs.random_keys import derive


class SimulatorModel(ExactModel):
    """A game's true dynamics. There is nothing to learn: ``fit`` does nothing and ``state_dict`` is empty.

    Args:
        game: the game; its observation must be the whole state.

    Attributes:
        lists: whether the game can list its successors with their probabilities.
    """

    def __init__(self, game: Game) -> None:
        self.game = game
        self.space = FactoredSpace(game.observation_space)
        super().__init__(self.space.cardinalities, int(game.action_space.n))
        self._shape = game.observation_space.shape
        self.lists = type(game).transition_distributions is not Game.transition_distributions

    def start_states(self, n: int, seed: int = 0) -> States:
        """Start states int64 [n, F] of the game, with which an agent can plan without learning."""
        return self._factors(self.game.initial(derive(seed, np.arange(n))))

    def _observations(self, states: States) -> NDArray[np.int8]:
        return np.ascontiguousarray(states, dtype=np.int8).reshape(len(states), *self._shape)

    def _factors(self, observations: NDArray[np.int8]) -> States:
        return observations.reshape(len(observations), len(self.cardinalities)).astype(np.int64)

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        observations = self._observations(states)
        following = self.game.transition(observations, actions, as_keys(rng, len(states)))
        return self._factors(following), self.game.terminated(observations, actions, following)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel; exact.

        Raises:
            NotImplementedError: the game cannot list them.
        """
        found = self._listed(states, actions)
        totals = np.zeros((len(states), len(self.cardinalities)))
        np.add.at(totals, found.rows, found.states * found.probabilities[:, None])
        return np.stack((1.0 - totals, totals), axis=2).reshape(len(states), -1)

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel.

        Raises:
            NotImplementedError: the game cannot list its successors.
        """
        found = self._listed(states, actions)
        rows = found.rows
        matches = (found.states == next_states[rows]).all(axis=1) & (found.terminated == terminated[rows])
        mass = np.bincount(rows[matches], weights=found.probabilities[matches], minlength=len(states))
        with np.errstate(divide="ignore"):
            return np.log(mass)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; if the game cannot list successors, they are sampled with random numbers shared by all rows."""
        if not self.lists:
            return super().successors(states, actions, n_samples, seed)
        return thin(self._listed(states, actions), n_samples, seed)

    def _listed(self, states: States, actions: Actions) -> Successors:
        observations = self._observations(states)
        outcomes, probabilities = self.game.transition_distributions(observations, actions)
        rows, which = np.nonzero(probabilities)
        following = outcomes[rows, which]
        terminated = self.game.terminated(observations[rows], actions[rows], following)
        offsets = np.concatenate([[0], np.cumsum((probabilities > 0).sum(axis=1))]).astype(np.int64)
        return Successors(offsets, self._factors(following), terminated, probabilities[rows, which])
