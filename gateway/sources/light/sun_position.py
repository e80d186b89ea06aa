"""Where the sun stands, by the library astral (NOAA's equations after Meeus, with refraction).

Within 0.02° of NREL's solar position algorithm at the published example; see the tests.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
from astral import Observer
from astral.sun import zenith_and_azimuth

from gateway.frames import FloatArray


def sun_direction(time_ns: int, latitude_deg: float, longitude_deg: float) -> FloatArray:
    """Return (3,) unit vector to the apparent sun, ENU; up is negative at night.

    time_ns: UTC since 1970. latitude_deg: north; longitude_deg: east.
    """
    when = datetime.fromtimestamp(time_ns * 1e-9, UTC)
    zenith, azimuth = zenith_and_azimuth(Observer(latitude_deg, longitude_deg), when)
    up, around = math.radians(90.0 - zenith), math.radians(azimuth)
    return np.array([math.cos(up) * math.sin(around), math.cos(up) * math.cos(around), math.sin(up)])
