"""Structs of arrays and numbers, which compiled functions receive as one pointer.

Numba passes each array of a tuple as its address, size, shape and strides, and generates code that packs, unpacks and counts
references to all of them in every function and at every call. A model of thirty arrays becomes some three hundred arguments;
they take most of the time of compiling and, in small functions, of running. A ``Struct`` is passed as one address; compiled code
reads an array's address and shape where it uses them. Compiled functions that are attributes of the class can be called, too:
the function is chosen by the class when the caller is compiled.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral
from typing import Any, ClassVar, cast, dataclass_transform

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.dispatcher import Dispatcher
from numba.core.typing import templates
from numba.extending import NativeValue, lower_getattr_generic, register_model, unbox
from numba.np import arrayobj

_WORD: Any = ir.IntType(64)


class StructType(types.Type):
    """Type of a struct in compiled code: its class, and the type of each attribute.

    Attributes:
        kind: the class.
        members: type of each attribute.
        places: where each attribute's words begin: the address and shape of an array, the address of a struct, or a number.
    """

    def __init__(self, kind: type, members: tuple[tuple[str, Any], ...]) -> None:
        """See the class."""
        digest = hashlib.sha256(f"{kind.__module__} {members}".encode()).hexdigest()[:8]
        cast("Any", super()).__init__(name=f"{kind.__name__}_{digest}")
        self.kind, self.members = kind, dict(members)
        self.places: dict[str, int] = {}
        place = 0
        for name, member in members:
            self.places[name] = place
            place += 1 + (member.ndim if isinstance(member, types.Array) else 0)

    @property
    def mangling_args(self) -> tuple[str, tuple[()]]:
        """Name and parameters of the type in symbols of compiled code; the default is as long as all attributes' types."""
        return self.name, ()


def is_struct(kind: Any, cls: type) -> bool:
    """Whether a type of compiled code is a class of structs."""
    return isinstance(kind, StructType) and kind.kind is cls


_Wrapper = Callable[[Any], Any]
_model, _getattr, _reads, _unboxes = (
    cast("_Wrapper", decorator)
    for decorator in (
        cast("Any", register_model)(StructType),
        templates.infer_getattr,
        cast("Any", lower_getattr_generic)(StructType),
        cast("Any", unbox)(StructType),
    )
)


@_model
class _Model(models.PrimitiveModel):
    """A struct is a pointer to its words."""

    def __init__(self, manager: Any, kind: Any) -> None:
        cast("Any", super()).__init__(manager, kind, _WORD.as_pointer())


@_getattr
class _Attributes(templates.AttributeTemplate):
    key = StructType

    def generic_resolve(self, kind: Any, attribute: str) -> Any:  # type: ignore[override]  # numba declares no signature
        """Type of an attribute, or of a compiled function of the class; None if there is none."""
        function = getattr(kind.kind, attribute, None)
        return cast("Any", types.Dispatcher)(function) if isinstance(function, Dispatcher) else kind.members.get(attribute)


@_reads
def _read(context: Any, builder: Any, kind: Any, value: Any, attribute: str) -> Any:
    """Code that reads an attribute. The words never change, so they are read only once in a loop."""
    if attribute not in kind.members:
        return context.get_dummy_value()
    member, place = kind.members[attribute], kind.places[attribute]

    def word(i: int) -> Any:
        loaded = builder.load(cast("Any", cgutils).gep_inbounds(builder, value, place + i))
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

    if isinstance(member, StructType):
        return builder.inttoptr(word(0), _WORD.as_pointer())
    if isinstance(member, types.Float):
        return builder.bitcast(word(0), ir.DoubleType())
    if not isinstance(member, types.Array):
        return word(0)
    make_array, populate_array = cast("Any", arrayobj.make_array), cast("Any", arrayobj.populate_array)
    array = make_array(member)(context, builder)
    strides: list[Any] = []
    step = _WORD(context.get_abi_sizeof(context.get_data_type(member.dtype)))
    shape, itemsize = [word(1 + i) for i in range(member.ndim)], step
    for length in reversed(shape):
        strides.insert(0, step)
        step = builder.mul(step, length)
    data = builder.inttoptr(word(0), array.data.type)
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return array._getvalue()


@_unboxes
def _unbox(kind: Any, thing: Any, c: Any) -> Any:
    """Code that takes the pointer from the Python object, which the caller keeps alive."""
    number = c.pyapi.object_getattr_string(thing, "_address")
    address = c.builder.inttoptr(c.pyapi.long_as_longlong(number), _WORD.as_pointer())
    c.pyapi.decref(number)
    return cast("Any", NativeValue)(address)


_TYPES: dict[Any, StructType] = {}
"""All types of structs by class and identities of the attributes' types; equal types are one object, and stay alive."""


@cache
def _array_type(dtype: Any, ndim: int) -> Any:
    return types.Array(numba.from_dtype(dtype), ndim, "C")


def _member(value: Any) -> tuple[Any, list[int]]:
    """Type of an attribute's value in compiled code, and its words; a type of None if no struct can have it."""
    if isinstance(value, np.ndarray):
        return _array_type(value.dtype, value.ndim), [value.__array_interface__["data"][0], *value.shape]
    if isinstance(value, Struct):
        return value._numba_type_, [value._address]
    if isinstance(value, float):
        return types.float64, [int(np.float64(value).view(np.uint64))]
    if isinstance(value, np.uint64):
        return types.uint64, [int(value)]
    if isinstance(value, Integral | np.bool_):
        return types.int64, [int(value) % 2**64]
    return None, []


@dataclass_transform(frozen_default=True)
class Struct:
    """Base of classes whose attributes are contiguous arrays, floats, integers, booleans or other structs.

    A subclass declares attributes like a dataclass; its objects are frozen. The contents of arrays may change. In compiled code,
    booleans are integers.

    Raises:
        TypeError: an attribute's value is none of these.
        ValueError: an array is not contiguous.
    """

    _names: ClassVar[tuple[str, ...]]
    _address: int
    _words: Any
    _numba_type_: Any

    def __init_subclass__(cls) -> None:
        """Makes a dataclass of the subclass."""
        cls._names = tuple(field.name for field in fields(cast("Any", dataclass(frozen=True, eq=False)(cls))))

    def __post_init__(self) -> None:
        """Writes the words that compiled code reads."""
        words: list[int] = []
        kinds = []
        for name in self._names:
            value = getattr(self, name)
            kind, its_words = _member(value)
            if kind is None:
                raise TypeError(
                    f"{type(self).__name__}.{name} has to be an array, a float, an integer or a struct, not {value!r}."
                )
            if isinstance(value, np.ndarray) and not value.flags.c_contiguous:
                raise ValueError(f"{type(self).__name__}.{name} has to be a contiguous array.")
            words += its_words
            kinds.append(kind)
        key = (type(self), *map(id, kinds))
        made = _TYPES.get(key) or _TYPES.setdefault(key, StructType(type(self), tuple(zip(self._names, kinds, strict=True))))
        stored = np.asarray(words, dtype=np.uint64)
        for name, value in (("_words", stored), ("_address", stored.__array_interface__["data"][0]), ("_numba_type_", made)):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies are made of the attributes, since addresses hold only in this process."""
        return type(self), tuple(getattr(self, name) for name in self._names)
