"""A world known as a table: the outcomes of every (state, action), as Gymnasium's toy_text environments hold them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mbagent.models.base import (
    Actions,
    Bools,
    Floats,
    Randomness,
    States,
    Successors,
    as_keys,
)
from mbagent.models.known import KnownModel
from mbagent.models.thinning import thin
from mbagent_envs.random_keys import uniforms


class TableModel(KnownModel):
    """A world of one factor whose rules are known. There is nothing to learn: ``fit`` does nothing, ``state_dict`` is empty.

    Args:
        offsets: where the outcomes of (state, action) begin, int64 [S * A + 1], pair number ``state * A + action``.
        next_states: int64 [M].
        terminated: bool [M].
        probabilities: [M], summing to one over each pair.
        n_actions: number of actions A.
        start: states that episodes start in, int64.

    Raises:
        ValueError: the arrays do not fit together, or a pair's probabilities do not sum to one.
    """

    def __init__(
        self,
        offsets: NDArray[np.int64],
        next_states: NDArray[np.int64],
        terminated: Bools,
        probabilities: Floats,
        n_actions: int,
        start: NDArray[np.int64],
    ) -> None:
        """See the class."""
        n_states, rest = divmod(len(offsets) - 1, n_actions)
        super().__init__((n_states,), n_actions)
        self.offsets, self.next_states, self.terminated, self.probabilities = offsets, next_states, terminated, probabilities
        self._start = start
        totals = np.add.reduceat(probabilities, offsets[:-1]) if len(probabilities) else np.zeros(0)
        lengths = {len(next_states), len(terminated), len(probabilities), int(offsets[-1])}
        if rest or len(lengths) > 1 or (np.diff(offsets) < 1).any() or not np.allclose(totals, 1.0):
            raise ValueError(
                "A table needs outcomes for every (state, action), with one next state, end and probability each, summing to one."
            )

    def start_states(self, n: int, seed: int = 0) -> States:
        """All start states, int64 [n or fewer, 1]."""
        return self._start[:n, None]

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; all of them, where they are few."""
        pairs = states[:, 0] * self.n_actions + actions
        counts = np.diff(self.offsets)[pairs]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        entries = np.arange(offsets[-1]) + np.repeat(self.offsets[pairs] - offsets[:-1], counts)
        found = Successors(offsets, self.next_states[entries, None], self.terminated[entries], self.probabilities[entries])
        return thin(found, n_samples, seed)

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        pairs, luck = states[:, 0] * self.n_actions + actions, uniforms(as_keys(rng, len(states)), 1)[:, 0]
        cumulated = np.concatenate([[0.0], np.cumsum(self.probabilities)])
        target = cumulated[self.offsets[pairs]] + luck
        entries = np.clip(np.searchsorted(cumulated, target, side="right") - 1, self.offsets[pairs], self.offsets[pairs + 1] - 1)
        return self.next_states[entries, None], self.terminated[entries]

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        found, (n_states,) = self.successors(states, actions, len(self.probabilities), 0), self.cardinalities
        result = np.zeros((len(states), n_states))
        np.add.at(result, (found.rows, found.states[:, 0]), found.probabilities)
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        found = self.successors(states, actions, len(self.probabilities), 0)
        met = (found.states[:, 0] == next_states[found.rows, 0]) & (found.terminated == terminated[found.rows])
        with np.errstate(divide="ignore"):
            result: Floats = np.log(np.bincount(found.rows[met], weights=found.probabilities[met], minlength=len(states)))
        return result


def toy_text_model(env: gym.Env[Any, Any]) -> tuple[TableModel, Callable[[Any, Any, Any], Floats]]:
    """The true model of a Gymnasium toy_text environment, and its reward as a function of (obs, action, next_obs).

    Rewards of outcomes that share (obs, action, next_obs) are averaged by their probabilities.

    Args:
        env: with ``unwrapped.P[state][action] -> [(probability, next state, reward, terminated)]``.

    Raises:
        TypeError: it has no such table.
    """
    unwrapped: Any = env.unwrapped
    if not hasattr(unwrapped, "P") or not hasattr(unwrapped, "initial_state_distrib"):
        raise TypeError(
            f"{unwrapped} has no table of its rules: it lacks P or initial_state_distrib, as toy_text's tables have them."
        )
    table, n_actions = unwrapped.P, int(unwrapped.action_space.n)
    n_states = len(table)
    offsets, rows = [0], []
    expected, mass = np.zeros((n_states, n_actions, n_states)), np.zeros((n_states, n_actions, n_states))
    for state in range(n_states):
        for action in range(n_actions):
            outcomes: dict[tuple[int, bool], float] = {}
            for probability, following, reward, over in table[state][action]:
                outcomes[following, bool(over)] = outcomes.get((following, bool(over)), 0.0) + probability
                expected[state, action, following] += probability * reward
                mass[state, action, following] += probability
            rows += [(following, over, p) for (following, over), p in outcomes.items()]
            offsets.append(len(rows))
    rewards = expected / np.maximum(mass, 1e-300)
    following, over, probabilities = zip(*rows, strict=True)
    start = np.flatnonzero(np.asarray(unwrapped.initial_state_distrib) > 0)
    model = TableModel(
        np.asarray(offsets),
        np.asarray(following),
        np.asarray(over),
        np.asarray(probabilities, dtype=np.float64),
        n_actions,
        start,
    )

    def reward_fn(obs: Any, action: Any, next_obs: Any) -> Floats:
        result: Floats = rewards[obs, action, next_obs]
        return result

    return model, reward_fn
