"""Muscles of a motion that still goes on, against those of the whole of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco")
pytest.importorskip("osqp")
pytest.importorskip("myo_sim")
pytest.importorskip("viser")

from gateway.analysis.analysing import analyse_motion
from gateway.analysis.live import GRAVITY, LAG_S, SPAN_S, LiveMuscles
from gateway.analysis.muscles import find_muscles
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.body_file import load_body
from gateway.body.inertia import body_inertia
from gateway.errors import GatewayError
from gateway.viewer.muscle_wires import MuscleWires, segments_of

BODY = load_body("human_17")
ROOT = np.array([0.0, 0.0, 0.93])
STEP_S = 0.02


def bowed(angle):
    """(S, 4) of a person whose trunk is bent forward, rad."""
    upright = Rotation.from_quat(BODY.neutral, scalar_first=True)
    turned = (upright * Rotation.from_rotvec([0.0, 0.0, -angle])).as_quat(scalar_first=True)
    q_wb = np.tile(BODY.neutral, (BODY.n_segments, 1))
    for s, name in enumerate(BODY.segment_names):
        if not name.endswith(("pelvis", "thigh", "shank", "foot")):
            q_wb[s] = turned
    return q_wb


def test_live_tells_what_the_whole_motion_told_shortly_before():
    time_s = np.arange(90) * STEP_S
    motion = np.array([bowed(0.6 * np.sin(1.7 * t) ** 2) for t in time_s])
    smooth = smooth_motion(BODY, time_s, motion, np.tile(ROOT, (90, 1)), 6.0)
    whole = find_muscles(analyse_motion(smooth, "bow", body_inertia(BODY, 70.0), GRAVITY))
    live = LiveMuscles(BODY, 70.0)
    for k in range(70):
        live.add(time_s[k], motion[k] * (-1) ** k, ROOT)  # either sign is the same orientation
    found = live.now()
    then = whole.activity[69 - round(LAG_S / STEP_S)]
    assert then.max() > 0.1
    assert found.activity == pytest.approx(then, abs=0.05)
    pose, wires = whole.paths[69], live.wires(motion[69], ROOT)
    assert max(np.abs(a[[0, -1]] - b[[0, -1]]).max() for a, b in zip(wires, pose, strict=True)) < 0.02
    points, colours = segments_of(found.activity, wires, ROOT)
    assert points.shape == colours.shape
    assert len(points) == sum(len(path) - 1 for path in wires)
    strongest = int(np.argmax(found.activity))
    first = sum(len(path) - 1 for path in wires[:strongest])
    assert colours[first, 0, 0].astype(int) - colours[first, 0, 2] > 0  # towards red


def test_nothing_is_told_before_enough_has_come_nor_after_a_gap():
    live = LiveMuscles(BODY, 70.0)
    times = np.arange(0.0, SPAN_S - STEP_S, STEP_S)
    for t in times:
        live.add(t, bowed(0.1), ROOT)
    assert live.now() is None
    live.add(times[-1] + 5.0, bowed(0.1), ROOT)
    for t in times:
        live.add(times[-1] + 5.0 + t, bowed(0.1), ROOT)
    assert live.now() is None


def test_a_body_without_joints_of_a_person_is_told():
    with pytest.raises(GatewayError, match="shows no muscles live: only those with the segments of human_17"):
        MuscleWires(None, None, replace(load_body("arm_4"), joints=()), 70.0)
