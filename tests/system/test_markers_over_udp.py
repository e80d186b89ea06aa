"""Markers sent as datagrams, a fitted subject, a real broker: an app receives the sender's pose."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time

import numpy as np
import orjson
import pytest

from devices.free_ports import free_port
from gateway.body.rig import load_rig
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.contract.balances import unaccounted
from gateway.errors import SettingsError
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.service.service import Service
from gateway.settings import GatewaySettings, LinkSettings, load_gateway_settings
from tests.marked_person import places_of, subject_file, y_up
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system
RATE_HZ, N_FRAMES = 50.0, 60


def truth(body: Skeleton, frame: int) -> FloatArray:
    """(S, 3, 3): the person turns, and raises the left arm."""
    neutral = quaternion.to_matrix(body.neutral)
    turned = rm.from_rotation_vector(np.array([0.0, 0.0, 0.01 * frame]))
    R = np.tile(turned @ neutral, (body.n_segments, 1, 1))
    raised = turned @ rm.from_rotation_vector(np.array([0.0, -0.008 * frame, 0.0])) @ neutral
    arm = [body.index(name) for name in ("left_upper_arm", "left_forearm", "left_hand")]
    R[arm] = raised
    return R


def message(body: Skeleton, markers: BodyMarkers, frame: int) -> bytes:
    """As an optical system with y up sends it, in mm, on its own clock; one marker is hidden now and then."""
    theirs = 1e3 * y_up(places_of(body, markers, truth(body, frame)))
    shown = {label: place.tolist() for label, place in zip(markers.labels, theirs, strict=True)}
    if frame % 3 == 0:
        shown["m5"] = None
    content = {"sequence": frame, "time_s": 1000.0 + frame / RATE_HZ, "unit": "mm", "markers": shown}
    return orjson.dumps(content)


@contextlib.asynccontextmanager
async def gateway_of(settings: GatewaySettings, received: list[ReceivedPose]):
    service = Service(settings, load_rig(settings.rig))
    async with running(service) as serving, PoseSubscriber(settings.mqtt, settings.gateway) as poses:

        async def collect() -> None:
            async for pose in poses:
                received.append(pose)  # noqa: PERF401 - what has come must show at once

        collecting = asyncio.create_task(collect())
        async with asyncio.timeout(60):
            while not service.mqtt.is_connected or service.links[0].state.value != "up":
                assert not serving.done()
                await asyncio.sleep(0.01)
        yield service
        collecting.cancel()


async def test_datagrams_of_markers_become_the_senders_pose(mosquitto, tmp_path):
    path, body, markers = subject_file(tmp_path, "y")
    port = free_port()
    config = tmp_path / "gateway.yaml"
    config.write_text(
        f"gateway: lab\nrig: {path}\n"
        f"links: [{{name: cameras, url: 'udp://127.0.0.1:{port}', carries: markers}}]\n"
        f"mqtt: {{port: {mosquitto.port}, decimals: null, include: [position]}}\n"
    )
    OpticalReconstructor(body, markers).update(
        MarkerFrame(0, 0, places_of(body, markers, truth(body, 0)))
    )  # compiles
    settings = load_gateway_settings(config)
    received: list[ReceivedPose] = []
    async with gateway_of(settings, received) as service:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", port))
            for frame in range(N_FRAMES):
                sender.send(message(body, markers, frame))
                if frame == 10:
                    sender.send(b'{"markers": "none"}')
                await asyncio.sleep(1 / RATE_HZ)
        counters, deadline_s = service.mqtt.counters, time.monotonic() + PATIENCE_S
        while (
            service.pipeline.skeleton_frames < N_FRAMES
            or counters.queued
            or len(received) < counters.published
        ):
            assert time.monotonic() < deadline_s, (len(received), counters, service.statistics())
            await asyncio.sleep(0.02)
            counters = service.mqtt.counters
        statistics = service.statistics()
        assert unaccounted(service.balances()) == {}
        assert statistics["markers"]["dropped"] == {"no_markers": 1}
        assert statistics["accounting"]["frames"]["total"] == N_FRAMES
    sequences = np.array([each.pose.seq for each in received])
    assert len(sequences) > N_FRAMES / 4  # a machine that cannot keep up publishes fewer, and counts them
    assert (np.diff(sequences) > 0).all()
    for each in received[5:]:
        for name, true in zip(body.segment_names, truth(body, each.pose.seq), strict=True):
            apart = quaternion.angle_between(np.array(each.pose.segments[name]), quaternion.from_matrix(true))
            assert np.degrees(apart) < 1.0, (each.pose.seq, name)
        np.testing.assert_allclose(each.pose.position["pelvis"], [0.3, -0.2, 0.95], atol=0.005)
    apart_ns = np.diff([each.pose.t_ns for each in received]) / np.diff(sequences)
    assert np.median(apart_ns) == pytest.approx(1e9 / RATE_HZ, rel=0.01)  # the sender's clock, not arrivals
    assert abs(received[-1].pose.t_ns - time.time_ns()) < 600e9


def test_another_method_for_a_subject_is_one_error_that_says_what_to_write(tmp_path):
    path, _, _ = subject_file(tmp_path, "y")
    links = [LinkSettings(name="cameras", url="udp://:9763", carries="markers")]
    settings = GatewaySettings(links=links, rig=str(path), mqtt=MqttSettings())
    assert Service(settings, load_rig(str(path))).pipeline.stage_of(MarkerFrame) is not None
    with pytest.raises(SettingsError, match="write 'reconstructor: optical', or leave it out"):
        Service(GatewaySettings(**{**dict(settings), "reconstructor": "joint"}), load_rig(str(path)))
    with pytest.raises(ValueError, match="wants all frames at once"):
        GatewaySettings(**{**dict(settings), "reconstructor": "published"})
