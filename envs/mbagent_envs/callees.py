"""Compiled functions as other compiled functions call them: code that is optimised only inside its callers.

Numba optimises each function that a compiled function calls, and translates it to machine code, in case Python calls it, too.
Then it optimises and translates the same code again inside the caller, and inside the caller's callers. Here, a function that is
called by compiled code is only lowered to LLVM's language; a function that Python calls is optimised and translated together with
everything that it calls. This saves a quarter to a half of the time of compiling.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
from llvmlite import binding  # type: ignore[import-untyped]
from numba.core import types


class _Unoptimised:
    """A library of LLVM code, with everything that it calls, to link into others; it has numba's methods for this."""

    def __init__(self, library: Any) -> None:
        self._library, self._module = library, None
        self._reload_init: set[Any] = set()
        for other in (library, *library._linking_libraries):
            self._reload_init |= getattr(other, "_reload_init", set())  # unknown to older versions of numba

    def _ensure_finalized(self) -> None:
        """Does nothing: numba would optimise and translate the code."""

    def _get_module_for_linking(self) -> Any:
        """The module, whose functions a caller may have several times."""
        if self._module is None:
            module = self._library._final_module
            for other in dict.fromkeys(self._library._linking_libraries):
                module.link_in(other._get_module_for_linking(), preserve=True)
            for function in module.functions:
                if not function.is_declaration and function.linkage == binding.Linkage.external:
                    function.linkage = "linkonce_odr"
            self._module = module
        return self._module


def link_callees(dispatcher: Any, function: Callable[..., Any], options: dict[str, Any]) -> None:
    """Lets compiled code call a function without machine code of its own.

    Args:
        dispatcher: the compiled function for calls from Python; changed.
        function: the same function, uncompiled.
        options: of numba's compiler.
    """
    made: list[Any] = []
    add = dispatcher.add_overload

    def callee() -> Any:
        if not made:
            made.append(_callee(function, options))
            made[0]._compiling_counter = dispatcher._compiling_counter  # by which numba notices recursion
        return made[0]

    def add_with_environments(compiled: Any) -> None:
        for environment in compiled._find_referenced_environments():  # of the functions that were linked in
            compiled.library.codegen.set_env(environment.env_name, environment)
        add(compiled)

    dispatcher.get_call_template = lambda args, kws: callee().get_call_template(args, kws)
    dispatcher.get_overload = lambda signature: callee().get_overload(signature)
    dispatcher.add_overload = add_with_environments


def _callee(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """A function for calls from compiled code.

    Numba would compile it again for each constant passed to it, and for the first value of a loop's variable; here, constants
    count as any other value.
    """
    callee = cast("Any", numba.njit)(**options, no_cpython_wrapper=True)(function)

    def without_machine_code(flags: Any) -> Any:
        flags.no_compile = True
        return flags

    def add(compiled: Any) -> None:
        key = object()  # numba finds a function's code by its address, which this one does not have
        callee.targetctx.insert_user_function(key, compiled.fndesc, [_Unoptimised(compiled.library)])
        callee.overloads[tuple(compiled.signature.args)] = compiled._replace(entry_point=key)

    resolve, plain = callee.get_call_template, cast("Any", types.unliteral)
    callee.get_call_template = lambda args, kws: resolve(
        [plain(kind) for kind in args], {name: plain(kind) for name, kind in kws.items()}
    )
    callee._compiler._customize_flags, callee.add_overload = without_machine_code, add
    return callee
