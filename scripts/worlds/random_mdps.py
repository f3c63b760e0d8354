"""Small random MDPs as tables with exact values, for the comparison of searches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from exact import optimal_q
from mbagent import files
from mbagent.types import Bools, Floats, Ints

Kind: TypeAlias = Literal["dense", "sparse"]

N_STATES, N_ACTIONS, N_SUCCESSORS = 25, 4, 3
GAMMA = 0.95

LEAF_NOISE = 1.0
"""Standard deviation of the leaf values' error, in standard deviations of the exact values over the states."""


@dataclass(frozen=True)
class RandomMDP:
    """A Markov decision process with S states, A actions and at most K successors of each (state, action).

    Attributes:
        successors: next states, int64 [S, A, K].
        probabilities: their probabilities, float64 [S, A, K], which sum to one.
        rewards: on arrival in each state, float64 [S].
        ends: whether arrival there terminates, bool [S].
        leaf_values: approximate state values, the same for all searches, float64 [S]; 0 for terminated states.
        q: exact action values, float64 [S, A].
        gamma: discount factor.
    """

    successors: Ints
    probabilities: Floats
    rewards: Floats
    ends: Bools
    leaf_values: Floats
    q: Floats
    gamma: float = GAMMA

    @property
    def table(self) -> Floats:
        """Full table of P(next state | state, action), float64 [S, A, S]."""
        n, n_actions, _ = self.successors.shape
        table = np.zeros((n, n_actions, n))
        states, actions = np.ogrid[:n, :n_actions]
        np.add.at(table, (states[..., None], actions[..., None], self.successors), self.probabilities)
        return table

    def regrets(self, roots: Ints, actions: Ints) -> Floats:
        """Regrets of the actions at the roots, float64 [...]: exact value of the best action minus theirs."""
        lost: Floats = self.q[roots].max(axis=-1) - self.q[roots, actions]
        return lost

    def random_regrets(self, roots: Ints) -> Floats:
        """Mean regret of a random action at each root."""
        lost: Floats = self.q[roots].max(axis=-1) - self.q[roots].mean(axis=-1)
        return lost


def random_mdp(kind: Kind, seed: int, n_states: int = N_STATES) -> RandomMDP:
    """An MDP with random transitions.

    Args:
        kind: "dense": a standard normal reward in every state, and a tenth of the states terminate; "sparse": one state
            in eight has reward 1 and terminates, one in eight terminates with reward 0, the others have reward 0.
        seed: seed of the MDP.
        n_states: number of states S.
    """
    rng = np.random.default_rng([seed, ("dense", "sparse").index(kind)])
    shape = (n_states, N_ACTIONS)
    successors = np.array([rng.choice(n_states, N_SUCCESSORS, replace=False) for _ in range(n_states * N_ACTIONS)])
    successors = successors.reshape(*shape, N_SUCCESSORS).astype(np.int64)
    probabilities = rng.dirichlet(np.ones(N_SUCCESSORS), size=shape)
    order, ends, rewards = rng.permutation(n_states), np.zeros(n_states, dtype=np.bool_), np.zeros(n_states)
    if kind == "dense":
        rewards = rng.normal(size=n_states)
        ends[order[: max(1, n_states // 10)]] = True
    else:
        some = max(1, n_states // 8)
        rewards[order[:some]] = 1.0
        ends[order[: 2 * some]] = True
    q = optimal_q(successors, probabilities, rewards, ends, GAMMA)
    values = np.where(ends, 0.0, q.max(axis=1))
    noise = LEAF_NOISE * values[~ends].std() * rng.normal(size=n_states)
    return RandomMDP(successors, probabilities, rewards, ends, np.where(ends, 0.0, values + noise), q)


def side_by_side(worlds: Sequence[RandomMDP]) -> RandomMDP:
    """Combines MDPs of equal K, A and gamma into one with disconnected parts: state s of MDP w becomes w * S + s."""
    offsets = np.cumsum([0, *(len(world.rewards) for world in worlds[:-1])])
    return RandomMDP(
        np.concatenate([world.successors + offset for world, offset in zip(worlds, offsets, strict=True)]),
        np.concatenate([world.probabilities for world in worlds]),
        np.concatenate([world.rewards for world in worlds]),
        np.concatenate([world.ends for world in worlds]),
        np.concatenate([world.leaf_values for world in worlds]),
        np.concatenate([world.q for world in worlds]),
        worlds[0].gamma,
    )


def choose_roots(world: RandomMDP, n: int, seed: int) -> Ints:
    """Distinct root states int64 [n], not terminated and with action values that are not all equal."""
    matters = np.flatnonzero(~world.ends & (np.ptp(world.q, axis=1) > 1e-9))
    return np.sort(np.random.default_rng(seed).permutation(matters)[:n]).astype(np.int64)


def save_mdp(path: Path, world: RandomMDP, **further: NDArray[np.generic]) -> None:
    """Writes an MDP and further arrays as .npz, in the format read by the scripts in ``scripts/peers``."""
    names = ("successors", "probabilities", "rewards", "ends", "leaf_values", "gamma")
    arrays = {name: np.asarray(getattr(world, name)) for name in names}
    files.write_arrays(path, {**arrays, **further})
