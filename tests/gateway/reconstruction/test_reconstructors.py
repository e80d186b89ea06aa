"""Reconstructors by name."""

import pytest
from simulated_body import arm, imu_frames, instants, simulate

from gateway.reconstruction import RECONSTRUCTORS, create_reconstructor


@pytest.mark.parametrize("name", ["articulated", "fused", "fused_neutral", "independent", "joint", "outward"])
def test_every_name_makes_a_reconstructor(name):
    body = arm(on_joint=True)
    imu_frame = imu_frames(body, simulate(body, instants(100, 0.0)), gyroscopes=True)[0]
    frame = create_reconstructor(name, body.suit(), 0.01).update(imu_frame)
    assert frame.q_wb.shape == (4, 4)
    assert name in RECONSTRUCTORS


def test_an_unknown_name_is_told_the_known_ones():
    with pytest.raises(
        ValueError,
        match=r"'kalman'.*articulated, fused, .*gyro_free, independent, joint",
    ):
        create_reconstructor("kalman", arm(on_joint=True).suit(), 0.01)
