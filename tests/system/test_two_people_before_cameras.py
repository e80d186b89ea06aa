"""Markers of two people on one link, two fitted subjects: two bodies over MQTT, and two recordings."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from pathlib import Path

import numpy as np
import orjson
import pytest

from devices.free_ports import free_port
from gateway.body.rig import load_rig
from gateway.errors import GatewayError, SettingsError
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.recording import open_recording
from gateway.service.further_bodies import further_bodies
from gateway.service.service import Service
from gateway.settings import load_gateway_settings
from tests.marked_person import places_of, subject_file, y_up
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system
TURNED = {"Anna": 0.2, "Bert": -0.9}
"""By which each is turned about the vertical, rad."""
BESIDE_M = 1.5


def posture(subject, person: str) -> FloatArray:
    """(S, 3, 3): a person who stands, turned."""
    neutral = quaternion.to_matrix(subject.neutral)
    return np.tile(rm.from_rotation_vector(np.array([0.0, 0.0, TURNED[person]])) @ neutral, (17, 1, 1))


def message(body, markers, frame: int) -> bytes:
    """Both people's markers, each behind the person's name."""
    shown = {}
    for number, person in enumerate(TURNED):
        beside = np.array([number * BESIDE_M, 0.0, 0.0])
        theirs = y_up(places_of(body, markers, posture(body, person)) + beside)
        shown |= {f"{person}:{m}": p.tolist() for m, p in zip(markers.labels, theirs, strict=True)}
    return orjson.dumps({"sequence": frame, "time_s": frame / 50, "markers": shown})


def config_file(folder: Path, subject: Path, broker_port: int, port: int) -> Path:
    config = folder / "gateway.yaml"
    config.write_text(
        f"gateway: lab\nrig: {subject.name}\n"
        f"links: [{{name: cameras, url: 'udp://127.0.0.1:{port}', carries: markers, person: Anna}}]\n"
        f"bodies: [{{name: bert, subject: {subject.name}, person: Bert}}]\n"
        f"recording: {{at_start: true, folder: '{folder / 'takes'}'}}\n"
        f"mqtt: {{port: {broker_port}, decimals: null, include: [position]}}\n"
    )
    return config


async def test_two_people_are_two_bodies_and_two_recordings(mosquitto, tmp_path):
    path, body, markers = subject_file(tmp_path, "y")
    OpticalReconstructor(body, markers).update(
        MarkerFrame(0, 0, places_of(body, markers, posture(body, "Anna")))
    )  # compiles
    port = free_port()
    config = config_file(tmp_path, path, mosquitto.port, port)
    settings = load_gateway_settings(config)
    others = further_bodies(settings, config)
    service = Service(settings, load_rig(settings.rig, config), others=others)
    received: dict[str, list[ReceivedPose]] = {"lab": [], "lab_bert": []}

    async def collect(name: str) -> None:
        async with PoseSubscriber(settings.mqtt, name) as poses:
            async for pose in poses:
                received[name].append(pose)

    tasks = [asyncio.create_task(collect(name)) for name in received]
    serving = asyncio.create_task(service.run())
    try:
        deadline_s, frame = time.monotonic() + PATIENCE_S, 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", port))
            while min(map(len, received.values())) < 5:
                assert time.monotonic() < deadline_s
                assert not serving.done()
                with contextlib.suppress(ConnectionRefusedError):
                    sender.send(message(body, markers, frame))
                frame += 1
                await asyncio.sleep(0.02)
    finally:
        for task in (*tasks, serving):
            task.cancel()
        await asyncio.gather(*tasks, serving, return_exceptions=True)
    for (name, poses), (person, number) in zip(received.items(), (("Anna", 0), ("Bert", 1)), strict=True):
        pose = poses[-1].pose
        true = quaternion.from_matrix(posture(body, person)[0])
        assert np.degrees(quaternion.angle_between(np.array(pose.segments["pelvis"]), true)) < 0.5, name
        assert pose.position["pelvis"] == pytest.approx([0.3 + number * BESIDE_M, -0.2, 0.95], abs=0.003)
    takes = sorted((tmp_path / "takes").glob("*.mcap"))
    assert len(takes) == 2
    places = sorted(open_recording(take).skeleton_arrays().p_w[-1, 0, 0] for take in takes)
    assert places == pytest.approx([0.3, 0.3 + BESIDE_M], abs=0.003)


def test_a_further_body_needs_markers_and_a_link_that_carries_them(tmp_path):
    path, _, _ = subject_file(tmp_path, "y")
    config = config_file(tmp_path, path, 1883, 9763)
    config.write_text(config.read_text().replace(f"subject: {path.name}", "subject: suit_17"))
    with pytest.raises(SettingsError, match="'suit_17' is no subject with markers"):
        further_bodies(load_gateway_settings(config), config)
    config.write_text("rig: suit_17\nlinks: [{name: a, url: /dev/x}]\nbodies: [{name: b, subject: c.yaml}]\n")
    with pytest.raises(GatewayError, match="bodies: no link carries markers"):
        load_gateway_settings(config)
