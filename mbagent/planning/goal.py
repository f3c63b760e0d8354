"""What a planner is told to want: a reward for every imagined transition, in factors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from mbagent.models.base import Actions, Floats, States

Goal: TypeAlias = Callable[[States, Actions, States], Floats]
"""``goal(states int64 [M, F], actions int64 [M], next_states int64 [M, F]) -> float64 [M]``, finite."""
