"""The doctor at cameras behind a broker: it answers, it lets us listen, somebody sends."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps
from gateway.doctor.broker import camera_topic
from gateway.doctor.examination import examine
from gateway.doctor.findings import Verdict
from gateway.outputs.connection import broker_connection
from gateway.outputs.settings import MqttSettings
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system
LINK = LinkSettings(name="cameras", url="mqtt:///mocap_cameras/+", carries="heat_maps")


async def found_while(mqtt, sent):
    """The findings by subject, while ``sent`` (topic to payload) is published again and again."""

    is_sending = asyncio.Event()

    async def send():
        async with broker_connection(mqtt, mqtt.port, "camera") as client:
            while True:
                for topic, payload in sent.items():
                    await client.publish(topic, payload)
                is_sending.set()
                await asyncio.sleep(0.02)

    sending = asyncio.create_task(send())
    await asyncio.wait_for(is_sending.wait(), PATIENCE_S)
    found = await camera_topic(LINK, mqtt, 0.8)
    sending.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await sending
    return {finding.subject: finding for finding in found}


async def test_cameras_that_send_are_named(mosquitto):
    mosquitto.is_for_gateways_only = False
    mqtt = MqttSettings(port=mosquitto.port)
    heat_maps = encode_heat_maps(HeatMapMessage("a", "full", 0, 0, None, np.zeros((2, 3))))
    found = await found_while(mqtt, {"mocap_cameras/a": heat_maps, "mocap_cameras/b": heat_maps})
    assert {finding.verdict for finding in found.values()} == {Verdict.GOOD}
    assert f"at 127.0.0.1:{mosquitto.port}: the broker answers" in found["cameras: port"].found
    assert "mocap_cameras/a" in found["cameras: data"].found
    assert "mocap_cameras/b" in found["cameras: data"].found


async def test_silence_and_strangers_are_told(mosquitto):
    mosquitto.is_for_gateways_only = False
    mqtt = MqttSettings(port=mosquitto.port)
    silent = await camera_topic(LINK, mqtt, 0.1)
    assert [finding.verdict for finding in silent] == [Verdict.GOOD, Verdict.WARNING]
    assert "no camera sends on mocap_cameras/+" in silent[1].found
    assert "video serve-camera" in silent[1].remedy
    assert len(await camera_topic(LINK, mqtt, 0.0)) == 1
    strange = await found_while(mqtt, {"mocap_cameras/kitchen": b"21.5"})
    assert "no camera sends" in strange["cameras: data"].found
    assert "something else than heat maps comes on mocap_cameras/kitchen" in strange["cameras: topic"].found


async def test_a_topic_that_may_not_be_read(unused_port):
    """By a broker of a few lines: mosquitto grants every subscription, and then sends nothing."""

    async def refuse(reader, writer):
        await reader.read(1024)
        writer.write(b"\x20\x02\x00\x00")  # connected
        asked = await reader.read(1024)
        writer.write(b"\x90\x03" + asked[2:4] + b"\x80")  # subscription refused
        await reader.read(1024)
        writer.close()

    async with await asyncio.start_server(refuse, "127.0.0.1", unused_port):
        (finding,) = await camera_topic(LINK, MqttSettings(port=unused_port), 0.1)
    assert finding.verdict is Verdict.BAD
    assert "answers and refuses to let us listen" in finding.found
    assert "mocap_cameras/+" in finding.remedy


@pytest.mark.parametrize(
    ("mqtt", "url", "verdict", "found", "remedy"),
    [
        ({}, "mqtt:///a/+", Verdict.BAD, "no MQTT broker at 127.0.0.1:", "is mosquitto running?"),
        ({}, "mqtt://host/a", Verdict.BAD, "the broker is that of the section 'mqtt'", "write mqtt:///TOPIC"),
        ({"broker": "embedded"}, "mqtt:///a/+", Verdict.GOOD, "at the embedded broker, port", ""),
    ],
)
def test_what_stands_in_the_configuration(mqtt, url, verdict, found, remedy, unused_port, tmp_path):
    link = {"name": "cameras", "url": url, "carries": "heat_maps"}
    settings = GatewaySettings(links=[link], rig="single", mqtt={"port": unused_port, **mqtt})
    findings = {f.subject: f for f in examine(settings, tmp_path / "gateway.yaml", 100.0, 0.0)}
    finding = findings["cameras: port"]
    assert finding.verdict is verdict
    assert found in finding.found
    assert remedy in finding.remedy
