"""Models inside compiled search: the functions by which a compiled planner queries a model's arrays.

A model that compiled code can query returns a NamedTuple of arrays from ``kernel()``, and registers overloads of the functions
here for that type of tuple. Calls are resolved when the planner's kernel is compiled, so they have no cost at run time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])


class Outcomes(NamedTuple):
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


@runtime_checkable
class CompiledModel(Protocol):
    """A model that compiled planners can query."""

    def kernel(self) -> Any:
        """Its arrays, a NamedTuple for whose type the functions below have overloads."""
        ...


def work_for(kernel: Any, n_grid: int) -> Any:
    """Work arrays for a kernel and at most ``n_grid`` samples, created once and used for many states."""
    raise NotImplementedError


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
    raise NotImplementedError


def implements(function: Callable[..., Any], kernel_type: type) -> Callable[[_Kernel], _Kernel]:
    """Registers a compiled function as the overload of one of the functions above for a type of kernel."""

    def register(compiled_function: _Kernel) -> _Kernel:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        arguments = ", ".join(names)
        # numba requires the same argument names as in the overloaded function
        body = eval(f"lambda {arguments}: call({arguments})", {"call": compiled_function})

        def choose(kernel: Any, *rest: Any) -> Any:
            del rest
            of_type = isinstance(kernel, types.BaseNamedTuple) and cast("Any", kernel).instance_class is kernel_type
            return body if of_type else None

        overload(function, strict=False)(choose)
        return compiled_function

    return cast("Callable[[_Kernel], _Kernel]", register)
