"""Models inside compiled search: how a compiled planner queries a model's arrays.

A model that compiled code can query returns a ``Struct`` from ``kernel()`` whose class has a compiled function ``outcomes``, see
``Kernel``, and for which ``work_for`` is registered.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mbagent_envs.structs import Struct


class Outcomes(Struct):
    """Arrays for the outcomes of a state, action after action.

    Attributes:
        counts: number of outcomes of each action, int64 [A].
        states: int64 [K, F].
        terminated: bool [K].
        probabilities: [K].
        left_out: probability of each action's rare outcomes that were merged with others, see ``systematic_sampling.py``, [A].
    """

    counts: NDArray[np.int64]
    states: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    probabilities: NDArray[np.float64]
    left_out: NDArray[np.float64]


class Kernel(Protocol):
    """A model's arrays, with the compiled function that lists outcomes. It is an attribute of the class and not a method."""

    @staticmethod
    def outcomes(kernel: Any, work: Any, state: Any, n_grid: int, key: Any, offset: float, out: Outcomes) -> int:
        """Writes the outcomes of a state to ``out``: listed or stratified, as ``TransitionModel.successors``.

        Args:
            kernel: the model's arrays.
            work: see ``work_for``.
            state: int64 [F].
            n_grid: number of samples for each action, in addition to the strata of rare values.
            key: of the samples, from ``systematic_sampling.start``.
            offset: likewise.
            out: with room for twice ``n_grid`` outcomes of each action, and at least four.

        Returns:
            total number of outcomes.
        """
        ...


@runtime_checkable
class CompiledModel(Protocol):
    """A model that compiled planners can query."""

    def kernel(self) -> Kernel:
        """Its arrays."""
        ...


@singledispatch
def work_for(kernel: Any, n_grid: int) -> Any:
    """Work arrays for a kernel and at most ``n_grid`` samples, created once and used for many states."""
    raise NotImplementedError(f"There is no work space for {type(kernel).__name__}.")
