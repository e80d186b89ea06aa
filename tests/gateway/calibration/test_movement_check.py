"""Which segments follow the five movements, by an emulated wearer's true motion."""

from __future__ import annotations

import numpy as np
import pytest

from devices.calibration_script import timetable
from devices.emulators.motion.calibrating import calibration_motion
from gateway.body.rig import load_rig
from gateway.calibration.movement_check import MOVEMENTS, MovementCheck
from gateway.calibration.movement_check import MovementVerdict as Verdict
from gateway.emulation.rig import dress
from gateway.geometry import quaternion

SKELETON = load_rig("suit_17").skeleton
STEP_OF = {
    "left_arm": "arms",
    "right_arm": "arms",
    "left_leg": "left_leg",
    "right_leg": "right_leg",
    "bow": "squat",
}
ABOUT_FORWARD = np.array([0.0, 1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def motion():
    return calibration_motion(dress(load_rig("suit_17")), 3, heading=1.0)


def checked(movement, motion, step, change=None):
    """The movement watched while the wearer does a step; ``change``: of orientations and status by name."""
    check = MovementCheck(movement, SKELETON.segment_names)
    for row in motion.state(np.linspace(*timetable()[step], 100)).q_wb:
        q_wb = dict(zip(SKELETON.segment_names, row, strict=True))
        status = dict.fromkeys(q_wb, "measured")
        if change is not None:
            change(q_wb, status)
        check.add(q_wb, status, row[0])
    return {seen.segment: seen.verdict for seen in check.seen()}


@pytest.mark.parametrize("movement", MOVEMENTS, ids=lambda movement: movement.name)
def test_all_segments_follow_who_does_the_movement(movement, motion):
    assert set(checked(movement, motion, STEP_OF[movement.name]).values()) == {Verdict.FOLLOWS}


@pytest.mark.parametrize("movement", MOVEMENTS, ids=lambda movement: movement.name)
def test_none_follows_who_stands_still(movement, motion):
    assert set(checked(movement, motion, "n_pose").values()) == {Verdict.STILL}


def test_a_module_worn_the_wrong_way_round_is_found(motion):
    def turned(q_wb, _status):
        q_wb["left_shank"] = quaternion.multiply(q_wb["left_shank"], ABOUT_FORWARD)

    found = checked(MOVEMENTS[2], motion, "left_leg", turned)
    assert found == {
        "left_thigh": Verdict.FOLLOWS, "left_shank": Verdict.OPPOSITE, "left_foot": Verdict.FOLLOWS,
    }  # fmt: skip


def test_a_silent_and_a_doubtful_segment_are_told_apart(motion):
    def spoilt(q_wb, status):
        q_wb["left_thigh"], status["left_thigh"] = None, "missing"
        status["left_foot"] = "doubtful"

    found = checked(MOVEMENTS[2], motion, "left_leg", spoilt)
    assert found == {
        "left_thigh": Verdict.UNKNOWN, "left_shank": Verdict.FOLLOWS, "left_foot": Verdict.DOUBTFUL,
    }  # fmt: skip


def test_segments_without_modules_are_not_judged():
    check = MovementCheck(MOVEMENTS[0], ("left_upper_arm",))
    assert [seen.segment for seen in check.seen()] == ["left_upper_arm"]
