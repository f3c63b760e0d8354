"""Numba's decorator with types: compiled on first use, kept on disk, and free of the interpreter lock.

Numba renews what it keeps when the file of a function changes, but not when a compiled function that it calls from another file
does. Here everything that was kept is renewed when any file with compiled functions of the same package, or of this one, changes.
Where nothing can be kept, functions are compiled anew in each process, and one warning says so.
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
from numba.core import cgutils, types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

_F = TypeVar("_F", bound=Callable[..., Any])
_T = TypeVar("_T")


def compiled(function: _F) -> _F:
    """Compile a function of numbers and arrays; its uncompiled form stays at ``function.py_func``."""
    return _kept(numba.njit(nogil=True)(function), function)


def vectorised(function: _F) -> _F:
    """As ``compiled``, for small loops over arrays of floats: they work on several numbers at once.

    For that, sums may be taken in another order than written, though always in the same one for the same lengths; a product may
    be added without being rounded first; and nothing is raised when something is divided by zero. Arrays must be known to lie
    in one piece: those that ``a, b = np.empty((2, n))`` unpacks are not.
    """
    return _kept(numba.njit(nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})(function), function)


def _kept(dispatcher: Any, function: _F) -> _F:
    """The dispatcher, with a place on disk for what it compiles, marked by the sources that it is made from."""
    if hasattr(dispatcher, "enable_caching"):  # a plain function where NUMBA_DISABLE_JIT is set
        try:
            dispatcher._cache = _Cache(function)
        except RuntimeError as error:  # from numba where it finds no folder that can be written to
            if "no locator available" not in str(error):
                raise
            _warn_uncached()
    return cast("_F", dispatcher)


class _Cache(FunctionCache):
    """Numba's, but what cannot be read is compiled, and what cannot be written is not kept: neither stops a program."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        kept: Any = self._cache_file
        if hasattr(kept, "_version"):  # what numba reads first of a file; one with another version counts as empty
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
"""What numba raises where the folder has been removed or write-protected since, the disk is full, or a file is damaged."""


@cache
def _warn_uncached() -> None:
    """Warns, once in a process, that nothing is kept."""
    warnings.warn(
        "No folder to keep compiled functions in is writable, so each process compiles them anew, which takes a minute or two; "
        "set the environment variable NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=2,
    )


@cache
def _top(path: Path) -> Path:
    """Folder of the outermost package that a file is in, or of the file."""
    folder = path.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


@cache
def _sources(folder: Path) -> str:
    """A hash of all files with compiled functions in a folder, and in this one."""
    digest, files = hashlib.sha256(), {*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}
    for text in (path.read_bytes() for path in sorted(files)):
        if b"jit import" in text or b"numba" in text:
            digest.update(text)
    return digest.hexdigest()[:16]


def inlined(function: _F) -> _F:
    """Compile a function into every compiled function that calls it: for small ones that are called very often."""
    return cast("_F", numba.njit(inline="always")(function))


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Code that makes arrays, or the arrays in a tuple, forget who owns them."""
    if isinstance(kind, types.Array):
        view = context.make_array(kind)(context, builder, value)
        null: Any = cgutils.get_null_value
        view.meminfo, view.parent = null(view.meminfo.type), null(view.parent.type)
        return view._getvalue()
    if isinstance(kind, types.BaseTuple):
        for i, part in enumerate(cast("Any", kind).types):
            old = builder.extract_value(value, i)
            value = builder.insert_value(value, _without_owner(context, builder, part, old), i)
    return value


def _borrow(typing_context: Any, value: Any) -> Any:
    """Type and code of ``borrowed``."""
    del typing_context

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _without_owner(context, builder, signature.return_type, arguments[0])

    return value(value), generate


borrowed: Callable[[_T], _T] = cast("Any", intrinsic(_borrow))
"""For compiled code: an array, or a tuple of arrays, without counting references to it; the caller must keep it alive.

Numba counts a reference for each array that is handed to a function, with an atomic operation; in a function that is called
for every imagined state these cost more than the work.
"""
