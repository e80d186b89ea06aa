"""A look for a shaken module lasts as long as it was asked for."""

from __future__ import annotations

import asyncio

from devices.link import Chunk, gateway_time_ns
from firmware_protocol import ReceivedPacket
from firmware_protocol.messages import Event
from gateway.modules import motion
from gateway.modules.motion import MotionWatch
from gateway.sources.suit import SuitSource
from tests.patience import PATIENCE_S

TAP = 2


def tap(stream, module):
    chunk = Chunk(b"", gateway_time_ns(), "suit")
    for listener in stream._listeners[Event]:
        listener(ReceivedPacket(Event.KIND, module, 0, 0, Event(TAP)), chunk)


async def tapped_until_found(stream, module, looking):
    """What a look finds while a module is tapped until it has."""
    async with asyncio.timeout(PATIENCE_S):
        while not looking.done():
            if stream._listeners.get(Event):
                tap(stream, module)
            await asyncio.sleep(0.02)
    return looking.result().module


async def test_a_long_look_hears_what_happens_late_in_it(monkeypatch):
    monkeypatch.setattr(motion, "_IDLE_S", 0.1)
    stream = SuitSource()
    looking = asyncio.create_task(MotionWatch(stream).next(PATIENCE_S))
    await asyncio.sleep(0.3)  # longer than listening goes on unused
    assert stream._listeners[Event]
    assert await tapped_until_found(stream, 3, looking) == 3
