"""Values to bytes and back, as the declarations say: one field, several fields, the body of a packet.

A field's value becomes *elements*, the numbers that stand for it on the wire. ``FieldsCodec`` is for
fields one after another; ``BodyCodec`` for the body of a packet, whose mask says what is there.

The declarations are worked through once, when the package is imported: for every kind and every
valid mask there is a compiled ``struct`` and a row of readers. Decoding a body is one table lookup,
one ``unpack`` and one call a field.
"""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import Any, Generic, TypeVar

from firmware_protocol.fields import (
    BYTE_ORDER,
    INTEGER_RANGE,
    LARGEST_FLOAT32,
    MAX_REST_SIZE,
    WireField,
    layout_of,
)
from firmware_protocol.framing import Defect

Elements = tuple[Any, ...]
Reader = Callable[[Elements], Any]

_BEYOND_ANY_CODE = 2.0**40
"""Larger than any scaled element, small enough to be rounded: a huge value over a small step is infinite."""


def elements_of(declared: WireField, value: Any, saturates: bool = False) -> Sequence[Any]:
    """Return the elements of a value, in the range of their layout code unless the field ``saturates``.

    Raises ValueError, TypeError or OverflowError when the value cannot be sent.
    """
    if declared.code == "s":
        return [_bytes_of(declared, value)]
    if value is None and declared.absent is not None:
        return [declared.absent] * declared.count
    components = [value] if declared.count == 1 else list(value)
    if len(components) != declared.count:
        raise ValueError(f"expected {declared.count} numbers")
    if declared.scale is None:
        sent = components
        elements = components if declared.code == "f" else [operator.index(x) for x in components]
    else:
        # What will be sent is checked, not what was given: rounding may leave the allowed range.
        elements = [_nearest(x, declared.scale) for x in components]
        sent = [element * declared.scale for element in elements]
    if not declared.accepts(sent if declared.count > 1 else sent[0]):
        raise ValueError("not finite, or not among the values that the field allows")
    if declared.code == "f":
        if any(abs(x) > LARGEST_FLOAT32 for x in components):
            raise ValueError("too large for a 32-bit float")
        return components
    low, high = INTEGER_RANGE[declared.code]
    # The code for "absent" must not be sent as a number.
    if not saturates and any(
        not low <= element <= high or element == declared.absent for element in elements
    ):
        raise ValueError(f"outside the range of {declared.type_name}")
    return elements


def reader(declared: WireField, start: int) -> Reader:
    """Return what makes the field's value of all unpacked elements, of which its own begin at ``start``.

    A reader never raises; it gives None for text that is none.
    """
    if declared.is_text:
        return lambda elements: _text(elements[start], declared)
    if declared.count == 1 or declared.code == "s":
        return _single_reader(declared, start)
    scale, stop = declared.scale, start + declared.count
    if scale is None:
        return operator.itemgetter(slice(start, stop))
    # Vectors are most of the traffic: written out they are scaled without a loop.
    if declared.count == 3:
        second, third = start + 1, start + 2
        return lambda elements: (elements[start] * scale, elements[second] * scale, elements[third] * scale)
    return lambda elements: tuple([element * scale for element in elements[start:stop]])


def _single_reader(declared: WireField, start: int) -> Reader:
    scale, absent = declared.scale, declared.absent
    if absent is not None:
        factor = 1 if scale is None else scale
        return lambda elements: None if elements[start] == absent else elements[start] * factor
    if scale is None:
        return operator.itemgetter(start)
    return lambda elements: elements[start] * scale


def starts(declared: Sequence[WireField], first: int = 0) -> list[int]:
    """Return index of each field's first element among the unpacked ones."""
    sizes = (1 if f.code == "s" else f.count for f in declared)
    return list(accumulate(sizes, initial=first))[:-1]


class FieldsCodec:
    """Encoder and decoder of fields one after another, without a mask."""

    def __init__(self, declared: Sequence[WireField]) -> None:
        self._declared = tuple(declared)
        self._struct = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in declared))
        self._readers = [reader(f, start) for f, start in zip(declared, starts(declared), strict=True)]
        self._rest = declared[-1] if declared and declared[-1].is_rest else None
        self.fixed_size = self._struct.size
        """Bytes before the field that goes to the end; of all, when there is none."""

    def encode(self, *values: Any) -> bytes:
        """Return the bytes of the values, one a field. Raises ValueError, naming the field, for a bad one."""
        names = [f.name for f in self._declared]
        if len(values) != len(names):
            raise ValueError(f"{len(values)} values given; there are {len(names)}: {', '.join(names)}")
        elements: list[Any] = []
        for declared, value in zip(self._declared, values, strict=True):
            try:
                elements += elements_of(declared, value)
            except (ValueError, TypeError, OverflowError) as error:
                raise ValueError(f"{declared.name} = {value!r} cannot be sent: {error}") from None
        rest = elements.pop() if self._rest else b""
        return self._struct.pack(*elements) + rest

    def decode(self, data: bytes) -> tuple[Any, ...] | None:
        """Return the values, or None when the bytes hold none of them. Never raises."""
        if len(data) < self.fixed_size:
            return None
        elements: Elements = self._struct.unpack_from(data)
        rest = data[self.fixed_size :]
        if self._rest is not None:
            if not is_size_allowed(self._rest, len(rest)):
                return None
            elements += (rest,)
        elif rest:
            return None
        values = tuple([read(elements) for read in self._readers])
        is_good = all(f.accepts(value) for f, value in zip(self._declared, values, strict=True))
        return values if is_good else None


def is_size_allowed(rest: WireField, size: int) -> bool:
    """Return whether a field that goes to the end of the body may hold so many bytes."""
    largest = MAX_REST_SIZE if rest.max_size is None else rest.max_size
    return rest.min_size <= size <= largest


def _bytes_of(declared: WireField, value: Any) -> bytes:
    data = value.encode() if declared.is_text and isinstance(value, str) else value
    if not isinstance(data, bytes) or (declared.is_text and data is value):
        raise TypeError("expected text" if declared.is_text else "expected bytes")
    if declared.is_text and 0 in data:
        raise ValueError("text holds no zero")
    if declared.is_rest:
        if not is_size_allowed(declared, len(data)):
            raise ValueError(f"{len(data)} bytes; there may be {declared.min_size} to {declared.max_size}")
        return data
    if declared.is_text:
        if len(data) > declared.count:
            raise ValueError(f"expected at most {declared.count} bytes of UTF-8")
        return data.ljust(declared.count, b"\x00")
    if len(data) != declared.count:
        raise ValueError(f"expected {declared.count} bytes")
    return data


def _text(data: bytes, declared: WireField) -> str | None:
    # Of fixed size, text is filled up with zeros; one inside it would cut it off in C.
    text = data if declared.is_rest else data.rstrip(b"\x00")
    if 0 in text:
        return None
    try:
        return text.decode()
    except UnicodeDecodeError:
        return None


def _nearest(value: Any, scale: float) -> int:
    if not math.isfinite(value):
        raise ValueError("not finite")
    return round(max(-_BEYOND_ANY_CODE, min(_BEYOND_ANY_CODE, float(value) / scale)))


P = TypeVar("P")


@dataclass(frozen=True, slots=True)
class _MaskedLayout:
    """Everything needed to read a body with one particular mask."""

    min_size: int
    max_size: int
    unpack: Callable[[bytes], Elements]
    template: tuple[Any, ...]
    """Attributes of the packet in order: flags as the mask says, None in the place of all else."""
    readers: tuple[tuple[int, Reader], ...]
    """Position of each field that is present among the attributes, and what reads its value."""
    restricted: tuple[tuple[int, WireField], ...]
    """Attributes whose values must be looked at, with their positions."""


class BodyCodec(Generic[P]):
    """Encoder and decoder of one kind of body, derived from its declaration."""

    def __init__(self, packet_class: type[P]) -> None:
        self._packet_class = packet_class
        self._layout = layout_of(packet_class)
        self._has_mask = self._layout.has_mask
        self._by_mask = {mask: self._compile(mask) for mask in self._layout.valid_masks()}

    def decode(self, body: bytes) -> P | Defect:
        """Return the packet, or why the body is none. Never raises."""
        # Without a mask there is no layout to look up: too short, and not of an unknown mask.
        if self._has_mask and not body:
            return Defect.BAD_LENGTH
        layout = self._by_mask.get(body[0] if self._has_mask else 0)
        if layout is None:
            return Defect.BAD_VALUE
        if not layout.min_size <= len(body) <= layout.max_size:
            return Defect.BAD_LENGTH
        elements = layout.unpack(body)
        values = list(layout.template)
        for position, read in layout.readers:
            values[position] = read(elements)
        for position, declared in layout.restricted:
            if not declared.accepts(values[position]):
                return Defect.BAD_VALUE
        return self._packet_class(*values)

    def encode(self, packet: P) -> bytes:
        """Return the body. Raises ValueError, naming the field, when a value cannot be sent."""
        mask = 0
        elements: list[Any] = []
        clipped: set[str] = set()
        for declared in self._layout.fields:
            value = getattr(packet, declared.name)
            if declared.presence_bit is not None:
                if value is None:
                    # What is absent has its bit 0 and takes no bytes.
                    continue
                mask |= 1 << declared.presence_bit
            elements += self._elements(declared, value, clipped)
        mask |= self._flag_bits(packet, mask, clipped)
        if self._has_mask:
            elements.insert(0, mask)
        # A field of any size comes last, and is no element of the struct.
        rest = elements.pop() if self._layout.rest else b""
        return struct.pack(self._layout.struct_format(mask), *elements) + rest

    def _flag_bits(self, packet: P, mask: int, clipped: set[str]) -> int:
        bits = sum(1 << f.bit for f in self._layout.flags if getattr(packet, f.name) or f.clips in clipped)
        if self._has_mask and mask | bits not in self._by_mask:
            raise ValueError(f"{packet}: a field that is absent cannot be clipped")
        return bits

    def _elements(self, declared: WireField, value: Any, clipped: set[str]) -> Sequence[Any]:
        """Return the numbers that stand for a value on the wire; adds the field to ``clipped`` if it
        saturates."""
        saturates = any(f.clips == declared.name for f in self._layout.flags)
        try:
            elements = elements_of(declared, value, saturates)
        except (ValueError, TypeError, OverflowError) as error:
            where = f"{self._packet_class.__name__}.{declared.name}"
            raise ValueError(f"{where} = {value!r} cannot be sent: {error}") from None
        if saturates:
            limit = INTEGER_RANGE[declared.code][1]
            # Such a value is sent as the largest there is, with its flag, so that it is known to be wrong.
            if any(abs(element) > limit for element in elements):
                clipped.add(declared.name)
                return [max(-limit, min(limit, element)) for element in elements]
        return elements

    def _compile(self, mask: int) -> _MaskedLayout:
        names = [f.name for f in fields(self._packet_class)]  # type: ignore[arg-type]
        present = self._layout.present(mask)
        flags = {f.name: bool(mask >> f.bit & 1) for f in self._layout.flags}
        first = 1 if self._has_mask else 0
        min_size, max_size = self._layout.sizes(mask)
        return _MaskedLayout(
            min_size=min_size,
            max_size=max_size,
            unpack=self._unpacker(mask),
            template=tuple(flags.get(name) for name in names),
            readers=tuple(
                (names.index(declared.name), reader(declared, start))
                for declared, start in zip(present, starts(present, first), strict=True)
            ),
            restricted=tuple((names.index(f.name), f) for f in present if f.is_restricted),
        )

    def _unpacker(self, mask: int) -> Callable[[bytes], Elements]:
        compiled = struct.Struct(self._layout.struct_format(mask))
        if self._layout.rest is None:
            return compiled.unpack
        unpack_from, size = compiled.unpack_from, compiled.size
        return lambda body: (*unpack_from(body), body[size:])
