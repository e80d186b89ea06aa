"""Markers on the live page: drawn with the pose that they belong to, and gone when they stop."""

from __future__ import annotations

import pytest

from gateway.contract.messages import MarkersMessage, PoseMessage
from gateway.outputs.subscriber import ReceivedPose

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from gateway.viewer.live_markers import LiveMarkers  # noqa: E402 - needs the extra
from gateway.viewer.marker_points import LEFT_OUT, NAMELESS, NEAR  # noqa: E402 - needs the extra
from gateway.viewer.stage import ViewerStage  # noqa: E402 - needs the extra


def pose(number: int) -> ReceivedPose:
    told = PoseMessage(
        t_ns=number * 10**7, seq=number, frame="ENU", order="wxyz", root="pelvis",
        segments={"pelvis": (1.0, 0.0, 0.0, 0.0)}, status={"pelvis": "measured"},
    )  # fmt: skip
    return ReceivedPose("lab", number * 10**7, told, b"")


def markers(number: int) -> MarkersMessage:
    place = {"expected": [0.1, 0.0, 0.9]}
    return MarkersMessage.model_validate(
        {
            "t_ns": number * 10**7,
            "seq": number,
            "frame": "ENU",
            "markers": {
                "near": {**place, "position": [0.1, 0.0, 0.902], "residual": 0.002, "used": True},
                "ghost": {**place, "position": [0.5, 0.0, 0.9], "residual": 0.4, "used": False},
                "hidden": {**place, "position": None, "residual": None, "used": False},
            },
            "unlabelled": [[1.0, 1.0, 1.0]],
        }
    )


def test_the_pose_of_the_newest_markers_is_drawn_with_them():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        live = LiveMarkers(server, ViewerStage(server))
        for number in range(1, 9):
            live.add(pose(number))
        shown, instant = live.pose_of(markers(6), pose(8))
        assert shown.pose.seq == 6
        assert instant.labels == ("near", "ghost")
        assert instant.summary() == (
            "2 markers, 2.0 mm RMS from the body, 1 left out",
            "farthest, mm: ghost 400, near 2",
        )
        live.draw(instant)
        colours = [tuple(colour) for colour in live._scene._points.colors.tolist()]
        assert colours == [NEAR, LEFT_OUT, NAMELESS]
        live.draw(None)
        assert not live._scene._points.visible
    finally:
        server.stop()


@pytest.mark.parametrize("message", [None, markers(200), markers(7)])
def test_without_markers_of_now_the_latest_pose_is_drawn_alone(message):
    """None came; they are too old, or of a pose that was never received."""
    live = LiveMarkers(None, None)
    live.add(pose(1))
    live.add(pose(9))
    assert live.pose_of(message, pose(9)) == (pose(9), None)
    live.draw(None)
    assert live._scene is None
