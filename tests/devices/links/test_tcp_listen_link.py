"""A TCP port that the gateway listens on, with real connections on this computer."""

from __future__ import annotations

import asyncio
import logging

import pytest

from devices.endpoints import link_from_url
from devices.link import Framing, LinkBusyError, LinkError
from tests.patience import PATIENCE_S


async def connected(link):
    async with asyncio.timeout(PATIENCE_S):
        return await asyncio.open_connection(*link.address)


async def hung_up(reader):
    async with asyncio.timeout(PATIENCE_S):
        try:
            return await reader.read() == b""
        except ConnectionResetError:
            return True


@pytest.fixture
async def link():
    made = link_from_url("tcp://127.0.0.1:0?listen=1", name="suit")
    await made.open()
    yield made
    await made.close()


async def test_whoever_connects_is_heard_and_can_be_answered(link, read_bytes):
    assert link.framing is Framing.BYTE_STREAM
    with pytest.raises(LinkError, match="suit: nobody is connected"):
        await link.write(b"x")
    reader, writer = await connected(link)
    writer.write(b"from the program")
    assert await read_bytes(link, 16) == b"from the program"
    await link.write(b"to it")
    assert await asyncio.wait_for(reader.readexactly(5), PATIENCE_S) == b"to it"
    writer.close()


async def test_it_stays_open_when_a_program_hangs_up_and_hears_the_next(link, read_bytes):
    for said in (b"first", b"again"):
        _, writer = await connected(link)
        writer.write(said)
        assert await read_bytes(link, 5) == said
        writer.close()
        await writer.wait_closed()


async def test_the_same_address_takes_the_place_of_a_connection_that_may_have_vanished(link, read_bytes):
    first, writer = await connected(link)
    writer.write(b"old")
    assert await read_bytes(link, 3) == b"old"
    _, newer = await connected(link)
    assert await hung_up(first)
    newer.write(b"new")
    assert await read_bytes(link, 3) == b"new"
    assert link.counts.refused == 0
    for each in (writer, newer):
        each.close()


async def test_another_address_is_turned_away_while_somebody_is_connected(caplog, read_bytes):
    link = link_from_url("tcp://0.0.0.0:0?listen=1", name="suit")
    await link.open()
    port = link.address[1]
    async with asyncio.timeout(PATIENCE_S):
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"here")
        assert await read_bytes(link, 4) == b"here"
        other, _ = await asyncio.open_connection("127.0.0.1", port, local_addr=("127.0.0.2", 0))
    assert await hung_up(other)
    assert link.counts.refused == 1
    assert "127.0.0.2 is turned away while 127.0.0.1 is connected" in caplog.text
    writer.write(b"still")
    assert await read_bytes(link, 5) == b"still"
    writer.close()
    await link.close()


async def test_who_is_not_among_the_peers_is_turned_away_counted_and_told(caplog):
    link = link_from_url("tcp://127.0.0.1:0?listen=1&peers=192.0.2.0/24", name="suit")
    await link.open()
    with caplog.at_level(logging.WARNING):
        reader, _ = await connected(link)
        assert await hung_up(reader)
    assert link.counts.refused == 1
    assert "suit: 127.0.0.1 sends here and is not among the peers: it is turned away" in caplog.text
    await link.close()


async def test_closing_ends_iteration_and_hangs_up(link):
    reader, _ = await connected(link)
    reading = asyncio.ensure_future(anext(aiter(link), None))
    await asyncio.sleep(0)
    await link.close()
    await link.close()  # twice is harmless
    assert await asyncio.wait_for(reading, PATIENCE_S) is None
    assert await hung_up(reader)
    await link.open()  # and it can be opened again
    assert link.address[1]


async def test_a_port_in_use_says_what_would_do(link):
    second = link_from_url(f"tcp://127.0.0.1:{link.address[1]}?listen=1")
    with pytest.raises(LinkBusyError, match=rf"TCP port {link.address[1]} is in use: stop the other program"):
        await second.open()
    with pytest.raises(LinkError, match="is not an address of this computer"):
        await link_from_url("tcp://192.0.2.7:0?listen=1").open()
