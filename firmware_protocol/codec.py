"""Bodies of packets, encoded and decoded as their declarations say.

The declarations are worked through once, when the package is imported: for every kind and every
valid mask there is a compiled ``struct`` and a row of readers. Decoding a body is one table lookup,
one ``unpack`` and one call a field.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

from firmware_protocol.elements import Elements, Reader, elements_of, reader, starts
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of
from firmware_protocol.framing import Defect

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
