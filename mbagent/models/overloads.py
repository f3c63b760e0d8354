"""Models inside compiled search: what a compiled planner asks of a model's arrays.

A model that can be asked from compiled code returns a NamedTuple of arrays from ``kernel()``, and gives the functions
here an overload for that type of tuple. Calls are resolved when the planner's kernel is compiled, so they cost
nothing.
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
    """Room for what may follow a state, action after action.

    Attributes:
        counts: how many outcomes each action has, int64 [A].
        states: int64 [K, F].
        terminated: bool [K].
        probabilities: [K].
        left_out: probability of the rare outcomes of each action that others stand for, see ``particles.py``, [A].
    """

    counts: NDArray[np.int64]
    states: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    probabilities: NDArray[np.float64]
    left_out: NDArray[np.float64]


@runtime_checkable
class CompiledModel(Protocol):
    """A model that compiled planners can ask."""

    def kernel(self) -> Any:
        """Its arrays, a NamedTuple that the functions below have overloads for."""
        ...


def work_for(kernel: Any, n_grid: int) -> Any:
    """Work space for a kernel and at most ``n_grid`` draws at once; made once, used for many states."""
    raise NotImplementedError


def outcomes(kernel: Any, work: Any, state: Any, n_grid: int, key: Any, offset: float, out: Outcomes) -> int:
    """Writes what may follow a state to ``out``: listed or stratified, as ``TransitionModel.successors``.

    Args:
        kernel: the model's arrays.
        work: see ``work_for``.
        state: int64 [F].
        n_grid: draws for each action, beside strata for what is rare.
        key: of the draws, as ``particles.start`` makes it of a seed.
        offset: likewise.
        out: with room for twice ``n_grid`` outcomes of each action, and four at least.

    Returns:
        how many there are in all.
    """
    raise NotImplementedError


def implements(function: Callable[..., Any], kernel_type: type) -> Callable[[_Kernel], _Kernel]:
    """Makes a compiled function the overload of one of the functions above for a type of kernel."""

    def register(compiled_function: _Kernel) -> _Kernel:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        arguments = ", ".join(names)
        # numba wants the very argument names of the function that is overloaded
        body = eval(f"lambda {arguments}: call({arguments})", {"call": compiled_function})

        def choose(kernel: Any, *rest: Any) -> Any:
            del rest
            of_type = isinstance(kernel, types.BaseNamedTuple) and cast("Any", kernel).instance_class is kernel_type
            return body if of_type else None

        overload(function, strict=False)(choose)
        return compiled_function

    return cast("Callable[[_Kernel], _Kernel]", register)
