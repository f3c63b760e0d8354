"""Errors of forecasts, from samples or exact."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import BaseTransitionModel
from mbagent.models.neural.forecasts import DirectForecastModel, number_strings
from mbagent.models.protocol import TransitionModel
from mbagent.types import Actions, Floats, States

NAN = float("nan")

FEWEST_CERTAIN = 20
"""Smallest number of cases with a single possible outcome for a meaningful share."""


def marginal_variation(draws: States, truth: States, cardinalities: tuple[int, ...]) -> float:
    """Total variation between each factor's frequencies, mean over cases and factors.

    Args:
        draws: int64 [cases, M, F].
        truth: int64 [cases, M', F].
        cardinalities: length F.
    """
    total = np.zeros(draws.shape[::2])
    for value in range(max(cardinalities)):
        total += np.abs((draws == value).mean(axis=1) - (truth == value).mean(axis=1))
    return float(0.5 * total.mean())


def inexact_share(draws: States, truth: States) -> float:
    """Share of samples that differ from the certain next state.

    Only cases in which all true samples [cases, M', F] agree are counted; NaN if these are fewer than
    ``FEWEST_CERTAIN``.
    """
    certain = (truth == truth[:, :1]).all(axis=(1, 2))
    if int(certain.sum()) < FEWEST_CERTAIN:
        return NAN
    hit = (draws[certain] == truth[certain][:, :1]).all(axis=2)
    return float(1.0 - hit.mean())


def transition_matrices(model: TransitionModel, states: States) -> Floats:
    """Exact probabilities [A, S, S] of all transitions between ``states`` [S, F]; mass on other states is missing."""
    n = len(states)
    result = np.empty((model.n_actions, n, n))
    source, target = np.repeat(states, n, axis=0), np.tile(states, (n, 1))
    for action in range(model.n_actions):
        actions, alive = np.full(n * n, action), np.zeros(n * n, dtype=np.bool_)
        result[action] = np.exp(model.log_prob(source, actions, target, alive)).reshape(n, n)
    return result


def follow(matrices: Floats, starts: Actions, strings: Actions) -> Floats:
    """Distribution [B, S] after each action string [B, n] from the states numbered ``starts`` [B]."""
    n_states = matrices.shape[1]
    result = np.eye(n_states)[starts]
    for action in strings.T:
        result = np.einsum("bs,bst->bt", result, matrices[action])
    return result


def direct_distribution(model: DirectForecastModel, states: States, starts: Actions, strings: Actions) -> Floats:
    """The same by the model of n steps: exact probabilities [B, S]; mass on other states is missing."""
    n, one = len(states), model.direct[strings.shape[1]]
    numbers = np.repeat(number_strings(strings, model.n_actions), n)
    source, target = np.repeat(states[starts], n, axis=0), np.tile(states, (len(starts), 1))
    logs = one.log_prob(source, numbers, target, np.zeros(len(source), dtype=np.bool_))
    return np.exp(logs).reshape(len(starts), n)


def joint_variation(found: Floats, truth: Floats) -> float:
    """Total variation of joint distributions [B, S], mean over B; mass missing in ``found`` is on other states."""
    missing = 1.0 - found.sum(axis=1)
    return float((0.5 * (np.abs(found - truth).sum(axis=1) + missing)).mean())


def listed_states(model: BaseTransitionModel, start: States, most: int) -> States | None:
    """All reachable states of the true model, if they are at most ``most`` and no episode terminates; else None."""
    try:
        model.marginals(start[:1], np.zeros(1, dtype=np.int64))
    except NotImplementedError:
        return None
    mdp = model.reachable_mdp(start, max_states=most, n_samples=10_000)
    return mdp.states if mdp.complete and not mdp.terminated.any() else None
