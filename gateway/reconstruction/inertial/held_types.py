"""How compiled code reads what ``held_arguments`` holds: a type with attributes for the compiler."""

# what numba offers for this is untyped
# mypy: disable-error-code="no-untyped-call, untyped-decorator, misc, override"

from __future__ import annotations

import functools
import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import NativeValue, infer_getattr, lower_getattr_generic, models, register_model, unbox
from numba.np.arrayobj import populate_array

_ARRAYS = {"float64": types.float64, "int64": types.int64, "uint8": types.uint8}


class Field(NamedTuple):
    """One entry of the table."""

    name: str
    word: int  # where in the table; of a tuple, where its own entries begin
    type: types.Type
    inner_shape: tuple[int, ...]  # of an array, without its first axis


@functools.cache
def _lowering() -> bytes:
    """This file: the code of a kernel follows from it, but no name in the kernel leads here."""
    return Path(__file__).read_bytes()


class HeldType(types.Type):
    """Numba's side of ``Held``: the layout of its table."""

    def __init__(self, title: str, fields: tuple[Field, ...]) -> None:
        self.fields = fields
        digest = hashlib.sha256(repr(fields).encode() + _lowering()).hexdigest()[:12]
        super().__init__(name=f"Held{title}{digest}")

    def field(self, name: str) -> Field | None:
        """By name; None if there is none."""
        return next((field for field in self.fields if field.name == name), None)


def layout(everything: tuple[Any, ...], words: list[int]) -> HeldType:
    """Appends to the table what ``everything`` needs there; returns how to read it. Raises ``TypeError``."""
    fields = []
    for name, value in everything._asdict().items():  # type: ignore[attr-defined]  # a named tuple
        word, inner_shape = len(words), ()
        if isinstance(value, np.ndarray):
            if value.dtype.name not in _ARRAYS or not (value.flags.c_contiguous and value.flags.writeable):
                raise TypeError(f"{name}: an array of {value.dtype}, laid out otherwise than kernels expect")
            words += [value.ctypes.data, len(value)]
            kind: types.Type = types.Array(_ARRAYS[value.dtype.name], value.ndim, "C")
            inner_shape = value.shape[1:]
        elif isinstance(value, bool):
            words.append(int(value))
            kind = types.boolean
        elif isinstance(value, int):
            words.append(value)
            kind = types.int64
        elif isinstance(value, float):
            words.append(int(np.array(value).view(np.int64)))
            kind = types.float64
        elif isinstance(value, tuple):
            kind = layout(value, words)
        else:
            raise TypeError(f"{name}: a kernel cannot hold a {type(value).__name__}")
        fields.append(Field(name, word, kind, inner_shape))
    return HeldType(type(everything).__name__, tuple(fields))


@register_model(HeldType)
class _Address(models.PrimitiveModel):
    def __init__(self, manager: Any, held: HeldType) -> None:
        super().__init__(manager, held, ir.IntType(64).as_pointer())


@unbox(HeldType)
def _unbox(held: HeldType, instance: Any, context: Any) -> NativeValue:
    address = context.pyapi.object_getattr_string(instance, "address")
    number = context.pyapi.long_as_longlong(address)
    context.pyapi.decref(address)
    return NativeValue(context.builder.inttoptr(number, ir.IntType(64).as_pointer()))


@infer_getattr
class _Fields(AttributeTemplate):
    key = HeldType

    def generic_resolve(self, held: HeldType, name: str) -> types.Type | None:
        field = held.field(name)
        return None if field is None else field.type


@lower_getattr_generic(HeldType)
def _read(context: Any, builder: Any, held: HeldType, table: Any, name: str) -> Any:
    """Tables belong to the outermost tuple; an inner one has the same table, its words counted from there."""
    field = held.field(name)
    assert field is not None  # typing has found it
    if isinstance(field.type, HeldType):
        return table
    if isinstance(field.type, types.Array):
        return _array(context, builder, field, table)
    word = _word(builder, table, field.word)
    if field.type == types.float64:
        return builder.bitcast(word, ir.DoubleType())
    return word if field.type == types.int64 else builder.icmp_signed("!=", word, word.type(0))


def _array(context: Any, builder: Any, field: Field, table: Any) -> Any:
    kind: Any = field.type
    array = context.make_array(kind)(context, builder)
    length = _word(builder, table, field.word + 1)
    shape = [length, *(length.type(n) for n in field.inner_shape)]
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    inner = field.inner_shape
    strides = [length.type(math.prod(inner[axis:]) * size) for axis in range(kind.ndim)]
    address = builder.inttoptr(_word(builder, table, field.word), array.data.type)
    populate_array(array, address, shape, strides, size, None)
    return array._getvalue()


def _word(builder: Any, table: Any, word: int) -> Any:
    """The table never changes: the compiler may keep what it has read."""
    loaded = builder.load(cgutils.gep_inbounds(builder, table, word))
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded
