"""An emulated GNSS receiver: where a point of a moving body is, as NMEA 0183 or UBX. Sans-I/O."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from pynmeagps import GET, NMEAMessage
from pyubx2 import UBXMessage

from devices.emulators.bodies import FloatArray
from devices.emulators.delivery import Transmission
from devices.geodesy import LocalPlane, geodetic

KNOT = 1852.0 / 3600.0
SEPARATION_M = 47.0
"""Of the geoid above the ellipsoid, as the receiver says it."""
FORMATS = ("nmea", "ubx")

Path = Callable[[float], tuple[FloatArray, FloatArray]]
"""Time in s to place (3,) m and velocity (3,) m/s, east, north and up."""


@dataclass(frozen=True)
class GnssEmulation:
    """What the receiver is like."""

    kind: str = "nmea"
    rate_hz: float = 10.0
    sigma_m: float = 0.01
    """Of each horizontal component (an RTK receiver); up: twice as much."""
    speed_sigma: float = 0.03
    """m/s."""
    latency_s: float = 0.05
    jitter_s: float = 0.01
    """Greatest additional latency."""
    dropout: tuple[float, float] = (0.0, 0.0)
    """From and to, s: no fix."""
    origin: tuple[float, float, float] = (48.137154, 11.576124, 567.0)
    """Of the world in which the body moves: degrees, degrees, m above the ellipsoid."""


def gnss_traffic(path: Path, start_ns: int, emulation: GnssEmulation, seed: int) -> Iterator[Transmission]:
    """Yield what the receiver sends, without end; time 0 of the path is ``start_ns`` of UTC."""
    rng = np.random.default_rng([seed, 60])
    plane = LocalPlane(*emulation.origin)
    write = _nmea if emulation.kind == "nmea" else _ubx
    k, last_s = 0, 0.0
    while True:
        k += 1
        time_s = k / emulation.rate_hz
        place, velocity = path(time_s)
        # Heights are about twice as uncertain as places on the map.
        place = place + emulation.sigma_m * np.array([1.0, 1.0, 2.0]) * rng.standard_normal(3)
        velocity = velocity + emulation.speed_sigma * rng.standard_normal(3)
        has_fix = not emulation.dropout[0] <= time_s < emulation.dropout[1]
        at = datetime.fromtimestamp(start_ns * 1e-9 + time_s, UTC)
        # However their delay jitters, messages keep their order.
        last_s = max(last_s, time_s + emulation.latency_s + emulation.jitter_s * float(rng.random()))
        yield Transmission(last_s, write(at, geodetic(plane, place), velocity, has_fix, emulation))


def _nmea(
    at: datetime,
    place: tuple[float, float, float],
    velocity: FloatArray,
    has_fix: bool,
    emulation: GnssEmulation,
) -> bytes:
    clock = at.strftime("%H:%M:%S.%f")
    speed = float(np.hypot(velocity[0], velocity[1]))
    course = float(np.degrees(np.arctan2(velocity[0], velocity[1])) % 360.0)
    rmc: dict[str, Any] = {"time": clock, "status": "A" if has_fix else "V", "date": at.date()}
    gga: dict[str, Any] = {"time": clock, "quality": 4 if has_fix else 0, "numSV": 14 if has_fix else 0}
    if has_fix:
        where = {"lat": round(place[0], 9), "lon": round(place[1], 9)}
        rmc |= {**where, "spd": round(speed / KNOT, 4), "cog": round(course, 3)}
        gga |= {**where, "HDOP": 0.7, "alt": round(place[2] - SEPARATION_M, 3), "sep": SEPARATION_M}
    sigma = emulation.sigma_m
    gst = {
        "time": clock,
        "stdLat": round(sigma, 3),
        "stdLong": round(sigma, 3),
        "stdAlt": round(2 * sigma, 3),
    }
    # GST before GGA: a receiver of positions then knows the accuracy of this epoch already.
    kinds = (("RMC", rmc), ("GST", gst), ("GGA", gga))
    sentences = [NMEAMessage("GN", kind, GET, hpnmeamode=1, **values).serialize() for kind, values in kinds]
    return b"".join(sentences)


def _ubx(
    at: datetime,
    place: tuple[float, float, float],
    velocity: FloatArray,
    has_fix: bool,
    emulation: GnssEmulation,
) -> bytes:
    east, north, up = (round(component * 1e3) for component in velocity.tolist())
    clock = {"year": at.year, "month": at.month, "day": at.day, "hour": at.hour, "min": at.minute}
    clock |= {"second": at.second, "nano": at.microsecond * 1000, "validDate": 1, "validTime": 1}
    where = {"lat": round(place[0], 7), "lon": round(place[1], 7), "height": round(place[2] * 1e3)}
    # Accuracies in mm; horizontal and speed errors are those of several axes together.
    errors = {"hAcc": round(emulation.sigma_m * 1414), "vAcc": round(emulation.sigma_m * 2000)}
    message = UBXMessage(
        "NAV",
        "NAV-PVT",
        GET,
        **clock,
        **where,
        **errors,
        fixType=3 if has_fix else 0,
        gnssFixOk=int(has_fix),
        carrSoln=2 if has_fix else 0,
        velN=north,
        velE=east,
        velD=-up,
        sAcc=round(emulation.speed_sigma * 1732),
    )
    data: bytes = message.serialize()
    return data
