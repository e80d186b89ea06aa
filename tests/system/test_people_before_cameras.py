"""Two people before cameras that serve over MQTT: they come, have a body each, and leave nothing."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.body.subject_file import write_subject
from gateway.cameras.broker_outlet import BrokerOutlet
from gateway.contract.balances import unaccounted
from gateway.contract.topics import CAMERA
from gateway.emulation.video_truth import messages_of, ring_of_cameras, walking
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.recording.video import video_subject, video_suit
from gateway.service.service import Service
from gateway.settings import load_gateway_settings
from tests.running_suit import running
from tests.served_cameras import ServedCameras

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow(reason="compiles the reconstruction from heat maps: a minute"),
]
KEYPOINTS = load_keypoint_set("blazepose_33")
CAMERAS = ring_of_cameras(3)
N, BOTH = 90, 45
PERIOD_S = 0.1


def config_of(folder, port: int, people: int):
    """A gateway before cameras over MQTT, with the cameras of anybody's file."""
    seen = messages_of(CAMERAS, KEYPOINTS, walking(KEYPOINTS, 24, (0.0, 0.0), (0.4, 0.0)))
    write_subject(folder / "room.yaml", video_subject("room", video_suit(CAMERAS, "full", seen)))
    (folder / "gateway.yaml").write_text(
        f"gateway: lab\nrig: room.yaml\npeople: {people}\n"
        f"links: [{{name: cameras, url: 'mqtt:///{CAMERA.format(camera='+')}', carries: heat_maps}}]\n"
        f"recording: {{at_start: true, folder: '{folder / 'takes'}'}}\n"
        f"mqtt: {{port: {port}, decimals: null, include: [position]}}\n"
    )
    return folder / "gateway.yaml"


async def play(broker: MqttSettings, instants, is_over=lambda: False) -> ServedCameras:
    """Serve instants of people's keypoints from cameras that listen to orders, in real time, slowly."""
    cameras = ServedCameras(CAMERAS, KEYPOINTS)
    outlets = [BrokerOutlet(broker, CAMERA.format(camera=camera.name)) for camera in CAMERAS]
    for outlet in outlets:
        await asyncio.to_thread(outlet.wait_for_first)
    for sequence, people in enumerate(instants):
        if is_over():
            break
        cameras.take(outlets[0].newest_line())
        messages = await asyncio.to_thread(cameras.messages, people, sequence)
        for outlet, message in zip(outlets, messages, strict=True):
            outlet.offer(message)
        await asyncio.sleep(PERIOD_S)
    for outlet in outlets:
        await asyncio.to_thread(outlet.close)
    return cameras


async def test_two_people_come_and_go(mosquitto, tmp_path):
    config = config_of(tmp_path, mosquitto.port, 4)
    settings = load_gateway_settings(config)
    a = walking(KEYPOINTS, N, (-0.6, -0.4), (0.3, 0.0)).keypoints
    b = walking(KEYPOINTS, N, (0.7, 0.4), (-0.3, 0.1), phase=1.0).keypoints
    hips = [k for k, name in enumerate(KEYPOINTS.names) if name.endswith("_hip")]
    both = [np.stack([a[f], b[f]]) for f in range(BOTH)] + [b[f : f + 1] for f in range(BOTH, N)]
    places: dict[str, list[tuple[int, list[float]]]] = {}
    service = Service(settings, load_rig(settings.rig, config))

    async with asyncio.timeout(240), PoseSubscriber(settings.mqtt) as poses:

        async def collect() -> None:
            async for received in poses:
                place = received.pose.position["pelvis"]
                places.setdefault(received.gateway, []).append((received.pose.seq, place))

        async with running(service):
            collecting = asyncio.create_task(collect())
            await service.begun.wait()
            await play(settings.mqtt, both)
            assert service.people is not None
            assert len(service.people.crowd.present) == 1, service.statistics()
            for _ in range(50):
                if len(poses.bodies) == 2:
                    break
                await asyncio.sleep(0.1)
            (there,) = service.people.crowd.present
            assert set(poses.bodies) == {"lab", f"lab_{there}"}
            assert unaccounted(service.balances()) == {}
        collecting.cancel()
    assert set(places) == {"lab_1", "lab_2"}
    for truth in (a, b):
        middle = truth[:, hips].mean(axis=1)
        off = [
            np.median([np.linalg.norm(place - middle[seq]) for seq, place in told if seq < BOTH])
            for told in places.values()
        ]
        assert min(off) < 0.15
    takes = [open_recording(take) for take in sorted((tmp_path / "takes").glob("*_[12].mcap"))]
    assert len(takes) == 2
    assert all(verify(take).is_identical for take in takes)
