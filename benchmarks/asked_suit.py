"""An emulated suit in simulated time that is asked for its time, as a running gateway asks."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Protocol

from devices.commands.command_client import host_bytes
from devices.emulators.delivery import Transmission
from devices.link import Chunk, Framing, SentChunk
from gateway.service.synchronisation import UNEVENNESS, question
from gateway.settings import ClockSettings

STEP_S = 0.01


class Suit(Protocol):
    """What can be asked and sends: a ``SuitTraffic``, or a faulty one."""

    def receive(self, data: bytes, at_s: float, device: int | None = None) -> None: ...

    def advance(self, to_s: float) -> list[Transmission]: ...


def asked(
    suit: Suit, note: Callable[[SentChunk], None], start_ns: int, link: str, seed: int = 1
) -> Iterator[Chunk]:
    """What comes from it, for ever. note: told of every question; start_ns: gateway time of motion time 0."""
    draw = random.Random(seed)
    interval_s = 1.0 / ClockSettings().sync_rate_hz
    step, due_s, count = 0, interval_s, 0
    while True:
        now_s = step * STEP_S
        if now_s >= due_s:
            due_s += interval_s * draw.uniform(*UNEVENNESS)
            now_ns = start_ns + round(now_s * 1e9)
            data = host_bytes(question(count, now_ns), Framing.BYTE_STREAM)
            count += 1
            suit.receive(data, now_s)
            note(SentChunk(data, now_ns, link))
        step += 1
        for sent in suit.advance(step * STEP_S):
            yield Chunk(sent.data, start_ns + round(sent.time_s * 1e9), link)
