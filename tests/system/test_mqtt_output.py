"""The MQTT output against mosquitto, while all is well."""

from __future__ import annotations

import asyncio
import logging
import shutil
import subprocess
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import aiomqtt
import orjson
import ormsgpack
import pytest

from devices.link import gateway_time_ns
from gateway.contract import topics
from gateway.contract.messages import PUBLICATIONS, ModuleAvailability, ModuleState
from gateway.contract.properties import MSGPACK
from gateway.outputs.connection import broker_connection
from gateway.outputs.failover import BrokerUnreachableError
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import PASSWORD_VARIABLE, MqttSettings, PoseFormat, PoseMap, TlsSettings
from gateway.outputs.subscriber import PoseSubscriber
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.poses import PoseSource

Until = Callable[..., Awaitable[None]]

pytestmark = pytest.mark.system

NEVER_HEARD = ModuleState(
    **dict.fromkeys(ModuleState.model_fields)
    | {"t_ns": 1, "module": 7, "availability": "offline", "gaps": {}}
    | dict.fromkeys(("received", "lost", "duplicates", "late", "resets"), 0)
)


async def retained(settings: MqttSettings) -> dict[str, bytes]:
    """Retained messages as a client that comes later sees them, before what is published then."""
    found = {}
    async with broker_connection(settings, settings.port, "late-comer") as client:
        await client.subscribe("#", qos=1)
        await client.publish("no/more", qos=1)
        async with asyncio.timeout(PATIENCE_S):
            async for message in client.messages:
                if message.topic.value == "no/more":
                    break
                found[message.topic.value] = message.payload
    return found


async def messages_of(client: aiomqtt.Client) -> AsyncIterator[tuple[str, bytes]]:
    async for message in client.messages:
        yield message.topic.value, message.payload


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
async def test_every_message_is_what_its_model_says(
    mosquitto: Mosquitto, pose_source: PoseSource, protocol: str, until: Until
) -> None:
    settings = MqttSettings(
        port=mosquitto.port,
        protocol=protocol,
        include=frozenset(PoseMap),
        health_interval=0.1,
        pose_formats=frozenset(PoseFormat),
        segment_rate=10,
        predict_ms=20,
    )
    # Of two gateways; of a body with markers; of a robot; of a broker that was away; of a cluster.
    others = {
        topics.COMPARISON,
        topics.MARKERS,
        topics.ROBOT,
        topics.LATE_POSE,
        topics.BRIDGE_ECHO,
    }
    own = [publication for publication in PUBLICATIONS if publication.topic not in others]
    published = {f"mocap/lab/{p.topic.format(id=7, name='segment_3')}": p for p in own}
    async with broker_connection(settings, mosquitto.port, "reader") as reader:
        await reader.subscribe("#", qos=1)
        statistics = {"links": {"left": {"dropped": 0}}, "residual_us": float("nan")}
        async with MqttOutput(
            settings, pose_source.skeleton, pose_source.info(), lambda: statistics
        ) as output:
            await until(lambda: output.is_connected)
            output.offer(pose_source.frame(1))
            output.keep("module/7/availability", ModuleAvailability(state="online"))
            output.keep("module/7/state", NEVER_HEARD)
            seen: dict[str, object] = {}
            async with asyncio.timeout(PATIENCE_S):
                async for topic, payload in messages_of(reader):
                    if topic not in published:
                        assert topic.startswith("mocap/lab/segment/")
                        continue
                    is_packed = published[topic].content_type == MSGPACK
                    json = orjson.dumps(ormsgpack.unpackb(payload)) if is_packed else payload
                    seen[topic] = published[topic].model.model_validate_json(json)
                    if len(seen) == len(published):
                        break
    assert seen["mocap/lab/bridge/health"].statistics == statistics | {"residual_us": None}
    pose = seen["mocap/lab/pose"]
    assert seen["mocap/lab/pose/msgpack"] == pose
    segment = seen["mocap/lab/segment/segment_3"]
    assert segment.orientation == pose.segments["segment_3"]
    assert segment.position == pose.position["segment_3"]
    assert segment.sigma == pose.sigma["segment_3"]
    assert (pose.seq, pose.root, set(pose.position)) == (
        1,
        "segment_0",
        set(pose_source.skeleton.segment_names),
    )


async def test_state_info_and_body_are_retained_and_a_clean_stop_says_offline(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    settings = MqttSettings(port=mosquitto.port)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        output.offer(pose_source.frame(1))
        await until(lambda: output.counters.published == 1)
        online = await retained(settings)
    assert set(online) == {f"mocap/lab/{p.topic}" for p in PUBLICATIONS if p.retain and "{id}" not in p.topic}
    assert online["mocap/lab/bridge/state"] == b'{"state":"online"}'
    assert (await retained(settings))["mocap/lab/bridge/state"] == b'{"state":"offline"}'


async def test_what_is_queued_is_published_before_the_stop(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    settings = MqttSettings(port=mosquitto.port, queue_length=50)
    async with PoseSubscriber(settings) as poses:
        async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
            await until(lambda: output.is_connected)
            for sequence in range(50):
                output.offer(pose_source.frame(sequence))
        async with asyncio.timeout(PATIENCE_S):
            received = [(await anext(aiter(poses))).pose.seq for _ in range(50)]
    assert received == list(range(50))
    assert (output.counters.published, output.counters.dropped) == (50, 0)


async def test_a_burst_is_published_whole_to_a_broker_that_takes_it(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    """A machine that was busy hands over many chunks at once: the broker is as quick as ever."""
    settings = MqttSettings(port=mosquitto.port)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        for sequence in range(300):
            output.offer(pose_source.frame(sequence))
        await until(lambda: output.counters.published == 300)
        assert output.counters.dropped == 0


async def test_a_loop_with_much_to_do_publishes_every_pose(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    """Each message once took several turns of the loop, of which each has samples to handle."""
    settings = MqttSettings(port=mosquitto.port, queue_length=8)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        for sequence in range(60):
            output.offer(pose_source.frame(sequence))
            output.offer(pose_source.frame(sequence))
            time.sleep(0.02)  # noqa: ASYNC251 - what a turn of a busy loop takes
            await asyncio.sleep(0)
        assert output.counters.published > 100
        await until(lambda: output.counters.published == 120)


async def test_poses_arrive_soon_and_all_of_them(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    settings = MqttSettings(port=mosquitto.port)
    async with (
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
        PoseSubscriber(settings) as poses,
        broker_connection(settings, mosquitto.port, "echo") as echo,
    ):
        await until(lambda: output.is_connected)
        await echo.subscribe("echo")
        latencies, echoes_s = [], []
        for sequence in range(60):
            output.offer(pose_source.frame(sequence))
            received = await asyncio.wait_for(anext(aiter(poses)), PATIENCE_S)
            assert received.pose.seq == sequence
            latencies.append(received.latency_s)
            sent_ns = gateway_time_ns()
            await echo.publish("echo", received.payload)
            await asyncio.wait_for(anext(aiter(echo.messages)), PATIENCE_S)
            echoes_s.append((gateway_time_ns() - sent_ns) * 1e-9)
            await asyncio.sleep(0.01)
    assert median(latencies) < 0.004 + 2 * median(echoes_s)


async def test_two_gateways_do_not_disturb_each_other(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    settings = MqttSettings(port=mosquitto.port)
    async with (
        PoseSubscriber(settings, "one") as only_one,
        PoseSubscriber(settings) as both,
        MqttOutput(settings, pose_source.skeleton, pose_source.info("one")) as one,
    ):
        async with MqttOutput(settings, pose_source.skeleton, pose_source.info("two")) as two:
            await until(lambda: one.is_connected and two.is_connected)
            for sequence in range(20):
                two.offer(pose_source.frame(100 + sequence))
                one.offer(pose_source.frame(sequence))
                await asyncio.sleep(0.005)
            seen = [await asyncio.wait_for(anext(aiter(both)), PATIENCE_S) for _ in range(40)]
            expected_of_one = [received.pose.seq for received in seen if received.gateway == "one"]
            of_one = [await asyncio.wait_for(anext(aiter(only_one)), PATIENCE_S) for _ in range(20)]
        await until(lambda: both.states == {"one": "online", "two": "offline"})
        assert only_one.states == {"one": "online"}
        assert [received.pose.seq for received in of_one] == expected_of_one == list(range(20))
        assert one.counters.connections == two.counters.connections == 1


async def test_named_user_with_password_from_the_environment(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    until: Until,
) -> None:
    passwords = tmp_path / "passwords"
    command = ["mosquitto_passwd", "-b", "-c", str(passwords), "suit", "open sesame"]
    await asyncio.to_thread(subprocess.run, command, check=True)
    mosquitto.configure(f"allow_anonymous false\npassword_file {passwords}")
    mosquitto.restart()
    monkeypatch.setenv(PASSWORD_VARIABLE, "open sesame")
    settings = MqttSettings(port=mosquitto.port, username="suit")
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)


async def certify(mosquitto: Mosquitto, folder: Path) -> Path:
    """Start the broker anew with a certificate of its own, and return that."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed: no certificate for the broker")
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=localhost "
        f"-addext subjectAltName=IP:127.0.0.1 -keyout {key} -out {certificate}"
    )
    await asyncio.to_thread(subprocess.run, command.split(), check=True, capture_output=True)
    mosquitto.configure(f"certfile {certificate}\nkeyfile {key}")
    mosquitto.restart()
    return certificate


async def test_a_broker_that_comes_back_with_another_certificate_is_told(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    tmp_path: Path,
    until: Until,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The log said that it was lost, and nothing more for as long as it was refused."""
    kept = tmp_path / "kept.pem"
    kept.write_bytes((await certify(mosquitto, tmp_path)).read_bytes())
    settings = MqttSettings(port=mosquitto.port, tls=TlsSettings(ca_file=kept))
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        await certify(mosquitto, tmp_path)
        await until(lambda: "check tls.ca_file" in caplog.text)
    assert "Unspecified error" not in caplog.text


async def test_tls(mosquitto: Mosquitto, pose_source: PoseSource, tmp_path: Path, until: Until) -> None:
    certificate = await certify(mosquitto, tmp_path)
    settings = MqttSettings(port=mosquitto.port, tls=TlsSettings(ca_file=certificate))
    async with (
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
        PoseSubscriber(settings) as poses,
    ):
        await until(lambda: output.is_connected)
        output.offer(pose_source.frame(5))
        assert (await asyncio.wait_for(anext(aiter(poses)), PATIENCE_S)).pose.seq == 5
    for tls, words in (
        (TlsSettings(), "check tls.ca_file"),
        (TlsSettings(ca_file=tmp_path / "absent.pem"), "cannot read tls.ca_file .*absent.pem"),
    ):
        with pytest.raises(BrokerUnreachableError, match=words):
            await PoseSubscriber(MqttSettings(port=mosquitto.port, tls=tls)).__aenter__()


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
@pytest.mark.parametrize(("username", "words"), [("suit", "refuses user 'suit'"), (None, "set username")])
async def test_refusal_names_the_user_and_never_the_password(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    username: str | None,
    words: str,
    protocol: str,
    until: Until,
    attempts: list[float],
) -> None:
    mosquitto.configure("allow_anonymous false")
    mosquitto.restart()
    monkeypatch.setenv(PASSWORD_VARIABLE, "open sesame")
    caplog.set_level(logging.DEBUG)
    settings = MqttSettings(port=mosquitto.port, username=username, protocol=protocol)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: words in caplog.text)
        await until(lambda: len(attempts) > 2)  # a second has failed: no second line
        assert not output.is_connected
    warnings = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert "open sesame" not in caplog.text
