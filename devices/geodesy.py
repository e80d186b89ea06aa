"""WGS 84 latitude, longitude and height to metres east, north and up of an origin, and back.

Exact for any distance: geodetic → earth-centred → local, by the closed formulae of NIMA TR8350.2 (2000).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
_ROUNDS = 6  # of the way back; each gains three digits near the ground


def earth_centred(latitude_deg: float, longitude_deg: float, height_m: float) -> FloatArray:
    """Return the earth-centred place (3,), m, of a point at a height above the ellipsoid."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    across = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(latitude) ** 2)
    ring = (across + height_m) * math.cos(latitude)
    polar = (across * (1.0 - ECCENTRICITY_2) + height_m) * math.sin(latitude)
    return np.array([ring * math.cos(longitude), ring * math.sin(longitude), polar])


@dataclass(frozen=True)
class LocalPlane:
    """East, north and up at an origin: degrees, and m above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    _origin: FloatArray = field(init=False, repr=False, compare=False)
    _axes: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        sa, ca, so, co = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
        axes = np.array([[-so, co, 0.0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]])
        place = earth_centred(self.latitude_deg, self.longitude_deg, self.height_m)
        object.__setattr__(self, "_origin", place)
        object.__setattr__(self, "_axes", axes)

    def enu(self, latitude_deg: float, longitude_deg: float, height_m: float) -> FloatArray:
        """Return the place (3,), m, east, north and up of the origin."""
        place: FloatArray = self._axes @ (earth_centred(latitude_deg, longitude_deg, height_m) - self._origin)
        return place


def geodetic(plane: LocalPlane, enu: FloatArray) -> tuple[float, float, float]:
    """Return the latitude and longitude (degrees) and height (m) of a place (3,) given in a local plane."""
    x, y, z = (plane._origin + plane._axes.T @ enu).tolist()
    ring = math.hypot(x, y)
    # Begun with the latitude of a place on the ellipsoid; each round brings height and latitude closer.
    latitude, height = math.atan2(z, ring * (1.0 - ECCENTRICITY_2)), 0.0
    for _ in range(_ROUNDS):
        across = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(latitude) ** 2)
        height = ring * math.cos(latitude) + z * math.sin(latitude) - SEMI_MAJOR_M**2 / across
        latitude = math.atan2(z, ring * (1.0 - ECCENTRICITY_2 * across / (across + height)))
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), height
