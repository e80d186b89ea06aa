"""Settings in two slots of flash, of which a loss of power at any instant spares one.

A slot, all integers little-endian::

    [magic:4] [generation:4] [length:2] [reserved:2] ([key:1] [size:1] [value:size])* [crc32:4]

``length`` is that of the settings; ``crc32`` covers all before it. A slot counts only when magic and
checksum are right. A commit erases the slot that is not in use, programs everything after the magic,
and the magic last: until its last bit is programmed, the slot in use is the other one. The newest
generation wins, by serial-number arithmetic, so that the count may wrap.

Where a loss of power spoils an erasure, bytes of the old generation may be left standing; only its
checksum speaks against them, so such a slot passes for a good one with a probability of 2^-32.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol
from zlib import crc32

from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value, factory_settings
from firmware_protocol.fields import BYTE_ORDER, WireField

SLOT_MAGIC = 0x4D475331  # "MGS1"
SLOTS = (0, 1)
SLOT_SIZE = 2048
"""Bytes of a slot: one page of flash that can be erased by itself."""

SLOT_FIELDS = (
    WireField(name="magic", code="I", sentence=f"{SLOT_MAGIC:#x}; programmed last."),
    WireField(name="generation", code="I", sentence="Counts commits, wraps to 0; the newest slot is used."),
    WireField(name="length", code="H", unit="bytes", sentence="Of the settings that follow."),
    WireField(name="reserved", code="H", sentence="0."),
)
"""What comes first in a slot."""

ENTRY_FIELDS = (
    WireField(name="key", code="B", sentence="Which setting."),
    WireField(name="size", code="B", unit="bytes", sentence="Of the value that follows."),
)
"""What comes before each value."""

_HEAD = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in SLOT_FIELDS))
_ENTRY = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in ENTRY_FIELDS))
_CHECKSUM = struct.Struct(BYTE_ORDER + "I")
_MAGIC_SIZE = SLOT_FIELDS[0].size
_GENERATIONS = 2**32


class Flash(Protocol):
    """Memory that is erased by slots, to all ones, and in which programming only clears bits."""

    def read(self, address: int, n: int) -> bytes:
        """Return ``n`` bytes from ``address``."""
        ...

    def erase(self, slot: int) -> None:
        """Set every bit of a slot."""
        ...

    def program(self, address: int, data: bytes) -> None:
        """Clear the bits that are 0 in ``data``."""
        ...


class FlashError(Exception):
    """The flash did not keep what was programmed. The settings in use are those before the commit."""


class Slot(NamedTuple):
    """What a good slot holds."""

    generation: int
    settings: dict[int, bytes]
    """Values by key, undecoded."""


class SlotStore:
    """The settings in a flash: slot 0 at address 0, slot 1 at ``slot_size``."""

    def __init__(self, flash: Flash, slot_size: int = SLOT_SIZE) -> None:
        self._flash = flash
        self._slot_size = slot_size

    @property
    def generation(self) -> int | None:
        """Generation of the settings in use; None while they are those of the factory."""
        current = self._current()
        return None if current is None else current[1].generation

    def load(self) -> dict[int, Any]:
        """Return every setting by key: as committed last, else the factory value. Never raises for what it
        reads.

        A committed value that this firmware does not know or allow gives way to the factory value.
        """
        settings = factory_settings()
        current = self._current()
        if current is not None:
            for key, data in current[1].settings.items():
                value = decode_value(key, data)
                if value is not None:
                    settings[key] = value
        return settings

    def commit(self, settings: Mapping[int, Any]) -> int:
        """Make these settings the ones in use, all or nothing; those left out get their factory value.

        Returns the new generation. Raises ValueError for a value outside its limits or settings that do
        not fit a slot, FlashError when the flash reads back otherwise.
        """
        current = self._current()
        # Always the slot that is not in use: the other one survives whatever happens now.
        slot, generation = (0, 1) if current is None else (1 - current[0], current[1].generation + 1)
        generation %= _GENERATIONS
        image = encode_slot(generation, settings)
        if len(image) > self._slot_size:
            raise ValueError(f"settings of {len(image)} bytes: a slot holds {self._slot_size}")
        start = slot * self._slot_size
        self._flash.erase(slot)
        # The magic last: until it stands, a loss of power leaves the slot invalid and the old one in use.
        self._flash.program(start + _MAGIC_SIZE, image[_MAGIC_SIZE:])
        if self._flash.read(start + _MAGIC_SIZE, len(image) - _MAGIC_SIZE) != image[_MAGIC_SIZE:]:
            raise FlashError(f"slot {slot} reads back otherwise than programmed; the other one stays in use")
        self._flash.program(start, image[:_MAGIC_SIZE])
        if self._flash.read(start, len(image)) != image:
            raise FlashError(f"the magic of slot {slot} did not take; the other one stays in use")
        return generation

    def _current(self) -> tuple[int, Slot] | None:
        """Return the slot in use and what it holds; None when neither is good."""
        read = [self._flash.read(slot * self._slot_size, self._slot_size) for slot in SLOTS]
        # One that was cut off while it was written fails its magic or its checksum, and is no slot.
        good = [(slot, found) for slot in SLOTS if (found := decode_slot(read[slot])) is not None]
        if len(good) < len(SLOTS):
            return good[0] if good else None
        return good[1] if is_newer(good[1][1].generation, good[0][1].generation) else good[0]


def is_newer(generation: int, other: int) -> bool:
    """Return whether a generation comes after another, in serial-number arithmetic modulo 2^32 (RFC 1982)."""
    return 0 < (generation - other) % _GENERATIONS < _GENERATIONS // 2


def encode_slot(generation: int, settings: Mapping[int, Any]) -> bytes:
    """Return the image of a slot, magic included. Raises ValueError for a value outside its limits."""
    entries = b""
    # Sorted, so that the same settings give the same bytes, whoever changed them in which order.
    for key in sorted(settings):
        value = encode_value(key, settings[key])
        entries += _ENTRY.pack(key, len(value)) + value
    content = _HEAD.pack(SLOT_MAGIC, generation, len(entries), 0) + entries
    return content + _CHECKSUM.pack(crc32(content))


def decode_slot(image: bytes) -> Slot | None:
    """Return what a slot holds; None when it is erased, unfinished or spoilt. Never raises."""
    if len(image) < _HEAD.size + _CHECKSUM.size:
        return None
    magic, generation, length, _ = _HEAD.unpack_from(image)
    end = _HEAD.size + length
    if magic != SLOT_MAGIC or end + _CHECKSUM.size > len(image):
        return None
    if _CHECKSUM.unpack_from(image, end)[0] != crc32(image[:end]):
        return None
    settings: dict[int, bytes] = {}
    at = _HEAD.size
    while at + _ENTRY.size <= end:
        key, size = _ENTRY.unpack_from(image, at)
        at += _ENTRY.size
        if at + size > end:
            break  # a checksum-valid slot that was written wrong: the entry is no value
        settings[key] = image[at : at + size]
        at += size
    return Slot(generation, settings)


MAX_IMAGE_SIZE = (
    _HEAD.size + sum(_ENTRY.size + setting.value.size for setting in SETTINGS.values()) + _CHECKSUM.size
)
"""Bytes of a slot with every setting."""
