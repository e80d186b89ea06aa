"""What light readings are taken, what is turned away and why, and how that is reported."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from devices.emulators.sensing.light_sampler import LightSampler, Shade, Sunlight
from gateway.body.rig import load_rig
from gateway.frames import ImuFrame, LightReading
from gateway.geometry import rotation_matrix
from gateway.sources.light import Rejected, SunCompass, sun_direction

MORNING_NS = round(datetime(2026, 6, 21, 7, 0, tzinfo=UTC).timestamp()) * 10**9
SUIT = load_rig("robot_arm_4_sun")
PLACE = (SUIT.sun.latitude_deg, SUIT.sun.longitude_deg)
R_WS = rotation_matrix.from_rotation_vector(np.array([0.4, -0.3, 1.1]))
UP = R_WS.T @ [0.0, 0.0, 9.81]


def frame(k, readings=(), rate=(0.0, 0.0, 0.0), time_ns=MORNING_NS):
    m = len(SUIT.module_ids)
    return ImuFrame(
        k,
        time_ns + k * 10_000_000,
        np.tile(UP, (m, 1)),
        np.tile(rate, (m, 1)),
        np.ones((m, 3)),
        np.zeros(m, np.uint8),
        np.zeros(m, np.int64),
        light=tuple(readings),
    )


def reading(k, light, module=2, time_ns=MORNING_NS):
    at = time_ns + k * 10_000_000
    seen = LightSampler(light, 1, module).read(np.array([k * 0.01]), R_WS[None])[0]
    return LightReading(module, at, seen)


def sun(time_ns=MORNING_NS, **changes):
    plain = Sunlight(sun_direction(time_ns, *PLACE), gain_error=0.0, noise=0.0)
    return replace(plain, **changes)


def test_a_module_in_the_sun_sees_it_where_it_is():
    compass = SunCompass(SUIT)
    seen = compass.sighted(frame(0, [reading(0, sun())])).sun
    heading = lambda v: np.arctan2(v[1], v[0])  # noqa: E731 - twice, here alone
    off = heading(R_WS @ seen.direction[2]) - heading(sun().direction)
    assert abs(np.degrees(off)) < 0.5  # sky and ground change the height alone
    assert np.isnan(seen.direction[[0, 1, 3]]).all()
    assert compass.statistics()["modules"]["2"] == {"state": "sun", "sun": 1}
    assert compass.statistics()["modules"]["0"] == {"state": "silent"}


def test_magnetometers_count_only_beside_the_sun():
    assert np.isnan(SunCompass(SUIT).sighted(frame(0)).magnetic_field).all()
    both = replace(SUIT, sun=replace(SUIT.sun, beside_magnetometer=True))
    assert (SunCompass(both).sighted(frame(0)).magnetic_field == 1.0).all()


def test_a_direction_is_carried_by_the_gyroscope_and_not_for_long():
    compass, rate = SunCompass(SUIT), np.array([0.0, 2.0, 0.0])
    first = compass.sighted(frame(0, [reading(0, sun())])).sun.direction[2]
    later = [compass.sighted(frame(k, rate=rate)).sun.direction[2] for k in range(1, 8)]
    turned = rotation_matrix.from_rotation_vector(-rate * 0.03) @ first
    assert np.allclose(later[2], turned)
    assert np.isnan(later[-1]).all()


NIGHT_NS = round(datetime(2026, 6, 21, 23, 0, tzinfo=UTC).timestamp()) * 10**9
TROPICS = replace(SUIT, sun=replace(SUIT.sun, latitude_deg=23.4, longitude_deg=75.0))
SHADOW = Shade(0.0, 1.0, direct=0.0)
CASES = {
    Rejected.SUN_LOW: (SUIT, NIGHT_NS, {"direction": np.array([0.0, 0.8, 0.6])}),
    Rejected.SUN_HIGH: (TROPICS, MORNING_NS, {}),
    Rejected.SATURATED: (SUIT, MORNING_NS, {"direct": 2.0}),
    Rejected.DARK: (SUIT, MORNING_NS, {"direct": 0.0, "sky": 0.0, "ground": 0.0}),
    Rejected.DIFFUSE: (SUIT, MORNING_NS, {"shades": (SHADOW,)}),
    Rejected.MISPLACED: (SUIT, MORNING_NS, {"direction": np.array([0.1, 0.0, 0.995])}),
}


@pytest.mark.parametrize("reason", CASES, ids=lambda reason: reason.name.lower())
def test_what_is_not_the_sun_is_turned_away(reason):
    suit, time_ns, changes = CASES[reason]
    compass = SunCompass(suit)
    seen = compass.sighted(frame(0, [reading(0, sun(time_ns, **changes), time_ns=time_ns)], time_ns=time_ns))
    assert np.isnan(seen.sun.direction).all()
    assert compass.statistics()["modules"]["2"] == {"state": reason.name.lower(), reason.name.lower(): 1}


def test_a_second_light_is_turned_away():
    plain = reading(0, sun())
    plain.intensity[np.argmin(plain.intensity)] += 0.2
    compass = SunCompass(SUIT)
    assert np.isnan(compass.sighted(frame(0, [plain])).sun.direction).all()
    assert compass.statistics()["modules"]["2"]["state"] == "inconsistent"


def test_the_edge_of_a_shadow_on_one_cell_is_turned_away_until_it_is_gone():
    lit = int(np.argsort(reading(0, sun()).intensity)[-2])
    compass, edge = SunCompass(SUIT), Shade(0.05, 0.15, cells=(lit,))
    for k in range(20):
        compass.sighted(frame(k, [reading(k, sun(shades=(edge,)))]))
    counts = compass.statistics()["modules"]["2"]
    assert counts["sun"] == 10
    assert counts["state"] == "sun"


def test_a_weaker_sun_than_before_is_turned_away_until_it_is_back():
    compass = SunCompass(SUIT)
    thin = Shade(0.05, 0.15, direct=0.5, sky=0.5)
    for k in range(20):
        compass.sighted(frame(k, [reading(k, sun(shades=(thin,)))]))
    assert compass.statistics()["modules"]["2"] == {"state": "sun", "sun": 10, "dimmed": 10}


def test_a_suit_without_cells_has_no_sun_compass():
    with pytest.raises(ValueError, match="no photoelectric cells"):
        SunCompass(replace(SUIT, sun=None))
