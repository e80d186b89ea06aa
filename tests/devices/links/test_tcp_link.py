"""TCP links against real servers on this computer."""

from __future__ import annotations

import asyncio
import socket

import pytest

from devices.free_ports import free_port
from devices.link import Framing, LinkError
from devices.links.tcp_link import TcpLink
from tests.patience import PATIENCE_S


class Server:
    """Accepts one connection at a time and exposes its streams."""

    def __init__(self) -> None:
        self.accepted: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        return self._server.sockets[0].getsockname()[1]

    async def _accept(self, reader, writer) -> None:
        await self.accepted.put((reader, writer))

    async def stop(self) -> None:
        self._server.close()


@pytest.fixture
async def server():
    running = Server()
    running.port = await running.start()
    yield running
    await running.stop()


@pytest.fixture
async def joined(server):
    link = TcpLink("127.0.0.1", server.port, name="relay")
    await link.open()
    reader, writer = await asyncio.wait_for(server.accepted.get(), PATIENCE_S)
    yield link, reader, writer
    await link.close()
    writer.close()


async def test_bytes_pass_both_ways(joined, read_bytes):
    link, reader, writer = joined
    assert link.framing is Framing.BYTE_STREAM
    writer.write(b"from the relay")
    assert await read_bytes(link, 14) == b"from the relay"
    await link.write(b"to the relay")
    assert await asyncio.wait_for(reader.readexactly(12), PATIENCE_S) == b"to the relay"


async def test_socket_sends_at_once_and_notices_a_silent_peer(joined):
    link, _, _ = joined
    connected = link._connection._transport.get_extra_info("socket")
    assert connected.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert connected.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert connected.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 5


async def test_room_for_more_than_the_largest_segment_is_told_to_the_sender(joined):
    """With less, a sender waits for its timer when the gateway reads again after it stood still."""
    link, _, _ = joined
    connected = link._connection._transport.get_extra_info("socket")
    granted = (
        connected.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) / 2
    )  # told with as much again for heads
    assert granted > 2 * 65_536


async def test_arrival_is_stamped_before_a_busy_reader_looks(joined, stamped_on_arrival):
    link, _, writer = joined
    await stamped_on_arrival(link, lambda: writer.write(b"x"))


async def test_orderly_close_of_the_peer_ends_iteration(joined):
    link, _, writer = joined
    writer.write(b"bye")
    writer.close()
    async with asyncio.timeout(PATIENCE_S):
        assert b"".join([chunk.data async for chunk in link]) == b"bye"
    with pytest.raises(LinkError, match="relay is closed"):
        await link.write(b"x")


async def test_reset_by_the_peer_is_a_loss(joined):
    link, _, writer = joined
    writer.transport.get_extra_info("socket").setsockopt(
        socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00"
    )
    writer.transport.abort()
    with pytest.raises(LinkError, match="was lost"):
        async with asyncio.timeout(PATIENCE_S):
            await anext(aiter(link))


async def test_writing_waits_while_the_peer_does_not_read(joined):
    link, reader, _ = joined
    total = 16 * 1024 * 1024
    writing = asyncio.ensure_future(link.write(bytes(total)))
    await asyncio.sleep(0.02)
    assert not writing.done()
    received = 0
    async with asyncio.timeout(PATIENCE_S):
        while received < total:
            received += len(await reader.read(1 << 20))
        await writing


async def test_closing_ends_iteration_and_a_write_that_waits(joined):
    link, _, _ = joined
    reading = asyncio.ensure_future(anext(aiter(link), None))
    writing = asyncio.ensure_future(link.write(bytes(16 * 1024 * 1024)))
    await asyncio.sleep(0.01)
    await link.close()
    await link.close()  # twice is harmless
    async with asyncio.timeout(PATIENCE_S):
        assert await reading is None
        await asyncio.gather(writing, return_exceptions=True)


async def test_closed_link_opens_again(joined, server, read_bytes):
    link, _, _ = joined
    await link.close()
    await link.open()
    _, writer = await server.accepted.get()
    writer.write(b"again")
    assert await read_bytes(link, 5) == b"again"
    writer.close()


async def test_refused_connection_says_what_would_do():
    port = free_port()
    with pytest.raises(LinkError, match=rf"127.0.0.1:{port} refused .* start what should listen there"):
        await TcpLink("127.0.0.1", port).open()


async def test_unknown_host_says_so(monkeypatch):
    async def fail(*_args, **_kwargs):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", fail)
    with pytest.raises(LinkError, match=r"unknown host 'suit\.invalid': correct the name"):
        await TcpLink("suit.invalid", 9000).open()


async def test_silence_is_a_timeout():
    # A full backlog: the kernel drops further connection requests and the caller gets no answer.
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        with socket.create_connection(full.getsockname()):
            link = TcpLink(*full.getsockname(), connect_timeout=0.1)
            with pytest.raises(LinkError, match="does not answer: check the address"):
                await link.open()
