"""Two ends in memory."""

from __future__ import annotations

import pytest

from devices.emulators.transports.memory import loopback_pair
from devices.link import Chunk, Framing, LinkError


async def test_what_one_writes_the_other_reads():
    times = iter([10, 20, 30])
    near, far = loopback_pair("suit", "module", framing=Framing.CAN, clock=lambda: next(times))
    await near.open()
    await far.open()
    await far.write(b"a")
    await far.write(b"b")
    await near.write(b"c")
    assert await anext(aiter(near)) == Chunk(b"a", 10, "suit")
    assert await anext(aiter(near)) == Chunk(b"b", 20, "suit")
    assert await anext(aiter(far)) == Chunk(b"c", 30, "module")
    assert near.framing is far.framing is Framing.CAN


async def test_what_is_written_before_the_other_opens_is_lost():
    near, far = loopback_pair()
    await far.open()
    await far.write(b"early")
    await near.open()
    await far.write(b"late")
    assert (await anext(aiter(near))).data == b"late"


async def test_closing_one_end_ends_the_other():
    near, far = loopback_pair()
    await near.open()
    await far.open()
    await far.write(b"bye")
    await far.close()
    assert [chunk.data async for chunk in near] == [b"bye"]
    with pytest.raises(LinkError, match="is closed"):
        await near.write(b"x")


async def test_lost_connection_is_told_at_both_ends_and_can_be_opened_again():
    near, far = loopback_pair("suit")
    await near.open()
    await far.open()
    far.lose("cable pulled")
    for end in (near, far):
        with pytest.raises(LinkError, match="was lost: cable pulled"):
            await anext(aiter(end))
        with pytest.raises(LinkError, match="was lost: cable pulled"):
            await end.write(b"x")
    await near.open()
    await far.open()
    await far.write(b"again")
    assert (await anext(aiter(near))).data == b"again"
