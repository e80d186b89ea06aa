"""Reports of a BNO080/BNO085 in its UART-RVC mode: heading, pitch and roll, and acceleration, 100 a second.

``AA AA index yaw pitch roll x y z reserved[3] sum``, little-endian, in 0.01° and milli-g, the sum that of all
bytes between (BNO08X data sheet). The turn is about z by yaw, then y by pitch, then x by roll.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

from devices.vendor_protocols.plausibility import either_way, fault

HEADER = b"\xaa\xaa"
SIZE = 19
RATE_HZ = 100.0
COUNT_BITS = 8
_LAYOUT = struct.Struct("<2sB6h3xB")
_GATES = (
    either_way("no_angle", 18_000), either_way("no_angle", 9_000), either_way("no_angle", 18_000),
    *[either_way("force_beyond_sensor", 9_000)] * 3,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Report:
    """One report."""

    index: int
    angles: tuple[float, float, float]  # yaw, pitch, roll, degrees
    acceleration: tuple[float, float, float]  # g, gravity in it


def encode(report: Report) -> bytes:
    """Return the bytes of a report."""
    numbers = (
        *(round(100 * each) for each in report.angles),
        *(round(1000 * a) for a in report.acceleration),
    )
    data = _LAYOUT.pack(HEADER, report.index & 0xFF, *(max(-(2**15), min(n, 2**15 - 1)) for n in numbers), 0)
    return data[:-1] + bytes((sum(data[2:]) & 0xFF,))


class Bno08xDecoder:
    """The stream of one device. ``dropped``: bad_checksum, noise, no_angle, force_beyond_sensor."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.unused = 0
        """There are no others."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Report]:
        """Return the reports that these bytes complete, in order."""
        found, rest = [], self._rest + data
        while len(rest) >= len(HEADER):
            begin = rest.find(HEADER)
            if begin < 0:
                begin = len(rest) - 1  # the last byte may begin one
            if begin:
                self.dropped["noise"] += begin
                rest = rest[begin:]
                continue
            if len(rest) < SIZE:
                break
            if sum(rest[2 : SIZE - 1]) & 0xFF != rest[SIZE - 1]:
                # what follows may hold another one, which is the true one
                self.dropped["bad_checksum"] += 1
                rest = rest[1:]
                continue
            _, index, *numbers, _ = _LAYOUT.unpack(rest[:SIZE])
            rest = rest[SIZE:]
            why = fault(numbers, _GATES)
            if why is None:
                yaw, pitch, roll, x, y, z = numbers
                angles = (yaw / 100, pitch / 100, roll / 100)
                found.append(Report(index, angles, (x / 1000, y / 1000, z / 1000)))
            else:
                self.dropped[why] += 1
        self._rest = rest
        return found
