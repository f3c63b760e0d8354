"""Typed decorators for numba: functions are compiled on first use, cached on disk, and run without the interpreter lock.

Numba invalidates its cache when the file of a function changes, but not when a compiled function that it calls from another file
does. Here the cache is invalidated when any file with compiled functions of the same package, or of this one, changes.
If nothing can be cached, functions are compiled again in each process, and one warning is given.
"""

from __future__ import annotations

import hashlib
import pickle
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache

from mbagent_envs.callees import link_callees

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile a function of numbers and arrays; the uncompiled function is available as ``function.py_func``."""
    return _compiled(function, {})


def vectorised(function: _F) -> _F:
    """As ``compiled``, for small loops over arrays of floats, which are vectorised.

    For this, sums may be computed in another order than written, though always in the same order for the same lengths; products
    may be added without intermediate rounding; and division by zero raises no error. Arrays must have a contiguous type, which
    those unpacked by ``a, b = np.empty((2, n))`` do not have.
    """
    return _compiled(function, {"error_model": "numpy", "fastmath": {"reassoc", "contract", "nsz"}})


def _compiled(function: _F, options: dict[str, Any]) -> _F:
    """A function compiled with options of numba, and a cache on disk that depends on the hash of the sources."""
    options = {**options, "nogil": True, "no_cfunc_wrapper": True}
    dispatcher = cast("Any", numba.njit)(**options)(function)
    if hasattr(dispatcher, "enable_caching"):  # a plain function if NUMBA_DISABLE_JIT is set
        link_callees(dispatcher, function, options)
        try:
            dispatcher._cache = _Cache(function)
        except RuntimeError as error:  # numba found no writable folder
            if "no locator available" not in str(error):
                raise
            _warn_uncached()
    return cast("_F", dispatcher)


class _Cache(FunctionCache):
    """Numba's cache, except that failures of reading or writing raise no error: the function is compiled, but not cached."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        kept: Any = self._cache_file
        if hasattr(kept, "_version"):  # numba treats a file with another version as empty
            kept._version = f"{kept._version} {_sources(_top(Path(function.__code__.co_filename)))}"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except _UNUSABLE:
            return None  # saving fails for the same reason, and then warns

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except _UNUSABLE:
            _warn_uncached()


_UNUSABLE = (OSError, EOFError, pickle.UnpicklingError)
"""Numba's errors if the folder has been removed or write-protected in the meantime, the disk is full, or a file is damaged."""


@cache
def _warn_uncached() -> None:
    """Warns, once per process, that nothing is cached."""
    warnings.warn(
        "No folder for compiled functions is writable, so each process compiles them again, which takes a minute or two; "
        "set the environment variable NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=2,
    )


@cache
def _top(path: Path) -> Path:
    """Folder of the outermost package that contains a file; the file's own folder if there is none."""
    folder = path.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


@cache
def _sources(folder: Path) -> str:
    """A hash of all files with compiled functions in a folder, and in this package."""
    digest, files = hashlib.sha256(), {*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}
    for text in (path.read_bytes() for path in sorted(files)):
        if b"jit import" in text or b"numba" in text:
            digest.update(text)
    return digest.hexdigest()[:16]


def inlined(function: _F) -> _F:
    """Compile a function inline into every compiled function that calls it; for small functions that are called often."""
    return cast("_F", numba.njit(inline="always")(function))
