"""Random play in imagination: the paper's way to value a state (section 4.1)."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import Actions, Floats, Keys, States, TransitionModel
from mbagent.planning.goal import Goal
from mbagent_envs.random_keys import derive, uniforms


def random_returns(
    model: TransitionModel,
    goal: Goal,
    states: States,
    keys: Keys,
    horizon: int,
    gamma: float,
    first_actions: Actions | None = None,
) -> Floats:
    """Discounted return of one random rollout from each state.

    Args:
        model: where next states come from.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], the rollout's randomness.
        horizon: steps.
        gamma: discount of a step.
        first_actions: int64 [B], else the first action is random too.

    Returns:
        float64 [B].
    """
    total, alive = np.zeros(len(states)), np.arange(len(states))
    for depth in range(horizon):
        if len(alive) == 0:
            break
        step_keys = derive(keys[alive], depth)
        if depth == 0 and first_actions is not None:
            actions = first_actions
        else:
            actions = (uniforms(derive(step_keys, 1), 1)[:, 0] * model.n_actions).astype(np.int64)
        next_states, terminated = model.sample(states, actions, step_keys)
        total[alive] += gamma**depth * goal(states, actions, next_states)
        states, alive = next_states[~terminated], alive[~terminated]
    return total
