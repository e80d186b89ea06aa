"""Messages of WitMotion devices: packets of a serial line, and their CAN frames, to values and back.

On a serial line a packet is ``55 TYPE data[8] SUM``, little-endian, the sum that of the ten bytes before it
(WIT standard communication protocol). What belongs to one instant comes in a row, in the order of the types,
with no count and no time. A CAN frame is a packet without its last number and its sum. The host writes
registers of 16 bits, ``FF AA register low high``, on CAN in a frame of the device's identifier.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from devices.vendor_protocols.plausibility import Gate, fault
from firmware_protocol import CanFrame, pack_can_records, unpack_can_records

HEADER = 0x55
SIZE = 11
"""Bytes of a packet."""
IDENTIFIER = 0x50
"""On CAN, as delivered."""
FULL = 32768
RANGE_G, RANGE_DEG_S = 16.0, 2000.0
TIME, ACCELERATION, ANGULAR_RATE, ANGLE, FIELD, QUATERNION, REGISTERS = (
    0x50, 0x51, 0x52, 0x53, 0x54, 0x59, 0x5F,
)  # fmt: skip
_TYPES = frozenset({*range(TIME, 0x5C), REGISTERS})
RATES_HZ: Mapping[int, float] = {
    1: 0.2, 2: 0.5, 3: 1, 4: 2, 5: 5, 6: 10, 7: 20, 8: 50, 9: 100, 11: 200,
}  # fmt: skip
"""By the number that the register has for them."""
BAUDS: Mapping[int, int] = dict(
    enumerate((4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600), start=1)
)
CAN_BAUDS: Mapping[int, int] = dict(enumerate((
    1_000_000, 800_000, 500_000, 400_000, 250_000, 200_000, 125_000, 100_000, 80_000, 50_000, 40_000, 20_000,
    10_000, 5_000, 3_000,
)))  # fmt: skip
"""Likewise on CAN: bit/s by the number that the register has for them."""
UNLOCK, SAVE = (0x69, 0xB588), (0x00, 0x0000)
"""Register and value: before others are written, and to keep them over a loss of power."""


class Register(NamedTuple):
    """A setting of the device."""

    address: int
    least: int
    most: int
    is_writable: bool = True


REGISTERS_BY_NAME: Mapping[str, Register] = {
    "content": Register(0x02, 0, 0x7FF),
    "rate": Register(0x03, min(RATES_HZ), max(RATES_HZ)),
    "baud": Register(0x04, 0, max(CAN_BAUDS)),
    "address": Register(0x1A, 1, 0x7F),
    "bandwidth": Register(0x1F, 0, 6),
    "orientation": Register(0x23, 0, 1),
    "algorithm": Register(0x24, 0, 1),
    "version": Register(0x2E, 0, 0xFFFF, is_writable=False),
}
"""By name: those that matter to a gateway."""
READ_ADDRESS, NUMBER = 0x27, 0x7F
"""Registers: what is to be read, and the first of six of the device's number."""
N_NUMBER = 6

_GATES: Mapping[int, tuple[Gate, ...]] = {
    # what a register of 16 bits can say is within the range of the sensor; a temperature need not be
    ACCELERATION: (Gate("temperature_beyond_sensor", -4000, 12500),),
    TIME: (Gate("no_date", 1, 12),),
}
_UNIT = 0.98, 1.02
"""Of the norm of a quaternion."""


@dataclass(frozen=True, slots=True)
class Inertial:
    """Accelerometer and gyroscope at one instant."""

    specific_force: tuple[float, float, float]  # g
    angular_rate: tuple[float, float, float]  # deg/s
    celsius: float | None = None
    n_incomplete: int = field(default=0, compare=False, repr=False)
    """Instants just before it of which a part came, and not all."""


@dataclass(frozen=True, slots=True)
class Magnetic:
    """Magnetometer at the instant of the last ``Inertial``."""

    field: tuple[float, float, float]
    """In units of the model."""


@dataclass(frozen=True, slots=True)
class Quaternion:
    """Sensor to world, w first, by the filter of the device."""

    orientation: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Values:
    """Registers that were asked for."""

    values: tuple[int, ...]


Message = Inertial | Magnetic | Quaternion | Values


def encode(kind: int, numbers: Sequence[int]) -> bytes:
    """Return a packet for a serial line. numbers: four, of 16 bits."""
    content = struct.pack("<BB4H", HEADER, kind, *(number & 0xFFFF for number in numbers))
    return content + bytes((sum(content) & 0xFF,))


def encode_can(kind: int, numbers: Sequence[int], identifier: int = IDENTIFIER) -> bytes:
    """Return the record of a CAN frame. numbers: three or four, of which it holds three."""
    data = struct.pack("<BB3H", HEADER, kind, *(number & 0xFFFF for number in numbers[:3]))
    return pack_can_records([CanFrame(identifier, data, is_extended=False)])


def encode_write(register: int, value: int) -> bytes:
    """Return what writes a register, for a serial line; on CAN it is the data of a frame."""
    return struct.pack("<BBBH", 0xFF, 0xAA, register, value & 0xFFFF)


def read_writes(data: bytes) -> tuple[list[tuple[int, int]], bytes]:
    """Return registers and values that bytes of a host write, and what is left of them."""
    found, place = [], data.find(b"\xff\xaa")
    while 0 <= place <= len(data) - 5:
        found.append((data[place + 2], int.from_bytes(data[place + 3 : place + 5], "little")))
        place = data.find(b"\xff\xaa", place + 5)
    return found, data[place:] if place >= 0 else data[-1:]


def counts(values: Sequence[float], full_scale: float) -> list[int]:
    """Return numbers of 16 bits, the ends of the range where values are beyond."""
    return [max(-FULL, min(FULL - 1, round(value / full_scale * FULL))) for value in values]


class _Instants:
    """Puts packets of one instant together."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.unused = 0
        """Packets of kinds that nothing is made from: angles, times, pressure, satellites."""
        self._force: tuple[float, float, float] | None = None
        self._celsius: float | None = None
        self._n_incomplete = 0
        self._is_open = False  # the rest of the instant of the last ``Inertial`` may come
        self._has_begun = False  # before, what comes is the rest of an instant that was not heard whole

    def take(self, kind: int, numbers: tuple[int, ...]) -> Message | None:
        """Return what a packet completes. numbers: signed, three (on CAN) or four."""
        if kind == REGISTERS:
            return Values(tuple(number & 0xFFFF for number in numbers))
        if kind == ACCELERATION:
            # An acceleration begins a sample: one that is still open never got its angular rate.
            self._lose(self._force is not None)
            self._has_begun = True
            self._force = _scaled(numbers, RANGE_G)
            self._celsius = numbers[3] / 100 if len(numbers) > 3 else None
            self._is_open = False
        elif kind == ANGULAR_RATE:
            force, self._force = self._force, None
            if force is None:
                # Before the first acceleration nothing is lost: the link was opened in the middle of a
                # sample.
                self._lose(self._has_begun)
                self.unused += not self._has_begun
                self._is_open = False
                return None
            found = Inertial(force, _scaled(numbers, RANGE_DEG_S), self._celsius, self._n_incomplete)
            self._n_incomplete, self._is_open = 0, True
            return found
        elif kind == FIELD and self._is_open:
            x, y, z = map(float, numbers[:3])
            return Magnetic((x, y, z))
        elif kind == QUATERNION and len(numbers) > 3:
            w, x, y, z = (number / FULL for number in numbers)
            if _UNIT[0] <= math.hypot(w, x, y, z) <= _UNIT[1]:
                return Quaternion((w, x, y, z))
            self.dropped["not_a_rotation"] += 1
        else:
            self.unused += 1
        return None

    def _lose(self, is_lost: bool) -> None:
        self._n_incomplete += is_lost
        self.dropped["incomplete"] += is_lost


class WitMotionDecoder(_Instants):
    """The stream of one device on a serial line.

    ``dropped``: bad_checksum, noise (bytes between packets), incomplete (instants without one of their
    packets), and what cannot be: temperature_beyond_sensor, no_date, not_a_rotation.
    """

    def __init__(self) -> None:
        super().__init__()
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete, in order."""
        found: list[Message] = []
        rest, place = self._rest + data, 0
        while True:
            begin = rest.find(HEADER, place)
            self.dropped["noise"] += (len(rest) if begin < 0 else begin) - place
            place = len(rest) if begin < 0 else begin
            if len(rest) < place + 2:
                break
            if rest[place + 1] not in _TYPES:
                self.dropped["noise"] += 1
                place += 1
                continue
            packet = rest[place : place + SIZE]
            if len(packet) < SIZE:
                break
            if sum(packet[:-1]) & 0xFF != packet[-1]:
                # what follows the header may hold another one, which is the true one
                self.dropped["bad_checksum"] += 1
                place += 1
                continue
            place += SIZE
            message = self._read(packet)
            found += [] if message is None else [message]
        self._rest = rest[place:]
        self.dropped += Counter()  # without the zeros
        return found

    def _read(self, packet: bytes) -> Message | None:
        kind, numbers = packet[1], struct.unpack("<4h", packet[2:-1])
        judged = {ACCELERATION: numbers[3:], TIME: packet[3:4]}.get(kind, ())
        why = fault(judged, _GATES.get(kind, ()))
        if why is not None:
            self.dropped[why] += 1
            return None
        return self.take(kind, numbers)


class WitMotionCanDecoder(_Instants):
    """CAN frames of one device. ``dropped``: bad_length, noise (frames that are no packets), incomplete."""

    def __init__(self, identifier: int = IDENTIFIER) -> None:
        super().__init__()
        self._identifier = identifier

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that CAN records complete, in order; other identifiers are passed over."""
        found: list[Message] = []
        for frame in unpack_can_records(data):
            if frame.identifier != self._identifier or frame.is_extended or frame.is_error or frame.is_remote:
                self.unused += 1
            elif len(frame.data) != 8:
                self.dropped["bad_length"] += 1
            elif frame.data[0] != HEADER or frame.data[1] not in _TYPES:
                self.dropped["noise"] += 1
            else:
                message = self.take(frame.data[1], struct.unpack("<3h", frame.data[2:]))
                found += [] if message is None else [message]
        self.dropped += Counter()
        return found


def _scaled(numbers: Sequence[int], full_scale: float) -> tuple[float, float, float]:
    x, y, z = (number * full_scale / FULL for number in numbers[:3])
    return x, y, z
