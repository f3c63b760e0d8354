"""Numba's decorator with types: compiled on first use, kept on disk, and free of the interpreter lock.

Numba renews what it keeps when the file of a function changes, not when a compiled function that it calls
from another file does: after a change in `mbagent_envs.random_keys` delete ``envs/mbagent_envs/__pycache__``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile a function of numbers and arrays; its uncompiled form stays at ``function.py_func``."""
    return cast("_F", numba.njit(cache=True, nogil=True)(function))
