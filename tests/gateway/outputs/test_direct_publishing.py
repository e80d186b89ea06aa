"""Messages written past the client's bookkeeping are those that the client would have written."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from typing import Literal

import aiomqtt
import pytest

from gateway.contract.properties import JSON, MSGPACK, properties_of
from gateway.outputs.connection import broker_connection
from gateway.outputs.direct_publishing import DirectPublisher
from gateway.outputs.pose_encoding import Outgoing
from gateway.outputs.settings import MqttSettings

Protocol = Literal["3.1.1", "5"]
_WELCOME = {"3.1.1": b"\x20\x02\x00\x00", "5": b"\x20\x03\x00\x00\x00"}


@contextlib.asynccontextmanager
async def connected(protocol: Protocol = "3.1.1") -> AsyncIterator[tuple[aiomqtt.Client, socket.socket]]:
    """(client, the broker's side of its connection)."""
    with socket.create_server(("127.0.0.1", 0)) as broker:
        port = broker.getsockname()[1]
        loop = asyncio.get_running_loop()
        broker.setblocking(False)

        async def welcome() -> socket.socket:
            side, _ = await loop.sock_accept(broker)
            side.setblocking(False)
            side.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
            await loop.sock_recv(side, 4096)
            await loop.sock_sendall(side, _WELCOME[protocol])
            return side

        welcoming = asyncio.create_task(welcome())
        with contextlib.suppress(aiomqtt.MqttError):  # a broker of this kind does not say goodbye
            async with broker_connection(
                MqttSettings(port=port, protocol=protocol), port, "direct"
            ) as client:
                with await welcoming as side:
                    yield client, side
                    raise aiomqtt.MqttError("enough")


async def taken(side: socket.socket, size: int) -> bytes:
    """The next bytes that the broker has."""
    loop, data = asyncio.get_running_loop(), b""
    async with asyncio.timeout(10):
        while len(data) < size:
            data += await loop.sock_recv(side, size - len(data))
    return data


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
@pytest.mark.parametrize("size", [0, 1, 100, 127, 128, 16_300, 16_384, 70_000])
async def test_messages_are_written_as_by_the_client(protocol: Protocol, size: int) -> None:
    messages = [
        Outgoing("mocap/b/pose", b"x" * size, properties_of(protocol, JSON, 3)),
        Outgoing("mocap/b/pose/msgpack", b"y" * size, properties_of(protocol, MSGPACK)),
        Outgoing("mocap/b/Körper", b"z", None),
    ]
    async with connected(protocol) as (client, side):
        both: list[bytes] = []
        for publish in (
            lambda: [client._client.publish(topic, data, properties=more) for topic, data, more in messages],
            lambda: DirectPublisher(client, has_properties=protocol == "5").publish(messages),
        ):
            publish()
            client._client.publish("mocap/b/end", b"!")
            data = b""
            while not data.endswith(b"mocap/b/end" + (b"\0" if protocol == "5" else b"") + b"!"):
                data += await asyncio.get_running_loop().sock_recv(side, 1 << 16)
            both.append(data)
    assert both[0] == both[1]


async def test_what_a_full_socket_does_not_take_goes_out_in_order_when_it_does() -> None:
    payloads = [bytes([65 + k]) * 100_000 for k in range(20)]
    async with connected() as (client, side):
        direct = DirectPublisher(client, has_properties=False)
        were_taken = [direct.publish([Outgoing("t", payload, None)]) for payload in payloads]
        assert not were_taken[-1]
        assert not direct.is_free
        draining = asyncio.create_task(direct.drained())
        await asyncio.sleep(0.05)
        assert not draining.done()
        for payload in payloads:
            assert await taken(side, 4) == b"\x30" + bytes([(100_003 & 0x7F) | 0x80, 0x8D, 0x06])
            assert await taken(side, 3 + len(payload)) == b"\0\1t" + payload
        assert await draining
        assert direct.is_free
        assert direct.publish([Outgoing("t", b"more", None)])


async def test_a_broker_that_does_not_read_is_told() -> None:
    async with connected() as (client, _side):
        direct = DirectPublisher(client, has_properties=False)
        client.timeout = 0.1
        for _ in range(30):
            direct.publish([Outgoing("t", b"x" * 100_000, None)])
        with pytest.raises(aiomqtt.MqttError, match="does not read"):
            await direct.drained()


async def test_a_lost_connection_is_told() -> None:
    async with connected() as (client, _side):
        direct = DirectPublisher(client, has_properties=False)
        client._client._sock_close()
        with pytest.raises(aiomqtt.MqttError, match="lost"):
            direct.publish([Outgoing("t", b"x", None)])
