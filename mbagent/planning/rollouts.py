"""Random play in imagination: the paper's way to value a state (section 4.1)."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import Actions, Floats, Keys, States, TransitionModel
from mbagent.models.forecasts import DirectForecastModel
from mbagent.planning.goal import Goal
from mbagent_envs.random_keys import derive, uniforms

_STRING = 1 << 32
"""Salt of a string's random numbers: no depth is as large, so no step's numbers are used twice."""


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


def forecast_returns(
    model: DirectForecastModel, goal: Goal, states: States, keys: Keys, horizon: int, gamma: float, first_actions: Actions
) -> Floats:
    """Discounted return of one random string of actions from each state, every step forecast from the start (paper 4.2).

    Step k's transition begins in a draw of where the first k actions lead, made by the model of k steps, and is itself a
    draw of the one-step model. Errors do not accumulate over steps. The draws of different steps are not of one and the
    same future, which a mean of returns does not feel, but their maximum would.

    Args:
        model: the models of one and of several steps.
        goal: reward of each transition.
        states: int64 [B, F].
        keys: uint64 [B], the string's and the draws' randomness.
        horizon: steps.
        gamma: discount of a step.
        first_actions: int64 [B].

    Returns:
        float64 [B].
    """
    total = np.zeros(len(states))
    strings = (uniforms(derive(keys, _STRING), horizon) * model.n_actions).astype(np.int64)
    strings[:, 0] = first_actions
    for depth in range(horizon):
        step_keys = derive(keys, depth)
        reached, over = model.forecast(states, strings[:, :depth], derive(step_keys, 1))
        alive = np.flatnonzero(~over)
        here, actions = reached[alive], strings[alive, depth]
        next_states, _ = model.sample(here, actions, step_keys[alive])
        total[alive] += gamma**depth * goal(here, actions, next_states)
    return total
