"""An environment as a model of itself, for worlds without tables of their rules: its copies are stepped from observed states."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from mbagent.models.base import ExactModel
from mbagent.models.protocol import Successors, as_keys
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.types import Actions, Bools, Floats, Randomness, States

DRAWS = 64
"""Number of steps of copies from which the outcomes of a (state, action) are estimated."""

STARTS = 64
"""Number of resets for finding the start states."""

Outcome = tuple[bytes, bool]


class SnapshotModel(ExactModel):
    """Simulator model from a copy of the environment for each observed state, further copies of which are stepped.

    Valid for environments that can be copied, use only ``np_random`` for random numbers, and are fully observed. Step limits
    are ignored. Rewards are those of the first copy that observed (state, action, next state).

    Args:
        env: the environment; it is reset.
        seed: seed of all random numbers.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int = 0) -> None:
        """See the class."""
        self._space, self._actions = FactoredSpace(env.observation_space), ActionEnumeration(env.action_space)
        super().__init__(self._space.cardinalities, self._actions.n)
        self._seed = seed
        self._copies: dict[bytes, gym.Env[Any, Any]] = {}
        self._tables: dict[tuple[bytes, int], Mapping[Outcome, float]] = {}
        self._rewards: dict[tuple[bytes, int, bytes], float] = {}
        starts = []
        for number in range(STARTS):
            observation, _ = env.reset(seed=seed + number)
            starts.append(self._key(observation))
            self._copies.setdefault(starts[-1], copy.deepcopy(env))
        self._starts = sorted(set(starts))

    def _key(self, observation: Any) -> bytes:
        row: States = self._space.encode(np.asarray(observation)[None])[0]
        return row.astype(np.int64).tobytes()

    def _outcomes(self, state: bytes, action: int) -> Mapping[Outcome, float]:
        """Observed shares of the outcomes of a (state, action).

        Raises:
            ValueError: the state was never observed.
        """
        if (state, action) not in self._tables:
            if state not in self._copies:
                raise ValueError("This state was never observed: only outcomes of observed states are known.")
            found: dict[Outcome, float] = {}
            chosen = self._actions.decode(np.array([action]))[0]
            for draw in range(DRAWS):
                env = copy.deepcopy(self._copies[state])
                env.unwrapped.np_random = np.random.default_rng([self._seed, len(self._tables), draw])
                observation, reward, terminated, _, _ = env.step(chosen)
                key = self._key(observation)
                found[key, bool(terminated)] = found.get((key, bool(terminated)), 0.0) + 1.0 / DRAWS
                self._rewards.setdefault((state, action, key), float(reward))
                if not terminated:
                    self._copies.setdefault(key, env)
            self._tables[state, action] = found
        return self._tables[state, action]

    def start_states(self, n: int, seed: int = 0) -> States:
        """Observed start states, int64 [n or fewer, F]."""
        return np.stack([np.frombuffer(state, dtype=np.int64) for state in self._starts[:n]])

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; all observed outcomes, regardless of ``n_samples``."""
        tables = [self._outcomes(*pair) for pair in self._pairs(states, actions)]
        offsets = np.concatenate([[0], np.cumsum([len(table) for table in tables])]).astype(np.int64)
        rows = [(np.frombuffer(state, dtype=np.int64), over, p) for table in tables for (state, over), p in table.items()]
        following = np.array([row[0] for row in rows], dtype=np.int64).reshape(-1, len(self.cardinalities))
        return Successors(
            offsets, following, np.array([row[1] for row in rows], dtype=np.bool_), np.array([row[2] for row in rows])
        )

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        found, keys = self.successors(states, actions, DRAWS, 0), as_keys(rng, len(states))
        noise = np.array([np.random.default_rng(int(key)).random() for key in keys])
        cumulated = np.concatenate([[0.0], np.cumsum(found.probabilities)])
        chosen = np.searchsorted(cumulated, cumulated[found.offsets[:-1]] + noise, side="right") - 1
        chosen = np.clip(chosen, found.offsets[:-1], found.offsets[1:] - 1)
        return found.states[chosen], found.terminated[chosen]

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        found, start = self.successors(states, actions, DRAWS, 0), np.concatenate([[0], np.cumsum(self.cardinalities)])
        result = np.zeros((len(states), int(start[-1])))
        np.add.at(result, (found.rows[:, None], start[:-1] + found.states), found.probabilities[:, None])
        return result

    def log_prob(self, states: States, actions: Actions, next_states: States, terminated: Bools) -> Floats:
        """See TransitionModel."""
        chances = [
            self._outcomes(*pair).get((following.tobytes(), bool(over)), 0.0)
            for pair, following, over in zip(
                self._pairs(states, actions), np.ascontiguousarray(next_states, dtype=np.int64), terminated, strict=True
            )
        ]
        with np.errstate(divide="ignore"):
            result: Floats = np.log(np.array(chances))
        return result

    def reward(self, obs: Any, action: Any, next_obs: Any) -> Floats:
        """Observed rewards [B]; 0 for transitions that were never observed."""
        states, following = (self._space.encode(np.asarray(part)).astype(np.int64) for part in (obs, next_obs))
        numbers = self._actions.encode(np.asarray(action))
        keys = zip(self._pairs(states, numbers), following, strict=True)
        return np.array([self._rewards.get((*pair, then.tobytes()), 0.0) for pair, then in keys])

    def _pairs(self, states: States, actions: Actions) -> list[tuple[bytes, int]]:
        rows = np.ascontiguousarray(states, dtype=np.int64)
        return [(row.tobytes(), int(action)) for row, action in zip(rows, actions, strict=True)]
