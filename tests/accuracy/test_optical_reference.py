"""The reference's lag and its worth are found from rates alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.recorded_tracks import ModuleTrack, RecordedTracks, ReferenceTrack
from gateway.emulation.optical_reference import gyroscope_disagreement, in_time


def tumbling(times):
    """Orientations and rates of a motion about all axes: x'' after y' after z, sines of known rates."""
    angles = np.stack([np.sin(1.9 * times), 0.7 * np.sin(2.7 * times + 1.0), np.sin(1.3 * times)], axis=1)
    return Rotation.from_euler("ZYX", angles)


def recording(lag_s, n_modules=2, rate_hz=100.0, jump_rad=0.0):
    times = np.arange(round(20.0 * rate_hz)) / rate_hz
    h = 1e-5
    rate = (tumbling(times - h).inv() * tumbling(times + h)).as_rotvec() / (2.0 * h)
    optical = np.arange(19 * 30) / 30.0
    q = tumbling(optical)
    jump = np.where((optical > 5.5) & (optical < 6.5), jump_rad, 0.0)
    q = q * Rotation.from_rotvec(jump[:, None] * np.array([1.0, 0.0, 0.0]))
    nothing = np.full((len(times), 3), np.nan)
    names = [f"segment_{i}" for i in range(n_modules)]
    return RecordedTracks(
        "tumbling",
        rate_hz,
        tuple(ModuleTrack(i, name, times, nothing, rate, nothing) for i, name in enumerate(names)),
        tuple(ReferenceTrack(name, optical + lag_s, q.as_quat(scalar_first=True)) for name in names),
    )


@pytest.mark.parametrize("lag_s", [-0.012, 0.0, 0.016, 0.033])
def test_the_lag_is_found_and_taken_out(lag_s):
    late = recording(lag_s)
    moved, found = in_time(late)
    assert found == pytest.approx(lag_s, abs=0.0015)
    np.testing.assert_allclose(moved.references[0].times, late.references[0].times - found)


def test_jumps_of_the_reference_do_not_shift_it():
    assert in_time(recording(0.016, jump_rad=0.5))[1] == pytest.approx(0.016, abs=0.0015)


def test_gyroscopes_agree_with_a_good_reference_and_not_with_one_that_jumps():
    total, tilt = gyroscope_disagreement(in_time(recording(0.016))[0])
    assert total.shape == tilt.shape == (2,)
    assert np.max(total) < 0.3
    assert np.all(tilt <= total + 1e-9)
    assert np.min(gyroscope_disagreement(in_time(recording(0.016, jump_rad=0.2))[0])[0]) > 1.0
