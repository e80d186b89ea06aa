"""The table that ``watch`` shows."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from gateway.contract.messages import PoseMessage
from gateway.outputs.subscriber import ReceivedPose
from gateway.viewer.pose_table import PoseView, attitude

STANDING_EAST = Rotation.from_quat([0.7071, 0, 0, 0.7071])  # x anterior, y superior, z right
MS = 1_000_000


def received(sequence: int, at_ns: int, latency_ns: int = 3 * MS) -> ReceivedPose:
    pose = PoseMessage(
        t_ns=at_ns - latency_ns,
        seq=sequence,
        frame="ENU",
        order="wxyz",
        root="pelvis",
        segments={"pelvis": (0.7071, 0.7071, 0.0, 0.0), "left_thigh": None},
        status={"pelvis": "measured", "left_thigh": "warming_up"},
    )
    return ReceivedPose("lab", at_ns, pose, b"")


def shown(view: PoseView, now_ns: int, state: str = "online", with_quaternions: bool = False) -> str:
    text = io.StringIO()
    Console(file=text, width=120).print(view.table(now_ns, state, with_quaternions))
    return text.getvalue()


@pytest.mark.parametrize(
    ("heading", "pitch", "roll"),
    [(90, 0, 0), (0, 0, 0), (270, 0, 0), (45, 30, 0), (200, -60, 0), (10, 20, 30), (359, 5, -170)],
)
def test_attitude_is_the_rotation_it_names(heading: float, pitch: float, roll: float) -> None:
    # Turn about the vertical from east, then raise the nose about the left axis, then roll forward axis.
    turn = Rotation.from_euler("ZYX", [90 - heading, -pitch, roll], degrees=True)
    x, y, z, w = (turn * STANDING_EAST).as_quat()
    np.testing.assert_allclose(attitude((w, x, y, z)), (heading, pitch, roll), atol=1e-6)


def test_rate_latency_and_status_are_shown() -> None:
    view = PoseView("lab")
    for i in range(101):
        view.add(received(i, 10**9 + i * 20 * MS))
    assert view.rate_hz == pytest.approx(50)
    text = shown(view, 3 * 10**9 + 5 * MS)
    for words in ("online", "50.0 Hz", "latency 3.0 ms", "age 5 ms", "pelvis (root)", "90.0", "warming up"):
        assert words in text
    assert "–" in text
    assert "0.7071" in shown(view, 3 * 10**9, with_quaternions=True)


def test_no_rate_is_told_of_a_burst() -> None:
    view = PoseView("lab")
    for i in range(3):
        view.add(received(i, 10**9 + i * MS // 10))
    assert view.rate_hz is None
    assert "Hz" not in shown(view, 10**9 + MS)


def test_stale_data_is_said_plainly() -> None:
    view = PoseView("lab")
    assert "no pose yet" in shown(view, 0)
    view.add(received(0, 10**9))
    assert "no data for 7 s" in shown(view, 8 * 10**9, "offline")
    assert "offline" in shown(view, 8 * 10**9, "offline")


def test_only_the_last_two_seconds_count() -> None:
    view = PoseView("lab")
    for i in range(100):
        view.add(received(i, i * 100 * MS, latency_ns=500 * MS))  # 10 Hz, slow
    for i in range(300):
        view.add(received(100 + i, 10**10 + i * 10 * MS, latency_ns=MS))  # 100 Hz, quick
    assert view.rate_hz == pytest.approx(100)
    assert view.latency_s == pytest.approx(0.001)
