"""The sun as sensor X: headings without any magnetometer, by every method that can."""

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.motions import robot_arm_motion
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress
from gateway.emulation.simulation import ideal_frames
from gateway.errors import SettingsError
from gateway.frames import Quantity, SunSight
from gateway.geometry import quaternion
from gateway.geometry.comparison import orientation_error, rmse_deg
from gateway.reconstruction import RECONSTRUCTORS, create_reconstructor, update_many

RATE_HZ, SECONDS = 100.0, 12.0
SUN = np.array([0.64, -0.48, 0.6])
ARM = load_rig("robot_arm_4_sun")


@pytest.fixture(scope="module")
def seen():
    """Ideal frames of the arm without magnetometers, and its true orientations."""
    motion = robot_arm_motion(dress(ARM), seed=3)
    times_ns = np.arange(round(SECONDS * RATE_HZ)) * round(1e9 / RATE_HZ)
    rng = np.random.default_rng(3)
    true = motion.state(times_ns * 1e-9).q_wb
    frames = []
    for k, frame in enumerate(ideal_frames(ARM, dress(ARM), motion, times_ns, True)):
        directions = np.stack([quaternion.to_matrix(q).T @ SUN for q in true[k]])
        directions += 0.01 * rng.standard_normal(directions.shape)
        sight = SunSight(SUN, directions, np.full(4, 0.03))
        rate = frame.angular_rate + 1e-4 * rng.standard_normal((4, 3))
        nothing = np.full((4, 3), np.nan)
        frames.append(replace(frame, angular_rate=rate, magnetic_field=nothing, sun=sight))
    return frames, true


LIMITS_DEG = {"joint": 1.0, "independent": 2.0, "articulated": 6.0}


@pytest.mark.parametrize("method", LIMITS_DEG)
def test_the_sun_shows_the_heading(seen, method):
    frames, true = seen
    found = update_many(create_reconstructor(method, ARM, 1.0 / RATE_HZ), frames)
    settled = slice(round(6.0 * RATE_HZ), None)
    q_wb = np.stack([frame.q_wb for frame in found])[settled]
    assert np.isfinite(q_wb).all()
    assert rmse_deg(orientation_error(q_wb, true[settled]).heading).max() < LIMITS_DEG[method]


def test_a_heading_that_nobody_knows_is_turned_to_the_sun_at_once(seen):
    frames, true = seen
    dark = [replace(frame, sun=None) for frame in frames[:300]]
    found = update_many(create_reconstructor("joint", ARM, 1.0 / RATE_HZ), [*dark, *frames[300:360]])
    before, after = (orientation_error(found[k].q_wb, true[k]).heading for k in (299, 359))
    assert np.degrees(before[0]) > 20.0  # faces as its sensor happened to
    assert np.degrees(after).max() < 3.0


def test_a_single_wrong_sight_hardly_counts(seen):
    frames, true = seen
    wrong = replace(frames[900].sun, direction=np.roll(frames[900].sun.direction, 1, axis=1))
    frames = [*frames[:900], *(replace(frame, sun=wrong) for frame in frames[900:905]), *frames[905:]]
    found = update_many(create_reconstructor("joint", ARM, 1.0 / RATE_HZ), frames)
    assert np.degrees(orientation_error(found[910].q_wb, true[910]).heading).max() < 2.0


@pytest.mark.parametrize("method", sorted(RECONSTRUCTORS))
def test_a_method_that_cannot_use_the_sun_says_so(method):
    both = replace(ARM, sun=replace(ARM.sun, beside_magnetometer=True))
    if method in {"joint", "outward"}:
        create_reconstructor(method, both, 0.01)
        return
    with pytest.raises(SettingsError, match=f"'{method}' cannot use the rig's 'second_field: both'"):
        create_reconstructor(method, both, 0.01)


def test_the_literal_method_refuses_pressure_tubes():
    tubes = replace(load_rig("robot_arm_4").local_devices[0], quantity=Quantity.AIR_VELOCITY, device=60)
    suit = replace(ARM, local_devices=(tubes,))
    with pytest.raises(SettingsError, match="pressure tubes"):
        create_reconstructor("articulated", suit, 0.01)
