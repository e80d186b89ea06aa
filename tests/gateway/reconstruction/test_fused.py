"""Orientations fused on board to segments: alignment, heading, status."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.rig import load_rig
from gateway.frames import ImuFrame, Status
from gateway.reconstruction.fused import FusedReconstructor

SUIT = load_rig("suit_17")
N = len(SUIT.module_ids)


def observation(k, q_es, status=None):
    nothing = np.full((N, 3), np.nan)
    status = np.zeros(N, np.uint8) if status is None else status
    return ImuFrame(
        k, k * 10_000_000, nothing, nothing, nothing, status, np.zeros(N, np.int64), orientation=q_es
    )


def sensed(R_wb, R_ew):
    """q_es (N, 4) of modules whose segments are at R_wb and whose references are turned by R_ew."""
    q = np.empty((N, 4))
    for segment, row in enumerate(SUIT.module_of_segment):
        if row >= 0:
            R_bs = Rotation.from_quat(SUIT.sensor_to_segment[segment], scalar_first=True)
            q[row] = (R_ew[segment] * R_wb[segment] * R_bs).as_quat(scalar_first=True)
    return q


@pytest.mark.parametrize("starts_neutral", [False, True])
def test_segments_are_found_whatever_the_alignment(starts_neutral):
    rng = np.random.default_rng(3)
    n = SUIT.skeleton.n_segments
    headings = rng.uniform(-np.pi, np.pi, n) * starts_neutral
    R_ew = [Rotation.from_euler("z", angle) for angle in headings]
    fused = FusedReconstructor(SUIT, 0.01, starts_neutral=starts_neutral)
    neutral = Rotation.from_quat(SUIT.skeleton.neutral, scalar_first=True)
    fused.update(observation(0, sensed([neutral] * n, R_ew)))
    turns = [Rotation.from_rotvec(rng.normal(size=3)) * neutral for _ in range(n)]
    frame = fused.update(observation(1, sensed(turns, R_ew)))
    for segment, row in enumerate(SUIT.module_of_segment):
        if row >= 0:
            found = Rotation.from_quat(frame.q_wb[segment], scalar_first=True)
            assert (found.inv() * turns[segment]).magnitude() < 1e-7
            rate = (neutral.inv() * turns[segment]).as_rotvec() / 0.01
            np.testing.assert_allclose(frame.angular_rate[segment], rate, atol=1e-5)
    assert (frame.q_wb[:, 0] >= 0).all()
    assert np.isfinite(frame.p_w).all()


def test_status_is_that_of_the_data_and_rates_rest_on_samples():
    q = np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))
    fused = FusedReconstructor(SUIT, 0.01)
    status = np.zeros(N, np.uint8)
    status[3], status[4] = Status.HELD, Status.MISSING
    for k in range(2):
        frame = fused.update(observation(k, q, status))
    held, missing, good = (int(np.flatnonzero(SUIT.module_of_segment == row)[0]) for row in (3, 4, 5))
    assert frame.status[[held, missing, good]].tolist() == [Status.HELD, Status.MISSING, Status.MEASURED]
    assert np.isfinite(frame.q_wb[held]).all()
    assert np.isnan(frame.q_wb[missing]).all()
    assert np.isnan(frame.angular_rate[[held, missing]]).all()
    np.testing.assert_array_equal(frame.angular_rate[good], 0.0)


def test_raw_samples_give_nothing():
    frame = FusedReconstructor(SUIT, 0.01).update(observation(0, None))
    assert (frame.status == Status.MISSING).all()
