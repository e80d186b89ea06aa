"""Placements that lose the heading without gyroscopes: as the method itself does when it is let run."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.body.skeleton import field_vector
from gateway.frames import ImuFrame
from gateway.geometry import quaternion, rotation_matrix
from gateway.reconstruction.inertial.articulated import (
    FACINGS,
    ArticulatedReconstructor,
    StartingPose,
    unobserved_headings,
)

RATE_HZ = 100
PLACEMENTS = {
    "east of the joint": ((0.12, 0.0, 0.0), True),
    "east and below": ((0.1, 0.0, -0.07), True),
    "below the joint": ((0.0, 0.0, -0.12), True),
    "south of the joint": ((0.0, -0.12, 0.0), True),
    "above the joint": ((0.0, 0.0, 0.12), False),
    "north of the joint": ((0.0, 0.12, 0.0), False),
    "above, a little east": ((0.01, 0.0, 0.12), False),
}
"""Of a link whose neutral axes are the world's, facing east: from the joint, m; whether it is observed."""


def link(position, dip_deg=25.0):
    """The robot arm's first link, about its fixed point."""
    suit = load_rig("robot_arm_4")
    arms = suit.lever_arms.copy()
    arms[0] = position
    return replace(suit, lever_arms=arms, magnetic_field=field_vector(50.0, dip_deg))


def error_deg(suit, facing=90):
    """How far ``articulated`` is off in the end; at first by a degree about the field, the worse way."""
    return max(error_from(suit, facing, start_deg) for start_deg in (-1.0, 1.0))


def error_from(suit, facing, start_deg, seconds=4.0):
    """The same from an error of that sign, at rest all along."""
    up, field = -suit.gravity, suit.magnetic_field
    truth = rotation_matrix.from_rotation_vector(np.array([0.0, 0.0, np.radians(90 - facing)]))
    wrong = (
        rotation_matrix.from_rotation_vector(field * (np.radians(start_deg) / np.linalg.norm(field))) @ truth
    )
    n = len(suit.module_ids)
    start = StartingPose(np.tile(quaternion.from_matrix(wrong), (n, 1)), np.zeros((n, 3)))
    reconstructor = ArticulatedReconstructor(suit, 1.0 / RATE_HZ, starting_pose=start)
    for k in range(round(seconds * RATE_HZ)):
        pose = reconstructor.update(
            ImuFrame(
                k,
                (k + 1) * 10**9 // RATE_HZ,
                np.tile(truth.T @ up, (n, 1)),
                np.full((n, 3), np.nan),
                np.tile(truth.T @ field, (n, 1)),
                np.zeros(n, np.uint8),
                np.zeros(n, np.int64),
            )
        )
    off = quaternion.to_matrix(pose.q_wb[0]).T @ truth
    return np.degrees(np.arccos(np.clip((np.trace(off) - 1.0) / 2.0, -1.0, 1.0)))


@pytest.mark.parametrize("dip_deg", [25.0, 66.0])
@pytest.mark.parametrize("name", sorted(PLACEMENTS))
def test_what_is_told_of_a_placement_is_what_the_method_does(name, dip_deg):
    position, is_observed = PLACEMENTS[name]
    suit = link(position, dip_deg)
    lost = unobserved_headings(suit).get("link_1", ())
    error = error_deg(suit)
    print(f"{name}: {error:.2f}° after 4 s; unobserved facing {lost}")
    assert (90 not in lost) == is_observed
    assert error < 0.7 if is_observed else error > 4.0


def test_the_way_to_face_decides_where_a_module_lies_to_one_side():
    suit = link((0.12, 0.0, 0.0))  # forward of the joint: north of it where the body faces north
    lost = unobserved_headings(suit)["link_1"]
    assert 0 in lost
    assert not {45, 90, 135, 180, 225, 270, 315} & set(lost)
    for facing in (0, 90, 180):
        assert (error_deg(suit, facing) > 4.0) == (facing in lost)


def test_a_module_straight_above_is_lost_whichever_way_one_faces_and_one_on_the_joint_never():
    assert unobserved_headings(link((0.0, 0.0, 0.12)))["link_1"] == FACINGS
    assert "link_1" not in unobserved_headings(link((0.0, 0.0, 0.0)))


def test_a_segment_without_a_module_is_not_told():
    suit = link((0.0, 0.0, 0.12))
    rows = suit.module_of_segment.copy()
    rows[0] = -1
    assert "link_1" not in unobserved_headings(replace(suit, module_of_segment=rows))
