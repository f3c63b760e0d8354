"""The true model of an RDDL domain, computed from its rules: exact values, and a model for the agent's planner."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from exact import FiniteHorizonMDP
from mbagent.adapters.rddl import RddlEnv, load_rddl
from mbagent.models.base import ExactModel
from mbagent.models.protocol import Successors, as_keys
from mbagent.models.systematic_sampling import thin
from mbagent.types import Actions, Bools, Floats, Randomness, States
from mbagent_envs.random_keys import uniforms

MAX_STATES = 20_000
"""Larger domains are not tabulated."""

_LISTED = 6
"""Largest number of uncertain bits whose joint values are listed; with more, states are sampled."""


@dataclass(frozen=True)
class RddlTables:
    """A domain's reachable states, and the effects of each action in them.

    Attributes:
        states: states int64 [S, F]; the first is the start state.
        chances: probability that each bit is on in the next state, float64 [S, A, F].
        rewards: rewards, float64 [S, A].
    """

    states: States
    chances: Floats
    rewards: Floats

    def rows_of(self, states: States) -> NDArray[np.int64]:
        """Index of each state [B] among the reachable states; -1 for others."""
        weights = 1 << np.arange(self.states.shape[1], dtype=np.int64)
        own = self.states @ weights
        order = np.argsort(own)
        place = np.minimum(np.searchsorted(own, states @ weights, sorter=order), len(own) - 1)
        rows: NDArray[np.int64] = order[place]
        return np.where(own[rows] == states @ weights, rows, -1)

    def mdp(self, horizon: int) -> FiniteHorizonMDP:
        """The domain with exact values, in episodes of ``horizon`` steps."""
        start = np.zeros(len(self.states))
        start[0] = 1.0
        return FiniteHorizonMDP(self.states.astype(np.int8), self.transitions(), self.rewards, start, horizon)

    def transitions(self) -> Floats:
        """P(next | state, action) among the reachable states, float64 [S, A, S]."""
        n, n_actions, _ = self.chances.shape
        result = np.ones((n, n_actions, n))
        for bit, values in enumerate(self.states.T):
            p = self.chances[:, :, bit, None]
            result *= np.where(values == 1, p, 1.0 - p)
        return result


def rddl_tables(env: RddlEnv) -> RddlTables:
    """Tabulates a domain of binary fluents.

    Each Bernoulli variable is evaluated to its probability instead of a sample, so that one evaluation of the rules gives the
    exact probabilities of all next fluents. This holds if next fluents are independent given state and action, on which
    rewards must depend.

    Raises:
        NotImplementedError: the domain is of another kind.
        ValueError: it has more than ``MAX_STATES`` states.
    """
    if not isinstance(env.observation_space, spaces.MultiBinary):
        raise NotImplementedError("Only domains of binary fluents are tabulated.")
    rules = _Rules(env)
    found: dict[bytes, int] = {}
    states, chances, rewards = [rules.start], [], []
    found[rules.start.tobytes()] = 0
    at = 0
    while at < len(states):
        of_actions = [rules.evaluate(states[at], assignment) for assignment in env.assignments]
        chances.append(np.stack([p for p, _ in of_actions]))
        rewards.append([reward for _, reward in of_actions])
        for following in {row.tobytes(): row for p, _ in of_actions for row in _outcomes(p)}.values():
            if following.tobytes() not in found:
                found[following.tobytes()] = len(states)
                states.append(following)
        if len(states) > MAX_STATES:
            raise ValueError(f"The domain has more than {MAX_STATES} reachable states.")
        at += 1
    return RddlTables(np.stack(states), np.stack(chances), np.array(rewards))


def _outcomes(chances: Floats) -> States:
    """All possible next states, int64 [K, F]."""
    open_bits = np.flatnonzero((chances > 0) & (chances < 1))
    values = np.array(list(product((0, 1), repeat=len(open_bits))), dtype=np.int64).reshape(2 ** len(open_bits), len(open_bits))
    states = np.tile((chances >= 1).astype(np.int64), (len(values), 1))
    states[:, open_bits] = values
    return states


class _Rules:
    """Evaluates a domain's rules at any state."""

    def __init__(self, env: RddlEnv) -> None:
        from pyRDDLGym.core.simulator import RDDLSimulator  # noqa: PLC0415 - an optional dependency

        class Chances(RDDLSimulator):  # type: ignore[misc]
            """A simulator that evaluates random variables to their probabilities."""

            def _sample_bernoulli(self, expr: Any, subs: Any) -> Any:
                return self._sample(expr.args[0], subs)

        self.rddl = load_rddl(env.domain, env.instance, backend=Chances)
        model = self.rddl.model
        if model.interm_fluents or model.derived_fluents or self.rddl.sampler.is_pomdp or model.terminations:
            raise NotImplementedError("Domains with intermediate fluents, ends or hidden states are not tabulated.")
        observation, _ = self.rddl.reset()
        self.fluents = env.fluents
        self.start = np.array([int(observation[name]) for name in env.fluents], dtype=np.int64)

    def evaluate(self, state: States, assignment: dict[str, Any]) -> tuple[Floats, float]:
        """Probability [F] that each fluent is on in the next state, and the reward."""
        sampler, model = self.rddl.sampler, self.rddl.model
        values = dict(zip(self.fluents, state.astype(bool).tolist(), strict=True))
        subs = sampler.subs
        for name in model.next_state:
            grounded = [values[ground] for ground in model.variable_groundings[name]]
            subs[name] = np.reshape(np.array(grounded), np.shape(subs[name])) if np.shape(subs[name]) else grounded[0]
        subs.update(sampler.prepare_actions_for_sim(assignment))
        for name, rule, _ in sampler.cpfs:
            subs[name] = sampler._sample(rule, subs)
        reward = float(sampler.sample_reward())
        chances: dict[str, float] = {}
        for name, following in model.next_state.items():
            grounded = np.ravel(subs[following]).astype(np.float64).tolist()
            chances |= dict(zip(model.variable_groundings[name], grounded, strict=True))
        return np.array([chances[name] for name in self.fluents]), reward


class RddlModel(ExactModel):
    """A tabulated domain with the models' protocol.

    Args:
        tables: the domain.
    """

    def __init__(self, tables: RddlTables) -> None:
        """See the class."""
        super().__init__((2,) * tables.states.shape[1], tables.chances.shape[1])
        self.tables = tables

    def start_states(self, n: int, seed: int = 0) -> States:
        """The start state, int64 [1, F]."""
        del n, seed
        return self.tables.states[:1]

    def _chances(self, states: States, actions: Actions) -> Floats:
        return self.tables.chances[self.tables.rows_of(states), actions]

    def sample(self, states: States, actions: Actions, rng: Randomness) -> tuple[States, Bools]:
        """See TransitionModel."""
        noise = uniforms(as_keys(rng, len(states)), states.shape[1])
        return (noise < self._chances(states, actions)).astype(np.int64), np.zeros(len(states), dtype=np.bool_)

    def marginals(self, states: States, actions: Actions) -> Floats:
        """See TransitionModel."""
        chances = self._chances(states, actions)
        return np.stack((1.0 - chances, chances), axis=2).reshape(len(states), -1)

    def successors(self, states: States, actions: Actions, n_samples: int, seed: int) -> Successors:
        """See TransitionModel; complete if few bits are uncertain."""
        chances = self._chances(states, actions)
        if (((chances > 0) & (chances < 1)).sum(axis=1) > _LISTED).any():
            return super().successors(states, actions, n_samples, seed)
        found = [_outcomes(row) for row in chances]
        offsets = np.concatenate([[0], np.cumsum([len(rows) for rows in found])]).astype(np.int64)
        following, p = np.concatenate(found), np.repeat(chances, np.diff(offsets), axis=0)
        mass = np.where(following == 1, p, 1.0 - p).prod(axis=1)
        return thin(Successors(offsets, following, np.zeros(len(mass), dtype=np.bool_), mass), n_samples, seed)

    def reward(self, obs: Any, action: Any, next_obs: Any) -> Floats:
        """The domain's reward, see RewardFn."""
        del next_obs
        rewards: Floats = self.tables.rewards[self.tables.rows_of(np.asarray(obs)), action]
        return rewards
