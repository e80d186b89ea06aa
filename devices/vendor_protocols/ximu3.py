"""Data messages of the x-IMU3 (x-io Technologies), binary and ASCII, to values and back.

A message ends with LF. The binary ones begin with 0x80 + the letter of their kind, then a u64 of microseconds
and float32 values, little-endian, with LF and ESC inside replaced as in SLIP; the ASCII ones are
``letter,microseconds,values``. There is no checksum: a message is believed for its length and for values that
the device can measure (user manual v0.11, sections on data messages).
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

LF, ESCAPE = b"\n", b"\xdb"
_STUFFED = {ESCAPE: b"\xdb\xdd", LF: b"\xdb\xdc"}  # in this order, when stuffing
LONGEST = 4096
"""Bytes of one message; the device has no longer ones."""
_MOST_RATE, _MOST_FORCE, _MOST_FIELD = 2100.0, 25.0, 100.0
"""deg/s, g and calibration fields: beyond the ranges of its sensors, 2000 deg/s and 24 g, nothing is real."""
_PLAIN = b"T", b"B", b"W", b"Q", b"R", b"A", b"L", b"E", b"H", b"U", b"S", b"Y", b"C", b"O", b"N", b"F"


@dataclass(frozen=True, slots=True)
class Inertial:
    """One sample of gyroscope and accelerometer."""

    time_us: int
    angular_rate: tuple[float, float, float]  # deg/s
    specific_force: tuple[float, float, float]  # g


@dataclass(frozen=True, slots=True)
class Magnetic:
    """One sample of the magnetometer."""

    time_us: int
    field: tuple[float, float, float]  # of the field at its calibration


Message = Inertial | Magnetic


def encode_binary(letter: bytes, time_us: int, values: Sequence[float]) -> bytes:
    """Return a binary data message, with its LF."""
    content = bytes((0x80 | letter[0],)) + struct.pack(f"<Q{len(values)}f", time_us, *values)
    for byte, instead in _STUFFED.items():
        content = content.replace(byte, instead)
    return content + LF


def encode_text(letter: bytes, time_us: int, values: Sequence[float]) -> bytes:
    """Return an ASCII data message, with its CR and LF."""
    return b"%s,%d,%s\r\n" % (letter, time_us, ",".join(f"{value:.4f}" for value in values).encode())


class Ximu3Decoder:
    """The stream of one device."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """bad_length, bad_number, implausible, bad_stuffing, too_long, unknown_kind."""
        self.unused = 0
        """Messages of kinds that no reading is made from."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Return the samples that these bytes complete, in order."""
        *complete, self._rest = (self._rest + data).split(LF)
        if len(self._rest) > LONGEST:
            self.dropped["too_long"] += 1
            self._rest = b""
        found = []
        for message in complete:
            read = self._read(message) if message.strip() else None
            if read is not None:
                found.append(read)
        return found

    def _read(self, message: bytes) -> Message | None:
        first = message[:1]
        is_binary = first[0] >= 0x80
        letter = bytes((first[0] & 0x7F,))
        if letter in _SIZES:
            numbers = self._binary(message, letter) if is_binary else self._text(message, letter)
            return None if numbers is None else self._judged(letter, *numbers)
        if letter in _PLAIN or first in (b"{", b"^"):
            self.unused += 1
        else:
            self.dropped["unknown_kind"] += 1
        return None

    def _binary(self, message: bytes, letter: bytes) -> tuple[int, tuple[float, ...]] | None:
        content = message
        for byte, instead in reversed(_STUFFED.items()):
            content = content.replace(instead, byte)
        if message.count(ESCAPE) != message.count(b"\xdb\xdc") + message.count(b"\xdb\xdd"):
            self.dropped["bad_stuffing"] += 1
            return None
        if len(content) != 9 + 4 * _SIZES[letter]:
            self.dropped["bad_length"] += 1
            return None
        time_us, *values = struct.unpack(f"<Q{_SIZES[letter]}f", content[1:])
        return time_us, tuple(values)

    def _text(self, message: bytes, letter: bytes) -> tuple[int, tuple[float, ...]] | None:
        _, *words = message.rstrip(b"\r").split(b",")
        if len(words) != 1 + _SIZES[letter]:
            self.dropped["bad_length"] += 1
            return None
        try:
            return int(words[0]), tuple(map(float, words[1:]))
        except ValueError:
            self.dropped["bad_number"] += 1
            return None

    def _judged(self, letter: bytes, time_us: int, values: tuple[float, ...]) -> Message | None:
        limits = (_MOST_RATE,) * 3 + (_MOST_FORCE,) * 3 if letter == b"I" else (_MOST_FIELD,) * 3
        is_real = all(math.isfinite(v) and abs(v) <= most for v, most in zip(values, limits, strict=True))
        if not is_real or not 0 <= time_us < 2**63:
            self.dropped["implausible"] += 1
            return None
        x, y, z, *more = values
        if letter == b"M":
            return Magnetic(time_us, (x, y, z))
        return Inertial(time_us, (x, y, z), (more[0], more[1], more[2]))


_SIZES = {b"I": 6, b"M": 3}
"""Numbers after the stamp."""
