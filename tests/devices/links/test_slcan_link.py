"""slcan links over pseudo-terminals, against an adapter played by hand and against python-can's own."""

from __future__ import annotations

import asyncio
import contextlib

import can
import pytest

from devices.emulators.transports.memory import loopback_pair
from devices.link import Framing, LinkError
from devices.links.serial_link import SerialLink
from devices.links.slcan_link import SlcanLink
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records
from tests.patience import PATIENCE_S


@pytest.fixture
async def joined(pseudo_terminal):
    terminal = pseudo_terminal()
    link = SlcanLink(SerialLink(terminal.path), bitrate=500_000, fd=True, name="bus")
    await link.open()
    assert await terminal.read(10) == b"C\rS6\rY2\rO\r"
    yield terminal, link
    await link.close()


async def test_lines_become_records_and_records_lines(joined, next_chunk):
    terminal, link = joined
    assert link.framing is Framing.CAN
    terminal.write(b"\r\r\r\rT0000010021133\rgarbage\rt1230\rT00")
    chunk = await next_chunk(aiter(link))
    frames = [CanFrame(0x100, b"\x11\x33"), CanFrame(0x123, b"", is_extended=False)]
    assert unpack_can_records(chunk.data) == frames
    assert (chunk.link, link.decoder.malformed) == ("bus", 1)
    await link.write(pack_can_records(frames))
    assert await terminal.read(21) == b"T0000010021133\rt1230\r"


async def test_closing_leaves_the_bus(joined):
    terminal, link = joined
    await link.close()
    assert await terminal.read(2) == b"C\r"
    assert [chunk async for chunk in link] == []


async def test_lost_adapter_is_told_and_closing_it_is_quiet(joined):
    terminal, link = joined
    terminal.close()
    with pytest.raises(LinkError, match="was lost"):
        async with asyncio.timeout(PATIENCE_S):
            await anext(aiter(link))
    await link.close()


@pytest.mark.parametrize("turns", range(4))
async def test_cancelled_as_its_adapter_is_lost_it_does_not_go_on(monkeypatch, turns):
    near, _ = loopback_pair("unplugged")
    written = asyncio.get_running_loop().create_future()

    async def until_lost(_data: bytes) -> None:
        await written

    monkeypatch.setattr(near, "write", until_lost)
    closing = asyncio.create_task(SlcanLink(near).close())
    await asyncio.sleep(0.01)
    written.set_exception(LinkError("the device was unplugged"))
    for _ in range(turns):  # of the loop, in which the loss is told on
        await asyncio.sleep(0)
    was_closed = closing.done()
    closing.cancel()
    with contextlib.nullcontext() if was_closed else pytest.raises(asyncio.CancelledError):
        await closing


async def test_adapter_that_takes_no_commands_is_told(pseudo_terminal, monkeypatch):
    monkeypatch.setattr("devices.links.slcan_link._COMMAND_TIMEOUT_S", 0.02)
    near, _ = loopback_pair("deaf")

    async def never(_data: bytes) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(near, "write", never)
    with pytest.raises(LinkError, match="takes no commands: is it an slcan adapter"):
        await SlcanLink(near).open()
    await near.open()  # it was closed again


def test_unknown_bit_rate_is_refused_before_anything_is_opened():
    with pytest.raises(ValueError, match="no bit rate 123"):
        SlcanLink(SerialLink("/dev/ttyACM0"), bitrate=123)


FRAMES = [
    CanFrame(0x0C40_0141, bytes(range(8))),
    CanFrame(0x321, b"\xff", is_extended=False),
    CanFrame(0x1234_567, bytes(range(64)), is_fd=True, bitrate_switch=True),
    CanFrame(0x12, bytes(12), is_extended=False, is_fd=True),
]


async def test_agrees_with_the_slcan_of_python_can(pseudo_terminal):
    """Our end on the master side of a pair, python-can's on the other: the same frames both ways."""
    terminal = pseudo_terminal()
    near, far = loopback_pair("bus")
    await far.open()
    link = SlcanLink(near, fd=True)
    await link.open()
    peer = await asyncio.to_thread(can.Bus, interface="slcan", channel=terminal.path, sleep_after_open=0)
    try:
        assert await terminal.read(2) == b"O\r"
        await link.write(pack_can_records(FRAMES))
        written = [await anext(aiter(far)) for _ in range(5)][-1].data  # after four commands
        terminal.write(written)
        for frame in FRAMES:
            message = await asyncio.to_thread(peer.recv, 1)
            assert message is not None
            assert (message.arbitration_id, bytes(message.data)) == (frame.identifier, frame.data)
            assert (message.is_extended_id, message.is_fd) == (frame.is_extended, frame.is_fd)
            assert message.bitrate_switch == frame.bitrate_switch
            peer.send(message)
        await far.write(await terminal.read(len(written)))
        chunk = await anext(aiter(link))
        assert unpack_can_records(chunk.data) == FRAMES
    finally:
        peer.shutdown()
        await link.close()
