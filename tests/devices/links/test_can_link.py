"""python-can links on virtual buses."""

from __future__ import annotations

import asyncio

import can
import pytest

from devices.link import Framing, LinkError
from devices.links.can_link import CanLink
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records
from tests.patience import PATIENCE_S

FRAMES = [
    CanFrame(0x0C40_0141, bytes(range(8))),
    CanFrame(0x321, b"\xff", is_extended=False),
    CanFrame(0x1234_567, bytes(range(64)), is_fd=True, bitrate_switch=True),
    CanFrame(0x77, b"", is_remote=True),
]


@pytest.fixture
async def joined(request):
    channel = request.node.name  # a bus of its own
    link = CanLink("virtual", channel, bitrate=1_000_000, fd=True, name="bus")
    await link.open()
    peer = can.Bus(interface="virtual", channel=channel)
    yield link, peer
    await link.close()
    peer.shutdown()


async def read_frames(link: CanLink, count: int) -> list[CanFrame]:
    frames: list[CanFrame] = []
    async with asyncio.timeout(PATIENCE_S):
        async for chunk in link:
            frames += unpack_can_records(chunk.data)
            if len(frames) >= count:
                break
    return frames


async def test_frames_of_every_kind_pass_both_ways(joined):
    link, peer = joined
    assert link.framing is Framing.CAN
    await link.write(pack_can_records(FRAMES))
    for _ in FRAMES:
        peer.send(peer.recv(PATIENCE_S))
    assert await read_frames(link, len(FRAMES)) == FRAMES


async def test_a_burst_arrives_whole_in_order_and_in_few_chunks(joined):
    link, peer = joined
    for index in range(500):
        peer.send(can.Message(arbitration_id=index, data=b"12345678"))
    async with asyncio.timeout(PATIENCE_S):
        chunks = []
        while sum(len(unpack_can_records(chunk.data)) for chunk in chunks) < 500:
            chunks.append(await anext(aiter(link)))
    frames = [frame for chunk in chunks for frame in unpack_can_records(chunk.data)]
    assert [frame.identifier for frame in frames] == list(range(500))
    assert len(chunks) < 250


async def test_arrival_is_stamped_before_a_busy_reader_looks(joined, stamped_on_arrival):
    link, peer = joined
    await stamped_on_arrival(link, lambda: peer.send(can.Message(arbitration_id=1)))


async def test_bus_that_fails_is_a_loss(joined):
    link, _ = joined
    link._opened.shutdown()  # under the reading thread
    with pytest.raises(LinkError, match="bus was lost: Cannot operate on a closed bus"):
        async with asyncio.timeout(PATIENCE_S):
            await anext(aiter(link))
    with pytest.raises(LinkError, match="was lost"):
        await link.write(pack_can_records(FRAMES))


async def test_closed_link_ends_and_opens_again(joined):
    link, peer = joined
    await link.close()
    assert [chunk async for chunk in link] == []
    with pytest.raises(LinkError, match="bus is closed"):
        await link.write(b"")
    await link.open()
    peer.send(can.Message(arbitration_id=7))
    assert (await read_frames(link, 1))[0].identifier == 7


async def test_cancelled_opening_leaves_no_bus_behind(until):
    link = CanLink("virtual", "cancelled")
    opening = asyncio.ensure_future(link.open())
    await asyncio.sleep(0)
    opening.cancel()
    await asyncio.gather(opening, return_exceptions=True)
    await until(lambda: "cancelled" not in can.interfaces.virtual.channels)


def test_unknown_interface_names_the_nearest():
    with pytest.raises(ValueError, match=r"unknown CAN interface 'virtul' \(did you mean 'virtual'\?\)"):
        CanLink("virtul", "suit")


async def test_adapter_without_its_driver_is_told():
    with pytest.raises(LinkError, match=r"can://kvaser/0 .*(driver|adapter)"):
        await CanLink("kvaser", "0").open()
