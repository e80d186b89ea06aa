"""The gait's feet stand still where they carry the body; the body goes where it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.gait import RUN, WALK, Gait
from devices.emulators.motion.legs import HEEL, TOE
from devices.emulators.motion.motions import gait_motion
from devices.emulators.motion.waves import Fade

FROM_S = 8.0
GAITS = [WALK, RUN, replace(WALK, radius=4.0), replace(WALK, radius=2.0), replace(RUN, radius=6.0)]


def point(state, segment, place):
    """Position and velocity (T, 3) of a point of a segment."""
    arm = np.array([*place, 0.0])
    position = state.joint_position[:, segment] + state.R_wb[:, segment] @ arm
    swept = np.cross(state.angular_rate[:, segment], arm)
    return position, state.joint_velocity[:, segment] + np.einsum("tij,tj->ti", state.R_wb[:, segment], swept)


@pytest.fixture(
    scope="module", params=GAITS, ids=["walk", "run", "in a circle", "in a small one", "run in one"]
)
def walked(request):
    """Gait and a function that gives the state of the body at times."""
    return request.param


def test_each_foot_stands_still_for_its_stance(walked, human17):
    motion = gait_motion(human17, 1, gait=walked)
    state = motion.state(np.arange(FROM_S, FROM_S + 10.0 / walked.stride_hz, 0.002))
    for side in ("left", "right"):
        foot = human17.segment_names.index(f"{side}_foot")
        for place, share in ((HEEL, walked.flat_to), (TOE, walked.toe_off - walked.flat_from)):
            position, velocity = point(state, foot, place)
            still = np.linalg.norm(velocity, axis=1) < 1e-3
            assert np.mean(still) == pytest.approx(share, abs=0.04)
            assert np.ptp(position[still, 2]) < 2e-4


def test_the_feet_never_go_through_the_floor(walked, human17):
    state = gait_motion(human17, 1, gait=walked).state(np.arange(0.0, 20.0, 0.01))
    left, right = (human17.segment_names.index(f"{side}_foot") for side in ("left", "right"))
    floor = point(state, left, HEEL)[0][0, 2]
    lowest = min(point(state, foot, place)[0][:, 2].min() for foot in (left, right) for place in (HEEL, TOE))
    assert lowest == pytest.approx(floor, abs=1e-4)


def test_running_has_flights_and_walking_has_none(human17):
    def share_in_the_air(gait: Gait) -> float:
        state = gait_motion(human17, 1, gait=gait).state(np.arange(FROM_S, FROM_S + 8.0, 0.002))
        stands = np.zeros(len(state.R_wb), bool)
        for side in ("left", "right"):
            foot = human17.segment_names.index(f"{side}_foot")
            for place in (HEEL, TOE):
                stands |= np.linalg.norm(point(state, foot, place)[1], axis=1) < 1e-2
        return float(1.0 - np.mean(stands))

    assert share_in_the_air(WALK) < 0.01
    # less than between toe-off and heel strike (0.28), as the toe leaves the ground slowly
    assert 0.17 < share_in_the_air(RUN) < 0.28


def test_the_body_advances_at_the_gaits_speed(human17):
    motion = gait_motion(human17, 1)
    first, last = motion.state([10.0, 10.0 + 20.0 / WALK.stride_hz]).joint_position[:, 0]
    np.testing.assert_allclose(last - first, [20.0 * WALK.speed / WALK.stride_hz, 0.0, 0.0], atol=1e-6)


def test_a_circle_closes_and_the_body_faces_along_it(human17):
    gait = replace(WALK, radius=4.0, sway=0.0)
    motion = gait_motion(human17, 1, gait=gait)
    position = motion.state(np.arange(10.0, 10.0 + 2 * np.pi * 4.0 / gait.speed, 0.1)).joint_position[:, 0]
    np.testing.assert_allclose(np.linalg.norm(position[:, :2] - [0.0, 4.0], axis=1), 4.0, atol=1e-9)
    state = motion.state([12.3])
    forward, velocity = state.R_wb[0, 0, :2, 0], state.joint_velocity[0, 0, :2]
    assert np.dot(forward, velocity) / np.linalg.norm(velocity) > np.cos(np.radians(6.0))


def test_starts_at_once_where_the_fade_says_so(human17):
    motion = gait_motion(human17, 1, Fade(rest_s=0.0, ramp_s=1.0))
    assert np.linalg.norm(motion.state([3.0]).joint_velocity[0, 0]) > 0.9


def test_steps_that_are_too_long_are_refused(human17):
    with pytest.raises(ValueError, match="too long for the leg"):
        gait_motion(human17, 1, gait=replace(WALK, speed=2.5))
