"""Comparison of candidate models on held-out transitions, thinned to evenly spaced subsets, and data for the Markov test.

The test asks whether adding the previous step to the current state and action improves predictions. If it does, the observation
is not the whole state; ``mbagent.wrappers.History`` adds past steps to the observation.
"""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbagent.data import TransitionBatch, TransitionDataset
from mbagent.models.dbn.features import ActionEncoding, action_feature_table
from mbagent.spaces import FactoredSpace, PlaneLayout

SOME_ROWS, SOME_TESTS = 2500, 1000
"""Maximum numbers of transitions for fits and for held-out tests in quick decisions between candidates."""

PERFECT_LOG_PROB = -1e-3
"""Mean log-probability above which predictions are considered perfect, so that no candidate can improve them."""


def better(logs: NDArray[np.float64], others: NDArray[np.float64], errors: float = 3.0) -> bool:
    """Whether log-probabilities [N] beat ``others`` (same transitions): mean gain above ``errors`` standard errors."""
    gain = logs - others
    return bool(len(gain) > 1 and gain.mean() > errors * gain.std(ddof=1) / np.sqrt(len(gain)))


def thinned(rows: TransitionBatch, most: int) -> TransitionBatch:
    """At most ``most`` evenly spaced transitions."""
    return rows.select(np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)) if len(rows) else rows


def within(data: TransitionDataset, most: int) -> TransitionDataset:
    """The dataset, thinned evenly until transitions times factors <= ``most``; at least one transition is kept."""
    n = max(1, most // max(1, len(data.cardinalities)))
    if len(data) <= n:
        return data
    smaller = TransitionDataset(data.cardinalities, data.n_actions)
    smaller.append(thinned(data.rows(), n))
    return smaller


PART = 2000
"""Number of transitions that are compared at once."""


def following_steps(rows: TransitionBatch) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the transitions that directly follow another one in the same episode, and indices of their predecessors.

    Episodes may be interleaved.
    """
    order = np.argsort(rows.episodes, kind="stable")
    earlier, later = order[:-1], order[1:]
    same = (rows.episodes[later] == rows.episodes[earlier]) & _follow(rows, later, earlier)
    return later[same], earlier[same]


def _follow(rows: TransitionBatch, later: NDArray[np.int64], earlier: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each later transition begins where the matching earlier one ends; compared in parts to limit memory."""
    found = np.zeros(len(later), dtype=np.bool_)
    for begin in range(0, len(later), PART):
        part = slice(begin, begin + PART)
        found[part] = (rows.before[later[part]] == rows.after[earlier[part]]).all(axis=1)
    return found


def steps_in_a_row(rows: TransitionBatch, most: int) -> tuple[TransitionBatch, TransitionBatch]:
    """At most ``most`` evenly spaced transitions that follow another one, and their predecessors."""
    later, earlier = following_steps(rows)
    some = np.linspace(0, len(later) - 1, min(len(later), most)).astype(np.int64) if len(later) else later
    return rows.select(later[some]), rows.select(earlier[some])


def with_past(
    now: TransitionBatch,
    before: TransitionBatch,
    cardinalities: tuple[int, ...],
    encoding: ActionEncoding,
    board: PlaneLayout | None,
) -> tuple[FactoredSpace, TransitionBatch]:
    """Transitions whose states also include the previous state and action.

    Args:
        now: the transitions.
        before: their predecessors.
        cardinalities: number of values of each factor.
        encoding: the action encoding.
        board: layout of the planes, to which the past is added as further planes; None if the factors do not form planes.

    Returns:
        (the space of the extended states, the extended transitions).
    """
    shape: tuple[int, ...] = (len(cardinalities),) if board is None else (board.channels, board.height, board.width)

    def arranged(states: NDArray[np.int64]) -> NDArray[np.int64]:
        return states if board is None else board.to_planes(states)

    def with_history(states: NDArray[np.int64], past: NDArray[np.int64], actions: NDArray[np.int64]) -> NDArray[np.int64]:
        bits = action_feature_table(encoding, actions).astype(np.int64)
        bits = bits if board is None else np.broadcast_to(bits[:, :, None, None], (*bits.shape, *shape[1:]))
        return np.concatenate([arranged(states), arranged(past), bits], axis=1)

    cards = arranged(np.asarray(cardinalities)[None])[0]
    twos = np.full((encoding.n_features, *shape[1:]), 2)
    sizes = np.concatenate([cards, cards, twos])
    space = FactoredSpace(spaces.MultiBinary(sizes.shape) if (sizes == 2).all() else spaces.MultiDiscrete(sizes))
    states = space.encode(with_history(now.states, before.states, before.actions))
    following = space.encode(with_history(now.next_states, now.states, now.actions))
    return space, TransitionBatch(states, now.actions, following, now.terminated, now.rewards, now.episodes)
