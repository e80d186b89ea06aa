"""Bodies of packets, encoded and decoded as their declarations say.

The declarations are worked through once, when the package is imported: for every kind and every
valid mask there is a compiled ``struct`` and a row of readers. Decoding a body is one table lookup,
one ``unpack`` and one call a field.
"""

from __future__ import annotations

import operator
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import Any, Generic, TypeVar

from firmware_protocol.fields import INTEGER_RANGE, LARGEST_FLOAT32, WireField, layout_of
from firmware_protocol.framing import Defect

P = TypeVar("P")

_BEYOND_ANY_CODE = 2.0**40
"""Larger than any element, small enough to be rounded: a huge value over a small step is infinite."""

Elements = tuple[Any, ...]
Reader = Callable[[Elements], Any]


@dataclass(frozen=True, slots=True)
class _MaskedLayout:
    """Everything needed to read a body with one particular mask."""

    size: int
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
        """The packet, or why the body is none. Never raises."""
        if self._has_mask and not body:
            return Defect.BAD_LENGTH
        layout = self._by_mask.get(body[0] if self._has_mask else 0)
        if layout is None:
            return Defect.BAD_VALUE
        if len(body) != layout.size:
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
        """The body. Raises ValueError, naming the field, when a value cannot be sent."""
        mask = 0
        elements: list[Any] = []
        clipped: set[str] = set()
        for declared in self._layout.fields:
            value = getattr(packet, declared.name)
            if declared.presence_bit is not None:
                if value is None:
                    continue
                mask |= 1 << declared.presence_bit
            elements += self._elements(declared, value, clipped)
        mask |= self._flag_bits(packet, mask, clipped)
        if self._has_mask:
            elements.insert(0, mask)
        return struct.pack(self._layout.struct_format(mask), *elements)

    def _flag_bits(self, packet: P, mask: int, clipped: set[str]) -> int:
        bits = sum(1 << f.bit for f in self._layout.flags if getattr(packet, f.name) or f.clips in clipped)
        if self._has_mask and mask | bits not in self._by_mask:
            raise ValueError(f"{packet}: a field that is absent cannot be clipped")
        return bits

    def _elements(self, declared: WireField, value: Any, clipped: set[str]) -> Sequence[Any]:
        """The numbers that stand for a value on the wire; adds the field to ``clipped`` if it saturates."""
        saturates = any(f.clips == declared.name for f in self._layout.flags)
        try:
            elements = _quantise(declared, value, saturates)
        except (ValueError, TypeError, OverflowError) as error:
            where = f"{self._packet_class.__name__}.{declared.name}"
            raise ValueError(f"{where} = {value!r} cannot be sent: {error}") from None
        if saturates:
            limit = INTEGER_RANGE[declared.code][1]
            if any(abs(element) > limit for element in elements):
                clipped.add(declared.name)
                return [max(-limit, min(limit, element)) for element in elements]
        return elements

    def _compile(self, mask: int) -> _MaskedLayout:
        names = [f.name for f in fields(self._packet_class)]  # type: ignore[arg-type]
        present = self._layout.present(mask)
        flags = {f.name: bool(mask >> f.bit & 1) for f in self._layout.flags}
        compiled = struct.Struct(self._layout.struct_format(mask))
        return _MaskedLayout(
            size=compiled.size,
            unpack=compiled.unpack,
            template=tuple(flags.get(name) for name in names),
            readers=tuple(
                (names.index(declared.name), _reader(declared, start))
                for declared, start in zip(present, self._starts(present), strict=False)
            ),
            restricted=tuple((names.index(f.name), f) for f in present if f.is_restricted),
        )

    def _starts(self, present: Sequence[WireField]) -> Iterator[int]:
        """Index of each field's first element among the unpacked ones."""
        sizes = (1 if f.code == "s" else f.count for f in present)
        return accumulate(sizes, initial=1 if self._has_mask else 0)


def _quantise(declared: WireField, value: Any, saturates: bool) -> Sequence[Any]:
    """The elements of a value, in the range of their layout code unless the field ``saturates``."""
    if declared.code == "s":
        if not isinstance(value, bytes) or len(value) != declared.count:
            raise ValueError(f"expected {declared.count} bytes")
        return [value]
    if value is None and declared.absent is not None:
        return [declared.absent] * declared.count
    components = [value] if declared.count == 1 else list(value)
    if len(components) != declared.count:
        raise ValueError(f"expected {declared.count} numbers")
    if not declared.accepts(components if declared.count > 1 else value):
        raise ValueError("not finite, or not among the values that the field allows")
    if declared.code == "f":
        if any(abs(x) > LARGEST_FLOAT32 for x in components):
            raise ValueError("too large for a 32-bit float")
        return components
    elements = [_nearest(x, declared.scale) for x in components]
    low, high = INTEGER_RANGE[declared.code]
    if not saturates and any(
        not low <= element <= high or element == declared.absent for element in elements
    ):
        raise ValueError(f"outside the range of {declared.type_name}")
    return elements


def _nearest(value: Any, scale: float | None) -> int:
    if scale is None:
        return operator.index(value)
    return round(max(-_BEYOND_ANY_CODE, min(_BEYOND_ANY_CODE, float(value) / scale)))


def _reader(declared: WireField, start: int) -> Reader:
    scale, absent = declared.scale, declared.absent
    if absent is not None and declared.count == 1:
        factor = 1 if scale is None else scale
        return lambda elements: None if elements[start] == absent else elements[start] * factor
    if scale is None:
        if declared.count == 1 or declared.code == "s":
            return operator.itemgetter(start)
        return operator.itemgetter(slice(start, start + declared.count))
    if declared.count == 3:
        second, third = start + 1, start + 2
        return lambda elements: (elements[start] * scale, elements[second] * scale, elements[third] * scale)
    if declared.count == 1:
        return lambda elements: elements[start] * scale
    raise ValueError(f"{declared.name}: no reader for {declared.count} scaled elements")
