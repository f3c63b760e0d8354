"""Rare events in which almost everything is drawn anew: told from all other steps before anything else is learned."""

from __future__ import annotations

import numpy as np

from mbagent.models.base import Bools
from mbagent.transitions import Factors

USUAL = 0.95
"""Share of transitions that are taken for usual in any case."""


def flag_events(states: Factors, next_states: Factors) -> Bools:
    """Which transitions look like a rare event, bool [N].

    Those that change more than twice as many factors as nearly all others, and those that change factors which otherwise
    never change.

    Args:
        states: int [N, F].
        next_states: int [N, F].
    """
    changed = states != next_states
    count = changed.sum(axis=1)
    usual = count <= 2 * max(1.0, float(np.quantile(count, USUAL))) if len(count) else np.ones(0, dtype=np.bool_)
    still = ~changed[usual].any(axis=0)
    events: Bools = changed[:, still].any(axis=1)
    return events
