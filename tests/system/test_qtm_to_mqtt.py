"""QTM's protocol to MQTT poses through the whole service; QTM itself is a stand-in of ours."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from devices.emulators.qtm_stand_in import QtmStandIn
from devices.marker_files import MarkerTrial
from gateway.body.rig import load_rig
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.contract.balances import unaccounted
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.service.service import Service
from gateway.settings import load_gateway_settings
from tests.marked_person import places_of, subject_file, y_up
from tests.running_suit import running

pytestmark = pytest.mark.system
pytest.importorskip("qtm_rt", reason="the extra 'optical' is not installed")
RATE_HZ, N_FRAMES = 50.0, 80


def turned(body: Skeleton, frame: int) -> FloatArray:
    """(S, 3, 3): the whole body turns about the vertical, by more than a turn in all."""
    turn = rm.from_rotation_vector(np.array([0.0, 0.0, 0.1 * frame]))
    return np.tile(turn @ quaternion.to_matrix(body.neutral), (body.n_segments, 1, 1))


def captured(body: Skeleton, markers: BodyMarkers) -> MarkerTrial:
    """By a system with y up; one marker has lost its name."""
    positions = np.empty((N_FRAMES, len(markers.labels), 3))
    for frame in range(N_FRAMES):
        positions[frame] = y_up(places_of(body, markers, turned(body, frame)))
    labels = tuple("*7" if label == "m7" else label for label in markers.labels)
    return MarkerTrial("turn", labels, RATE_HZ, positions)


async def test_what_qtm_streams_comes_out_as_poses_and_a_hang_up_is_survived(mosquitto, tmp_path):
    # its file says z up; what QTM says counts
    path, body, markers = subject_file(tmp_path, "z")
    stand_in = QtmStandIn(captured(body, markers), up="+Y", left_out={20, 21}, repeats=True)
    await stand_in.start()
    config = tmp_path / "gateway.yaml"
    config.write_text(
        f"gateway: lab\nrig: {path}\nlinks: [{{name: cameras, url: 'qtm://127.0.0.1:{stand_in.port}'}}]\n"
        f"mqtt: {{port: {mosquitto.port}, decimals: null, include: [position]}}\n"
    )
    settings = load_gateway_settings(config)
    service = Service(settings, load_rig(settings.rig))
    received: list[ReceivedPose] = []
    async with (
        asyncio.timeout(100),
        PoseSubscriber(settings.mqtt, "lab", with_markers=True) as poses,
        running(service),
    ):
        async for pose in poses:
            received.append(pose)
            if len(received) == 60:
                stand_in.hang_up()
            if len(received) == 90:
                break
            if len(received) == 40:
                shown = poses.markers["lab"]
        statistics = service.statistics()
        assert unaccounted(service.balances()) == {}
    await stand_in.stop()
    assert service.links[0].reconnections == 1
    assert statistics["links"]["cameras"]["not_sent"] >= 2
    assert statistics["markers"]["dropped"] == {}
    assert shown.markers["m7"].taken_from == ""  # its name was lost on the way
    assert all(marker.used and marker.residual < 0.002 for marker in shown.markers.values())
    assert len(shown.unlabelled) == 1
    settled = received[5:60]
    for each in settled:
        np.testing.assert_allclose(each.pose.position["pelvis"], [0.3, -0.2, 0.95], atol=0.003)
        frame = each.pose.seq % N_FRAMES
        truth = quaternion.from_matrix(turned(body, frame)[0])
        for name in ("pelvis", "left_hand", "right_foot"):
            apart = quaternion.angle_between(np.array(each.pose.segments[name]), truth)
            assert np.degrees(apart) < 1.0, (each.pose.seq, name)
    instants = np.array([(each.pose.seq, each.pose.t_ns) for each in settled])
    assert (np.diff(instants, axis=0) > 0).all()
    apart_ns = np.diff(instants[:, 1]) / np.diff(instants[:, 0])
    assert np.median(apart_ns) == pytest.approx(1e9 / RATE_HZ, rel=0.02)
