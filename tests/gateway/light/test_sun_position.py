"""The almanac against published places of the sun."""

from datetime import UTC, datetime

import numpy as np
import pytest

from gateway.sources.light import sun_direction

PUBLISHED = [
    # Reda & Andreas, NREL/TP-560-34302, table A5.1: zenith and azimuth, topocentric, with refraction
    ("nrel", datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 39.742476, -105.1786, 50.11162, 194.34024, 0.02),
    # equinox of March 2024 (03:06 UTC): overhead at noon on the equator, to 0.3° of declination and 7.4 min
    ("equinox", datetime(2024, 3, 20, 12, 7, 24, tzinfo=UTC), 0.0, 0.0, 0.0, 180.0, 0.3),
    # midsummer at the tropic of Cancer: declination 23.44°
    ("solstice", datetime(2024, 6, 20, 12, 1, 50, tzinfo=UTC), 23.44, 0.0, 0.0, 180.0, 0.1),
]


@pytest.mark.parametrize(
    ("when", "latitude", "longitude", "zenith", "azimuth", "within"),
    [row[1:] for row in PUBLISHED],
    ids=[row[0] for row in PUBLISHED],
)
def test_sun_stands_where_it_was_published(when, latitude, longitude, zenith, azimuth, within):
    found = sun_direction(round(when.timestamp()) * 10**9, latitude, longitude)
    z, a = np.radians(zenith), np.radians(azimuth)
    true = np.array([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)])
    assert np.degrees(np.linalg.norm(found - true)) < within


def test_sun_is_below_the_horizon_at_midnight():
    night = datetime(2026, 12, 21, 0, 0, tzinfo=UTC)
    assert sun_direction(round(night.timestamp()) * 10**9, 48.0, 11.0)[2] < -0.5
