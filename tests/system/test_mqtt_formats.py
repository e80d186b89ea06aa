"""What a broker relays beside JSON poses: encodings, properties, single segments, discovery."""

from __future__ import annotations

import asyncio

import aiomqtt
import orjson
import ormsgpack
import pytest

from gateway.contract.messages import BridgeInfo, ModuleInfo
from gateway.outputs.connection import broker_connection
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings, PoseFormat
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system


async def gather(client, n, of):
    """The first n messages whose topic holds ``of``."""
    found = []
    async with asyncio.timeout(PATIENCE_S):
        async for message in client.messages:
            if of in message.topic.value:
                found.append(message)
                if len(found) == n:
                    return found
    return found


async def test_content_type_and_expiry_with_mqtt_5(mosquitto, pose_source, until):
    settings = MqttSettings(
        port=mosquitto.port, protocol="5", pose_formats=frozenset(PoseFormat), pose_expiry_s=7
    )
    async with (
        aiomqtt.Client("127.0.0.1", mosquitto.port, protocol=aiomqtt.ProtocolVersion.V5) as reader,
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
    ):
        await reader.subscribe("mocap/#")
        await until(lambda: output.is_connected)
        output.offer(pose_source.frame(3))
        found = {m.topic.value: m for m in await gather(reader, 2, "/pose")}
        await reader.unsubscribe("mocap/#")
        await reader.subscribe("mocap/lab/body")
        (body,) = await gather(reader, 1, "/body")
    json, packed = found["mocap/lab/pose"], found["mocap/lab/pose/msgpack"]
    assert json.properties.ContentType == "application/json"
    assert packed.properties.ContentType == "application/msgpack"
    assert 6 <= json.properties.MessageExpiryInterval <= 7
    assert 6 <= packed.properties.MessageExpiryInterval <= 7
    assert ormsgpack.unpackb(packed.payload) == orjson.loads(json.payload)
    assert len(packed.payload) < len(json.payload)
    assert body.properties.ContentType == "application/json"
    assert not hasattr(body.properties, "MessageExpiryInterval")


async def test_segments_keep_to_their_rate(mosquitto, pose_source, until):
    settings = MqttSettings(port=mosquitto.port, segment_rate=10, queue_length=200)
    async with (
        broker_connection(settings, mosquitto.port, "reader") as reader,
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
    ):
        await reader.subscribe("mocap/lab/segment/segment_0")
        await reader.subscribe("mocap/lab/pose")
        await until(lambda: output.is_connected)
        for i in range(100):  # one second at 100 Hz
            output.offer(pose_source.frame(i, 10_000_000 * i))
        await until(lambda: output.counters.published == 100)
        topics = [message.topic.value for message in await gather(reader, 110, "mocap/lab/")]
    assert topics.count("mocap/lab/pose") == 100
    assert topics.count("mocap/lab/segment/segment_0") == 10


async def test_only_msgpack_where_only_that_is_asked_for(mosquitto, pose_source, until):
    settings = MqttSettings(port=mosquitto.port, pose_formats={"msgpack"})
    async with (
        broker_connection(settings, mosquitto.port, "reader") as reader,
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
    ):
        await reader.subscribe("mocap/lab/pose/#")
        await until(lambda: output.is_connected)
        for i in range(2):
            output.offer(pose_source.frame(i))
        topics = [message.topic.value for message in await gather(reader, 2, "/pose")]
    assert topics == ["mocap/lab/pose/msgpack"] * 2


async def test_home_assistant_finds_diagnostics_and_nothing_else(mosquitto, pose_source, until):
    info = BridgeInfo(
        version="1.2", gateway="lab", reconstructor="independent", frame_rate=100,
        modules=(ModuleInfo(module=3, segment="pelvis"), ModuleInfo(module=4, segment="head")),
    )  # fmt: skip
    settings = MqttSettings(port=mosquitto.port, home_assistant="homeassistant")
    async with MqttOutput(settings, pose_source.skeleton, info) as output:
        await until(lambda: output.is_connected)
        output.offer(pose_source.frame(0))
        await until(lambda: output.counters.published == 1)
        async with broker_connection(settings, mosquitto.port, "home") as home:
            await home.subscribe("homeassistant/#")
            found = {m.topic.value: m for m in await gather(home, 9, "homeassistant/")}
    assert all(message.retain for message in found.values())
    configs = {topic: orjson.loads(message.payload) for topic, message in found.items()}
    assert len({config["unique_id"] for config in configs.values()}) == 9
    battery = configs["homeassistant/sensor/mocap_lab/module_3_battery/config"]
    assert battery["state_topic"] == "mocap/lab/module/3/state"
    assert {each["topic"] for each in battery["availability"]} == {
        "mocap/lab/bridge/state",
        "mocap/lab/module/3/availability",
    }
    assert all("pose" not in config["state_topic"] for config in configs.values())


def test_values_of_home_assistant_are_those_of_the_state():
    """Its templates name fields of the message that they are rendered with."""
    from gateway.contract.messages import ModuleClockState, ModuleState  # noqa: PLC0415
    from gateway.contract.topics import Topics  # noqa: PLC0415
    from gateway.outputs.home_assistant import discovery  # noqa: PLC0415

    jinja2 = pytest.importorskip("jinja2")
    info = BridgeInfo(
        version="1", gateway="lab", reconstructor="independent", frame_rate=100,
        modules=(ModuleInfo(module=3, segment="pelvis"),),
    )  # fmt: skip
    clock = ModuleClockState(
        state="settled", offset_ns=0, ppm=12.5, residual_us=1, sigma_us=1, bound_us=None, steps=0
    )
    state = ModuleState(
        **dict.fromkeys(ModuleState.model_fields)
        | {"t_ns": 1, "module": 3, "availability": "online", "gaps": {}, "clock": clock}
        | dict.fromkeys(("duplicates", "late", "resets"), 0)
        | {"received": 75, "lost": 25, "battery_percent": 88}
    )
    rendered = {
        topic.split("/")[3]: jinja2.Template(orjson.loads(payload)["value_template"]).render(
            value_json=orjson.loads(state.payload())
        )
        for topic, payload in discovery("homeassistant", Topics("mocap", "lab"), info)
        if "/sensor/" in topic
    }
    assert rendered == {"module_3_battery": "88", "module_3_loss": "25.0", "module_3_clock": "12.5"}
