"""Coordinates of an OpenSim model, live: those of the .mot that the exporter writes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.opensim import OpenSimEncoder
from gateway.outputs.settings import OpenSimSettings

SUIT = load_rig("suit_17")
WALK = move(dress(SUIT), SUIT.skeleton.name, 3)
MODEL = """<?xml version="1.0"?><OpenSimDocument Version="40000"><Model name="leg"><JointSet><objects>
<CustomJoint name="hip"><coordinates><Coordinate name="hip_flexion_r"/><Coordinate name="pelvis_tilt"/>
<Coordinate name="mtp_angle_r"/></coordinates></CustomJoint></objects></JointSet></Model></OpenSimDocument>"""


def frame(k: int, q_wb=None, p=(1.0, 2.0, 0.9)) -> SkeletonFrame:
    n = SUIT.skeleton.n_segments
    q_wb = WALK.state(np.array([2.0 + 0.01 * k])).q_wb[0] if q_wb is None else q_wb
    zeros = np.zeros((n, 3))
    return SkeletonFrame(
        k, 10_000_000 * k, q_wb, zeros, zeros, np.tile(p, (n, 1)), np.zeros(n), np.zeros(n, np.uint8), 0
    )


def coordinates(encoder: OpenSimEncoder, one: SkeletonFrame) -> dict[str, float]:
    (datagram,) = encoder.encode(one)
    assert len(datagram) < 65_000
    return json.loads(datagram)["coordinates"]


def test_they_have_the_models_names_signs_and_axes():
    encoder = OpenSimEncoder(OpenSimSettings(), SUIT.skeleton)
    neutral = np.tile(SUIT.skeleton.neutral, (SUIT.skeleton.n_segments, 1))
    shank = SUIT.skeleton.index("right_shank"), SUIT.skeleton.index("right_foot")
    bent = Rotation.from_rotvec([0, np.radians(40), 0])
    for i in shank:
        turned = bent * Rotation.from_quat(neutral[i], scalar_first=True)
        neutral[i] = turned.as_quat(scalar_first=True)
    found = coordinates(encoder, frame(0, neutral))
    assert found["knee_angle_r"] == pytest.approx(np.radians(40), abs=1e-5)
    assert found["knee_angle_l"] == pytest.approx(0, abs=1e-5)
    assert found["hip_flexion_r"] == pytest.approx(0, abs=1e-5)
    assert [found[f"pelvis_t{axis}"] for axis in "xyz"] == [1.0, 0.9, -2.0]
    assert found["pelvis_rotation"] == pytest.approx(0, abs=1e-5)


def test_turns_of_the_root_go_on_beyond_half_a_turn():
    encoder = OpenSimEncoder(OpenSimSettings(), SUIT.skeleton)
    neutral = Rotation.from_quat(SUIT.skeleton.neutral, scalar_first=True)
    found = []
    for k in range(60):
        turned = (Rotation.from_rotvec([0, 0, np.radians(10 * k)]) * neutral).as_quat(scalar_first=True)
        one = frame(k, np.tile(turned, (SUIT.skeleton.n_segments, 1)))
        found.append(coordinates(encoder, one)["pelvis_rotation"])
    np.testing.assert_allclose(found, np.radians(10 * np.arange(60)), atol=1e-5)


def test_a_model_takes_what_it_has_and_nothing_that_is_not_known(tmp_path):
    path = tmp_path / "leg.osim"
    path.write_text(MODEL)
    encoder = OpenSimEncoder(OpenSimSettings(model=path), SUIT.skeleton)
    assert set(coordinates(encoder, frame(0))) == {"hip_flexion_r", "pelvis_tilt"}
    lost = frame(1).q_wb.copy()
    lost[SUIT.skeleton.index("pelvis")] = np.nan
    assert coordinates(encoder, frame(1, lost)) == {}


def test_a_model_that_is_none_or_of_other_names_is_refused(tmp_path):
    path = tmp_path / "leg.osim"
    with pytest.raises(OutputError, match=r"cannot be read as an .osim"):
        OpenSimEncoder(OpenSimSettings(model=path), SUIT.skeleton)
    path.write_text("no xml")
    with pytest.raises(OutputError, match=r"cannot be read as an .osim"):
        OpenSimEncoder(OpenSimSettings(model=path), SUIT.skeleton)
    path.write_text(MODEL.replace("hip_flexion_r", "q1").replace("pelvis_tilt", "q2"))
    with pytest.raises(OutputError, match=r"none of its coordinates .*q1"):
        OpenSimEncoder(OpenSimSettings(model=path), SUIT.skeleton)
