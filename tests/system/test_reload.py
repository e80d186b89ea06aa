"""A changed configuration that cannot run leaves the old service at work, which says why."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import socket

import aiomqtt
import orjson
import pytest
import yaml

from gateway.cli import run
from gateway.errors import GatewayError
from gateway.service.service import Service
from tests.system.test_observability import fetch

pytestmark = pytest.mark.system


@contextlib.contextmanager
def taken_port():
    """A port that somebody else listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


class Running:
    """A supervisor, as ``run`` has one, in the test's event loop."""

    def __init__(self, file, changes):
        self.file, self.base = file, changes
        self.write()
        self.supervisor = run._Supervisor(file, run._load(file))
        self.task = None

    def write(self, **changes):
        self.file.write_text(yaml.safe_dump({**self.base, **changes}))

    @property
    def service(self):
        return self.supervisor._service

    async def reload(self, **changes):
        self.write(**changes)
        await self.supervisor._read_anew(switch_after_s=0.0)


@pytest.fixture
async def gateway(request, mosquitto, tmp_path, unused_port, until, monkeypatch):
    """A running gateway with metrics and a recording, read from a file; its parameter: further settings of
    MQTT."""
    monkeypatch.setattr(run, "set_up_logging", lambda *_: None)  # that of the tests stays
    settings = {
        "gateway": f"reloaded_{os.getpid()}",
        "links": [{"name": "suit", "url": str(tmp_path / "absent")}],
        "rig": "single",
        "reconstructor": "independent",
        "mqtt": {"port": mosquitto.port, **getattr(request, "param", {})},
        "metrics": {"port": unused_port},
        "recording": {"folder": str(tmp_path / "recordings"), "at_start": True, "min_free_mb": 0},
    }
    running = Running(tmp_path / "gateway.yaml", settings)
    running.task = asyncio.create_task(running.supervisor.run())
    await until(lambda: running.service.mqtt.is_connected)
    yield running
    running.supervisor._stop()
    await running.task


def impossible(case, gateway, tmp_path):
    """A change that cannot run, and what is said of it."""
    mqtt, recording = gateway.base["mqtt"], gateway.base["recording"]
    if case == "no such folder":
        (tmp_path / "file").write_text("")
        return {
            "recording": {**recording, "folder": str(tmp_path / "file" / "in")}
        }, "recordings cannot go to"
    if case == "too little disk":
        return {"recording": {**recording, "min_free_mb": 1e9}}, "MB free, less than"
    if case == "no such recording to replay":
        return {"links": [{"name": "suit", "url": f"recording://{tmp_path}/absent.mcap"}]}, "absent.mcap"
    absent = str(tmp_path / "password")
    return {"mqtt": {**mqtt, "username": "suit", "password_file": absent}}, "cannot read password_file"


@pytest.mark.parametrize(
    "case", ["no such folder", "too little disk", "no such recording to replay", "no password file"]
)
async def test_what_cannot_be_opened_leaves_the_old_service_at_work(gateway, tmp_path, case, caplog):
    change, words = impossible(case, gateway, tmp_path)
    before = gateway.service
    with pytest.raises(GatewayError, match=words):
        await gateway.reload(**change)
    assert "the old one stays" in caplog.text
    await assert_at_work(gateway, before)


@pytest.mark.parametrize("what", ["metrics", "embedded", "websocket"])
async def test_a_port_that_is_taken_leaves_the_old_service_at_work(gateway, what, unused_port):
    before = gateway.service
    with taken_port() as port:
        changes = {
            "metrics": {"metrics": {"port": port}},
            "embedded": {"mqtt": {"broker": "embedded", "port": port}},
            "websocket": {"mqtt": {"broker": "embedded", "port": 0, "websocket_port": port}},
        }
        with pytest.raises(GatewayError, match=f"{port}"):
            await gateway.reload(**changes[what])
    await assert_at_work(gateway, before)


async def assert_at_work(gateway, service):
    assert gateway.service is service
    assert service.can_flow
    assert service.mqtt.is_connected
    assert service.recording.is_recording
    status, _, _ = await fetch(service.observer.metrics.port, "/healthz")
    assert status == 200


async def test_nothing_follows_where_all_is_cancelled_as_another_service_takes_over(gateway):
    gateway.write()
    await gateway.supervisor._read_anew(switch_after_s=60.0)
    cancelled, gateway.task = gateway.task, asyncio.create_task(asyncio.sleep(0.0))
    cancelled.cancel()
    await asyncio.wait([cancelled], timeout=20.0)
    assert cancelled.cancelled()


async def test_a_broker_that_refuses_us_leaves_the_old_service_at_work(gateway):
    """One that is away is waited for; one that says no will say so for ever."""

    async def refuse(reader, writer):
        await reader.read(1)
        writer.write(bytes([0x20, 2, 0, 5]))  # CONNACK of MQTT 3.1.1: not authorised
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(refuse, "127.0.0.1", 0)
    before, port = gateway.service, server.sockets[0].getsockname()[1]
    with pytest.raises(GatewayError, match=f"127.0.0.1:{port} refuses clients without a name"):
        await gateway.reload(mqtt={"port": port})
    server.close()
    await assert_at_work(gateway, before)


async def test_the_same_ports_and_others_are_taken_over(gateway, until):
    port = gateway.base["metrics"]["port"]
    before = gateway.service
    await gateway.reload(assembly={"rate_hz": 50})
    await until(lambda: gateway.service is not before and gateway.service.begun.is_set())
    assert gateway.service.observer.metrics.port == port
    await until(lambda: gateway.service.mqtt.is_connected)
    between = gateway.service
    await gateway.reload(metrics={"port": 0})
    await until(lambda: gateway.service is not between and gateway.service.begun.is_set())
    status, _, _ = await fetch(gateway.service.observer.metrics.port, "/healthz")
    assert status == 200


async def test_an_embedded_broker_is_handed_over(gateway, until):
    await gateway.reload(mqtt={"broker": "embedded", "port": 0})
    await until(
        lambda: gateway.service.settings.mqtt.broker == "embedded" and gateway.service.mqtt.is_connected
    )
    before = gateway.service
    process = before.mqtt._broker.pid
    await gateway.reload(mqtt={"broker": "embedded", "port": 0, "decimals": 3})
    await until(lambda: gateway.service is not before and gateway.service.mqtt.is_connected)
    assert gateway.service.mqtt._broker.pid == process
    assert before.mqtt._broker is None


async def test_what_only_fails_as_it_starts_brings_the_old_configuration_back(
    gateway, until, monkeypatch, caplog
):
    """Whatever was free a moment ago may be taken now."""
    before = gateway.service
    start = Service.run

    async def failing(self):
        if self.settings.assembly.rate_hz == 50:
            raise GatewayError("the port was taken meanwhile")
        await start(self)

    monkeypatch.setattr(Service, "run", failing)
    await gateway.reload(assembly={"rate_hz": 50})
    await until(lambda: gateway.service is not before and gateway.service.mqtt.is_connected)
    assert gateway.service.settings == before.settings
    assert "the port was taken meanwhile" in caplog.text
    assert not gateway.task.done()


_ASKED_EVERY_S = 0.02
"""Half as often as the gateway takes requests."""


async def ask_for_ever(client, topic, asked):
    """Number requests, and note in ``asked`` those that have none."""
    for number in itertools.count():
        asked.add(number)
        await client.publish(topic, orjson.dumps({"transaction": number}), qos=1)
        await asyncio.sleep(_ASKED_EVERY_S)


async def note_answers(client, asked):
    async for message in client.messages:
        asked.discard(orjson.loads(message.payload)["transaction"])


@pytest.mark.parametrize("gateway", [{}, {"broker": "embedded", "port": 0}], indirect=True)
@pytest.mark.parametrize("changed", [{}, {"health_interval": 1.0, "decimals": 4, "keepalive": 9}])
async def test_every_request_that_comes_while_a_gateway_begins_anew_is_answered(gateway, until, changed):
    before, port, unanswered = gateway.service, gateway.service.mqtt.port, set[int]()
    topics = before.mqtt.topics
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(topics.response("gateway/info"), qos=1)
        answers = asyncio.create_task(note_answers(client, unanswered))
        asking = asyncio.create_task(ask_for_ever(client, topics.request("gateway/info"), unanswered))
        await asyncio.sleep(0.2)
        await gateway.reload(mqtt={**gateway.base["mqtt"], **changed})
        await until(lambda: gateway.service is not before and gateway.service.mqtt.is_connected)
        await asyncio.sleep(0.2)
        asking.cancel()
        with contextlib.suppress(TimeoutError):  # what has no answer is told below
            await until(lambda: not unanswered)
        answers.cancel()
    assert unanswered == set()


async def test_two_configurations_do_not_take_over_at_once(gateway, until):
    before = gateway.service
    read_anew = gateway.supervisor._read_anew
    answers = await asyncio.gather(read_anew(0.0), read_anew(0.0), return_exceptions=True)
    assert [str(answer) for answer in answers if answer is not None] == [
        "another configuration takes over just now: ask again in a moment"
    ]
    await until(lambda: gateway.service is not before and gateway.service.mqtt.is_connected)


async def test_no_recording_begins_in_a_service_that_ends(gateway, until, monkeypatch):
    """Nobody would end it: its file would be without an end."""
    before, port = gateway.service, gateway.base["mqtt"]["port"]
    stop = before.recording.stop

    async def stop_slowly():
        await stop()
        await asyncio.sleep(0.5)

    monkeypatch.setattr(before.recording, "stop", stop_slowly)
    gateway.base["recording"]["at_start"] = False
    topics = before.mqtt.topics
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(topics.response("recording/start"), qos=1)
        await gateway.reload()
        await until(lambda: before.is_ending)
        await client.publish(topics.request("recording/start"), b"", qos=1)
        answer = orjson.loads((await anext(client.messages)).payload)
    assert answer["status"] == "ok"
    assert not before.recording.is_recording
    assert gateway.service.recording.is_recording
