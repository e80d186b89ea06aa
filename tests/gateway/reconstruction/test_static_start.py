"""A static start is found where there is one, and only there."""

import numpy as np
import pytest
from simulated_body import FIELD, GRAVITY, arm, imu_frames, instants, simulate

from gateway.reconstruction.inertial.articulated import StaticStart
from gateway.reconstruction.inertial.observations import SegmentObserver


def observations(body, start_s, seconds):
    truth = simulate(body, instants(100, seconds, start_s))
    observer = SegmentObserver(body.suit())
    return truth, [observer.observe(f) for f in imu_frames(body, truth, gyroscopes=False)]


def watch():
    return StaticStart(GRAVITY, FIELD, n_frames=20, norm_tolerance=0.3, deviation=0.1)


def test_rest_of_the_asked_length_gives_every_orientation():
    truth, observed = observations(arm(on_joint=False, from_rest=True), -1.0, 0.5)
    start = watch()
    found = [start.add(o) for o in observed]
    assert all(R is None for R in found[:19])
    np.testing.assert_allclose(found[19], truth.R[19], atol=1e-12)


def test_motion_is_not_rest():
    _, observed = observations(arm(on_joint=False), 0.0, 3.0)
    start = watch()
    assert all(start.add(o) is None for o in observed)


@pytest.mark.parametrize("push", [0.5, 3.0])
def test_steady_acceleration_is_not_rest(push):
    _, observed = observations(arm(on_joint=False, from_rest=True), -1.0, 0.5)
    start = watch()
    assert all(
        start.add(o._replace(specific_force=o.specific_force * (1 + push / 9.81))) is None for o in observed
    )


def test_one_moving_segment_keeps_the_body_from_resting():
    _, observed = observations(arm(on_joint=False, from_rest=True), -1.0, 0.5)
    start = watch()
    for k, o in enumerate(observed):
        shaken = o.specific_force.copy()
        shaken[2, 0] += 0.5 * (-1) ** k
        assert start.add(o._replace(specific_force=shaken)) is None


def test_segments_without_module_do_not_count():
    body = arm(on_joint=False, from_rest=True, module_of_segment=(0, 1, -1, 2))
    _, observed = observations(body, -1.0, 0.5)
    start = watch()
    R = [start.add(o) for o in observed][-1]
    np.testing.assert_array_equal(np.isnan(R).all(axis=(1, 2)), [False, False, True, False])


def test_reset_begins_to_count_anew():
    _, observed = observations(arm(on_joint=False, from_rest=True), -1.0, 0.5)
    start = watch()
    for o in observed[:15]:
        start.add(o)
    start.reset()
    assert all(start.add(o) is None for o in observed[15:34])
    assert start.add(observed[34]) is not None
