"""Bytes of a GNSS receiver, NMEA 0183 and UBX in any mixture, to fixes. Sans-I/O; never raises.

The libraries pynmeagps and pyubx2 read the messages; here the stream is cut into them. Used: GGA (position),
GST (its accuracy), RMC (velocity over ground, date), UBX NAV-PVT (all of it). Others are counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from enum import Enum
from typing import Any

from pynmeagps import NMEAReader
from pyubx2 import UBXReader

KNOT = 1852.0 / 3600.0
RANGE_ERROR_M = {4: 0.02, 5: 0.4}
"""m for an HDOP of 1, by GGA quality (RTK fixed, float); any other fix:"""
PLAIN_RANGE_ERROR_M = 2.5
UNKNOWN_SPEED_ERROR = 0.1
"""m/s: of the Doppler speed of receivers that do not say."""
NO_VERTICAL_SPEED = 10.0
"""m/s: NMEA has none; 0 is given with so large a standard deviation."""
LONGEST_NMEA, LONGEST_UBX = 128, 1024
ACCURACY_HOLDS_S = 5.0
_UBX_HEAD = b"\xb5\x62"
_LEAST_FIX_TYPE = 3


class GnssDefect(Enum):
    """Why bytes gave nothing."""

    CHECKSUM = "message with a wrong checksum"
    MALFORMED = "message that cannot be read"
    NOISE = "bytes between messages"
    UNUSED = "message of a kind that is not used"


@dataclass(frozen=True)
class Fix:
    """What one message says. None: not parsed."""

    utc: datetime | None
    quality: int
    """As in GGA: 0 no fix, 1 plain, 2 differential, 4 RTK fixed, 5 RTK float."""
    place: tuple[float, float, float] | None = None
    """Latitude and longitude, degrees; height above the ellipsoid, m."""
    place_sigma: tuple[float, float, float] | None = None  # m east, north, up
    velocity: tuple[float, float, float] | None = None  # m/s east, north, up
    velocity_sigma: tuple[float, float, float] | None = None


class GnssDecoder:
    """One receiver's stream."""

    def __init__(self) -> None:
        self.dropped: Counter[GnssDefect] = Counter()
        self._buffer = b""
        self._date: date | None = None
        self._accuracy: tuple[time, tuple[float, float, float]] | None = None

    def feed(self, data: bytes) -> list[Fix]:
        """Return the fixes that these bytes complete, those that say "no fix" among them."""
        self._buffer += data
        fixes = []
        for message in self._messages():
            try:
                fix = self._ubx(message) if message.startswith(_UBX_HEAD) else self._nmea(message)
            # The library raises many kinds of errors for damaged messages.
            except Exception as error:
                is_sum = "checksum" in str(error)
                self.dropped[GnssDefect.CHECKSUM if is_sum else GnssDefect.MALFORMED] += 1
                continue
            if fix is not None:
                fixes.append(fix)
        return fixes

    def _messages(self) -> Iterator[bytes]:
        """Yield whole messages from the buffer's front, and remove them; an incomplete one stays."""
        while self._buffer:
            # Both protocols may share one line, so the nearest start of either comes first.
            starts = [i for i in (self._buffer.find(b"$"), self._buffer.find(_UBX_HEAD[:1])) if i >= 0]
            start = min(starts, default=len(self._buffer))
            if self._buffer[:start].strip(b"\r\n"):
                self.dropped[GnssDefect.NOISE] += 1
            self._buffer = self._buffer[start:]
            size = _ubx_size(self._buffer) if self._buffer[:1] == _UBX_HEAD[:1] else _nmea_size(self._buffer)
            if size is None:
                return
            if size == 0:  # no message begins here after all
                self.dropped[GnssDefect.NOISE] += 1
                self._buffer = self._buffer[1:]
                continue
            message, self._buffer = self._buffer[:size], self._buffer[size:]
            yield message

    def _nmea(self, message: bytes) -> Fix | None:
        if b"*" not in message:
            raise ValueError("no checksum")
        parsed: Any = NMEAReader.parse(message)
        if parsed.msgID == "GGA":
            return self._gga(parsed)
        if parsed.msgID == "RMC":
            return self._rmc(parsed)
        if parsed.msgID == "GST" and parsed.time and "" not in (parsed.stdLong, parsed.stdLat, parsed.stdAlt):
            self._accuracy = parsed.time, (float(parsed.stdLong), float(parsed.stdLat), float(parsed.stdAlt))
        elif parsed.msgID != "GST":
            self.dropped[GnssDefect.UNUSED] += 1
        return None

    def _gga(self, parsed: Any) -> Fix:
        quality = int(parsed.quality or 0)
        utc = self._utc(parsed.time)
        if not quality or "" in (parsed.lat, parsed.lon, parsed.alt):
            return Fix(utc, 0)
        place = float(parsed.lat), float(parsed.lon), float(parsed.alt) + float(parsed.sep or 0.0)
        return Fix(utc, quality, _checked(place), self._sigma(parsed, quality))

    def _sigma(self, parsed: Any, quality: int) -> tuple[float, float, float]:
        """Return the standard deviations east, north and up of a fix, m.

        They come from a recent GST sentence; without one, from HDOP and the range error that is usual for
        ``quality``.
        """
        if self._accuracy is not None and parsed.time:
            # GST carries the time of day only: the shorter way round midnight is the true difference.
            since = abs(_of_day(parsed.time) - _of_day(self._accuracy[0]))
            if min(since, 86400.0 - since) < ACCURACY_HOLDS_S:
                return self._accuracy[1]
        error = RANGE_ERROR_M.get(quality, PLAIN_RANGE_ERROR_M) * max(float(parsed.HDOP or 2.0), 0.5)
        return error / math.sqrt(2.0), error / math.sqrt(2.0), 1.5 * error

    def _rmc(self, parsed: Any) -> Fix | None:
        if isinstance(parsed.date, date):
            self._date = parsed.date
        if parsed.status != "A" or parsed.spd == "":
            return None
        speed = float(parsed.spd) * KNOT
        course = math.radians(float(parsed.cog or 0.0))
        velocity = speed * math.sin(course), speed * math.cos(course), 0.0
        sigma = UNKNOWN_SPEED_ERROR, UNKNOWN_SPEED_ERROR, NO_VERTICAL_SPEED
        return Fix(self._utc(parsed.time), 1, velocity=velocity, velocity_sigma=sigma)

    def _utc(self, at: time | str) -> datetime | None:
        """Return a time of day with the date of the last RMC sentence; None without a time or before the
        first RMC.
        """
        if self._date is None or not isinstance(at, time):
            return None
        return datetime.combine(self._date, at.replace(tzinfo=UTC))

    def _ubx(self, message: bytes) -> Fix | None:
        parsed: Any = UBXReader.parse(message)
        if parsed.identity != "NAV-PVT":
            self.dropped[GnssDefect.UNUSED] += 1
            return None
        utc = _ubx_time(parsed) if parsed.validDate and parsed.validTime else None
        if not parsed.gnssFixOk or parsed.fixType < _LEAST_FIX_TYPE:
            return Fix(utc, 0)
        return Fix(
            utc,
            {1: 5, 2: 4}.get(parsed.carrSoln, 2 if parsed.diffSoln else 1),
            _checked((parsed.lat, parsed.lon, parsed.height * 1e-3)),
            # In mm: the horizontal one is of both axes together, so each has 1/√2 of it.
            (parsed.hAcc * 7.07e-4, parsed.hAcc * 7.07e-4, parsed.vAcc * 1e-3),
            (parsed.velE * 1e-3, parsed.velN * 1e-3, parsed.velD * -1e-3),
            # In mm/s, of three axes together: each has 1/√3 of it.
            (parsed.sAcc * 5.8e-4,) * 3,
        )


def _ubx_time(parsed: Any) -> datetime:
    whole = datetime(
        parsed.year, parsed.month, parsed.day, parsed.hour, parsed.min, min(parsed.second, 59), tzinfo=UTC
    )
    return datetime.fromtimestamp(whole.timestamp() + parsed.nano * 1e-9, UTC)


def _checked(place: tuple[float, float, float]) -> tuple[float, float, float]:
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0 and abs(place[2]) < 1e5):
        raise ValueError(f"no place on earth: {place}")
    return place


def _of_day(at: time) -> float:
    return at.hour * 3600.0 + at.minute * 60.0 + at.second + at.microsecond * 1e-6


def _ubx_size(data: bytes) -> int | None:
    """Return the size of the UBX message at the front, bytes; None: incomplete, 0: no message begins here."""
    if len(data) < 6:
        return None if _UBX_HEAD.startswith(data[:2]) or data[:2] == _UBX_HEAD else 0
    size = 8 + int.from_bytes(data[4:6], "little")
    if data[:2] != _UBX_HEAD or size > LONGEST_UBX:
        return 0
    return size if len(data) >= size else None


def _nmea_size(data: bytes) -> int | None:
    end = data.find(b"\n", 0, LONGEST_NMEA)
    again = data.find(b"$", 1, LONGEST_NMEA)
    if 0 < again < (end if end >= 0 else LONGEST_NMEA):
        return 0  # a sentence that was cut off by the next one
    if end >= 0:
        return end + 1
    return None if len(data) < LONGEST_NMEA else 0
