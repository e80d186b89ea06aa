"""A web page from elsewhere, open in a browser of the same machine, and the embedded broker's WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct

import aiomqtt
import pytest
import websockets

from gateway.outputs.broker_process import BrokerProcess
from gateway.outputs.connection import broker_connection
from gateway.outputs.embedded_broker import admits
from gateway.outputs.settings import MqttSettings
from gateway.support.credentials import AccessToken
from tests.patience import PATIENCE_S

REQUEST = "mocap/lab/bridge/request/recording/start"
CONNECT = b"\x10\x10\x00\x04MQTT\x04\x02\x00\x3c\x00\x04page"
_WILL = struct.pack(">H", len(REQUEST)) + REQUEST.encode() + b"\x00\x02{}"
CONNECT_WITH_WILL = (
    bytes((0x10, 16 + len(_WILL))) + b"\x00\x04MQTT\x04\x26\x00\x3c\x00\x04page" + _WILL  # retained
)
TOKEN = "a-token-of-this-test-alone"
LAST = "mocap/lab/bridge/request/gateway/last"


@pytest.fixture
async def broker(unused_port):
    process = BrokerProcess(0, unused_port, ["https://lab.example"], AccessToken(TOKEN))
    await process.start()
    process.websocket_port = unused_port
    yield process
    await process.stop()


def page(broker, origin=None, **options):
    headers = {} if origin is None else {"Origin": origin}
    return aiomqtt.Client(
        "127.0.0.1", broker.websocket_port, transport="websockets", websocket_headers=headers, **options
    )


@contextlib.asynccontextmanager
async def listening_gateway(broker):
    """``await heard()``: what came on topics of requests until now, whoever sent it."""
    settings = MqttSettings(port=broker.port)
    async with broker_connection(settings, broker.port, "gateway") as gateway:
        await gateway.subscribe("mocap/lab/bridge/request/#")
        messages = aiter(gateway.messages)

        async def heard():
            await gateway.publish(LAST, b"{}")
            found = []
            while (message := await asyncio.wait_for(anext(messages), PATIENCE_S)).topic.value != LAST:
                found.append((message.topic.value, message.payload))
            return found

        yield heard


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1.evil.example"])
async def test_a_page_from_elsewhere_is_not_let_in(broker, origin):
    place = f"ws://127.0.0.1:{broker.websocket_port}"
    async with (
        asyncio.timeout(PATIENCE_S),
        websockets.connect(place, origin=origin, subprotocols=["mqtt"]) as page,
    ):
        with contextlib.suppress(websockets.ConnectionClosed):
            await page.send(CONNECT)
        with pytest.raises(websockets.ConnectionClosed, match=r"1008.*websocket_origins"):
            await page.recv()


async def test_a_page_of_this_machine_is_let_in(broker):
    place = f"ws://127.0.0.1:{broker.websocket_port}"
    origin = "http://localhost:8000"
    async with (
        asyncio.timeout(PATIENCE_S),
        websockets.connect(place, origin=origin, subprotocols=["mqtt"]) as page,
    ):
        await page.send(CONNECT)
        assert await page.recv() == b"\x20\x02\x00\x00"  # connection accepted


@pytest.mark.parametrize("origin", ["http://127.0.0.1:8000", "http://localhost", "https://lab.example"])
async def test_a_page_that_may_listen_cannot_publish(broker, origin):
    async with listening_gateway(broker) as heard:
        async with page(broker, origin) as client:
            await client.subscribe("mocap/lab/pose")
            async with broker_connection(MqttSettings(port=broker.port), broker.port, "poses") as poses:
                await poses.publish("mocap/lab/pose", b"here")
            message = await asyncio.wait_for(anext(aiter(client.messages)), PATIENCE_S)
            assert message.payload == b"here"
            await client.publish(REQUEST, b'{"by":"page"}', qos=1)
            await client.publish("mocap/lab/body", b"{}", qos=1, retain=True)
        place = f"ws://127.0.0.1:{broker.websocket_port}"
        async with websockets.connect(place, origin=origin, subprotocols=["mqtt"]) as dying:
            await dying.send(CONNECT_WITH_WILL)
            await dying.recv()
            dying.transport.abort()  # without a word, so that the will is due
        assert await heard() == []
    async with broker_connection(MqttSettings(port=broker.port), broker.port, "late") as late:
        await late.subscribe("mocap/#")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await anext(aiter(late.messages))


async def test_who_shows_the_token_publishes_and_who_shows_a_wrong_one_does_not(broker):
    async with listening_gateway(broker) as heard:
        for password in ("another-token-altogether", TOKEN):
            async with page(broker, "http://127.0.0.1:8000", username="page", password=password) as client:
                await client.publish(REQUEST, json.dumps({"by": password}), qos=1)
        assert await heard() == [(REQUEST, json.dumps({"by": TOKEN}).encode())]


async def test_without_a_token_nobody_publishes_there(unused_port):
    broker = BrokerProcess(0, unused_port)
    await broker.start()
    broker.websocket_port = unused_port
    async with listening_gateway(broker) as heard:
        for password in ("", "None"):
            async with page(broker, username="page", password=password) as client:
                await client.publish(REQUEST, b"{}", qos=1)
        assert await heard() == []
    await broker.stop()


@pytest.mark.parametrize(
    ("hosts", "origins", "admitted"),
    [
        (["127.0.0.1:9001"], [], True),  # a program
        (["localhost:9001"], ["http://localhost:8000"], True),
        (["[::1]:9001"], ["http://[::1]:8000"], True),
        (["127.0.0.1:9001"], ["https://lab.example"], True),
        (["127.0.0.1:9001"], ["https://lab.example.evil"], False),
        (["127.0.0.1:9001"], ["null"], False),
        (["127.0.0.1:9001"], ["http://[broken"], False),
        (["127.0.0.1:9001"], ["http://127.0.0.1", "https://evil.example"], False),
        (["evil.example"], [], False),
        (["evil.example", "127.0.0.1"], [], False),
        ([], [], False),
    ],
)
def test_who_is_admitted(hosts, origins, admitted):
    assert admits(hosts, origins, ["https://lab.example"]) is admitted
