"""The add-on in Blender without a window: an armature moves as the body does, and a recording is imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.emulation.rig import dress, move
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import UdpJsonSettings
from gateway.outputs.side_outputs import JsonDatagrams
from gateway.recording import open_recording
from gateway.recording.exporters.formats import Axes
from gateway.recording.exporters.take import Take, take_of
from tests.fixtures.processes import REPOSITORY

BLENDER = Path(os.environ.get("MOCAP_BLENDER_PYTHON", REPOSITORY / "build/blender/bin/python"))
"""An interpreter that has the package bpy: its own environment, since Blender wants another NumPy."""
pytestmark = pytest.mark.skipif(not BLENDER.exists(), reason="no Blender: make test-blender")

SUIT = load_rig("suit_17")
BODY: Skeleton = SUIT.skeleton
WALK = move(dress(SUIT), BODY.name, 3)


def pose(k: int) -> SkeletonFrame:
    n = BODY.n_segments
    q_wb = np.ascontiguousarray(WALK.state(np.array([2.0 + 0.3 * k])).q_wb[0])
    p_w = joint_positions(BODY.parents, BODY.offsets, q_wb, np.array([0.1 * k, 0.2, 0.9]))
    zeros = np.zeros((n, 3))
    return SkeletonFrame(
        k, 10**9 + 2 * 10**7 * k, q_wb, zeros, zeros, p_w, np.zeros(n), np.zeros(n, np.uint8), 0
    )


def assert_is(frame: SkeletonFrame, bones: dict[str, dict]) -> None:
    neutral = Rotation.from_quat(BODY.neutral, scalar_first=True)
    for s, name in enumerate(BODY.segment_names):
        told = bones[name]
        expected = Rotation.from_quat(frame.q_wb[s], scalar_first=True)
        turn = Rotation.from_matrix(told["posed"]) * Rotation.from_matrix(told["rest"]).inv()
        assert (turn.inv() * expected * neutral.inv()).magnitude() < 2e-5, (
            name
        )  # Blender has floats of 32 bits
        np.testing.assert_allclose(told["head"], frame.p_w[s], atol=2e-5)
        tip = frame.p_w[s] + expected.apply(BODY.tips[s])
        np.testing.assert_allclose(told["tail"], tip, atol=2e-5)


def assert_shows(take: Take, k: int, bones: dict[str, dict]) -> None:
    """Joints where frame k has them, and bones without others beyond end where segments do."""
    assert set(bones) == set(take.skeleton.segment_names)
    for s, name in enumerate(take.skeleton.segment_names):
        np.testing.assert_allclose(bones[name]["head"], take.p_w[k, s], atol=1e-4)
        if s not in take.skeleton.parents:
            turn = Rotation.from_quat(take.q_wb[k, s], scalar_first=True)
            tip = take.p_w[k, s] + turn.apply(take.skeleton.tips[s])
            np.testing.assert_allclose(bones[name]["tail"], tip, atol=1e-4)


@pytest.mark.timeout(600)
def test_the_armature_is_the_body_live_and_recorded(tmp_path, record):
    encoder = JsonDatagrams(UdpJsonSettings(include={"position"}, body=True), BODY)
    frames = [pose(k) for k in range(3)]
    datagrams = [each.decode() for frame in frames for each in encoder.encode(frame)]
    assert len(datagrams) == 4  # the body once
    (tmp_path / "datagrams.json").write_text(json.dumps(datagrams))
    answer = tmp_path / "answer.json"
    command = f"{sys.executable} -m gateway"
    child, addon = (
        Path(__file__).parent / "blender_child.py",
        REPOSITORY / "examples/blender/mocap_gateway.py",
    )
    path = record()
    typed = [BLENDER, child, addon, tmp_path / "datagrams.json", path, command, answer]
    told = subprocess.run(typed, capture_output=True, text=True, check=False, timeout=500, cwd=REPOSITORY)
    assert answer.exists(), told.stderr
    found = json.loads(answer.read_text())
    assert len(found["live"]) == 3
    for frame, bones in zip(frames, found["live"], strict=True):
        assert_is(frame, bones)
    assert_is(frames[0], found["keyed"])
    recorded = take_of(open_recording(path).skeleton_arrays(), "walk", Axes.Z_UP)
    assert found["recording"]["frames"] == len(recorded.q_wb)
    assert found["recording"]["fps"] == round(recorded.rate_hz)
    assert_shows(recorded, 10, found["recording"]["bones"])
