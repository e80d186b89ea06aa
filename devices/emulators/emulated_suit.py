"""Runs an emulated suit, or a recording, against the clock: the I/O shell of the emulators.

    traffic = SuitTraffic(walking_motion(body, seed=1), SuitSettings(has_relay=True), TYPICAL, seed=1)
    suit = EmulatedSuit(traffic.transmissions(), PtyTransport("/tmp/suit"))
    await suit.run()

Meanwhile ``motion.state([suit.motion_time_s(frame.time_ns)])`` is the truth at a published instant.
Timers of the default event loop are as coarse as a millisecond; a loop on
``selectors.SelectSelector`` is finer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from devices.emulators.delivery import Transmission
from devices.emulators.transports.transport import Transport
from devices.link import Framing, gateway_time_ns

_PREPARED_S = 0.25
_RETRY_S = 0.001
_FAST_CHUNK_SIZE = 4096


@dataclass
class SuitCounts:
    """What became of the bytes that were due."""

    sent_bytes: int = 0
    dropped_bytes: int = 0
    """Refused because the reader was absent or slow."""
    dropped_chunks: int = 0
    worst_lateness_s: float = 0.0
    """Longest time from the moment a transmission was due until it was offered."""


class EmulatedSuit:
    """Sends transmissions when they are due; waits for a slow or absent reader at full speed only."""

    def __init__(
        self,
        source: Iterable[Transmission],
        transport: Transport,
        *,
        speed: float | None = 1.0,
        is_byte_by_byte: bool = False,
        start_ns: int | None = None,
        linger_s: float = 0.2,
    ) -> None:
        """
        source: transmissions in order of time; prepared ahead in a thread. Pass a list to have all
            of them computed beforehand, which keeps the computation out of the timing.
        speed: motion seconds in a second; None: as fast as the reader takes it, without drops.
        is_byte_by_byte: every byte in a write of its own (byte streams only).
        start_ns: gateway time of motion time 0; default: when ``run`` begins to send.
        linger_s: how long the transport stays open after the last byte, so that it can be read.

        Raises ``ValueError`` for a speed that is not positive, or single bytes on a CAN bus.
        """
        if speed is not None and speed <= 0.0:
            raise ValueError(f"speed {speed}: give a positive factor, or None for as fast as it is read")
        if is_byte_by_byte and transport.framing is Framing.CAN:
            raise ValueError("byte by byte needs a byte stream, not a CAN bus")
        self.transport = transport
        self.counts = SuitCounts()
        self.start_ns = start_ns
        """Gateway time of motion time 0, once running."""
        self._source: Iterator[Transmission] = iter(source)
        self._speed = speed
        self._is_byte_by_byte = is_byte_by_byte
        self._linger_s = linger_s

    def instant_ns(self, motion_time_s: float) -> int:
        """Gateway time at which a motion time is reached. Raises ``RuntimeError`` before the start."""
        return self._start() + round(motion_time_s * 1e9 / (self._speed or 1.0))

    def motion_time_s(self, instant_ns: int) -> float:
        """Motion time at a gateway time, s. Raises ``RuntimeError`` before the start."""
        return (instant_ns - self._start()) * 1e-9 * (self._speed or 1.0)

    async def run(self) -> None:
        """Open the transport, send everything, close it. Cancelling stops the suit at once."""
        await self.transport.open()
        try:
            await self._send_all()
            await self._linger()
        finally:
            await self.transport.close()

    def _start(self) -> int:
        if self.start_ns is None:
            raise RuntimeError("the suit has not started: call run first")
        return self.start_ns

    async def _send_all(self) -> None:
        upcoming = asyncio.create_task(asyncio.to_thread(self._prepare))
        try:
            while batch := await upcoming:
                upcoming = asyncio.create_task(asyncio.to_thread(self._prepare))
                self.start_ns = self.start_ns or gateway_time_ns()
                await (self._send_fast(batch) if self._speed is None else self._send_timely(batch))
        finally:
            upcoming.cancel()

    def _prepare(self) -> list[Transmission]:
        """The next stretch of transmissions; empty at the end."""
        batch: list[Transmission] = []
        for transmission in self._source:
            batch.append(transmission)
            if transmission.time_s >= batch[0].time_s + _PREPARED_S:
                break
        return batch

    async def _send_timely(self, batch: list[Transmission]) -> None:
        due = [self.instant_ns(transmission.time_s) for transmission in batch]
        start = 0
        while start < len(batch):
            # Also when late: the event loop must get its turn.
            await asyncio.sleep(max(0.0, (due[start] - gateway_time_ns()) * 1e-9))
            now, end = gateway_time_ns(), start
            while end < len(batch) and due[end] <= now:
                end += 1
            if end > start:
                self.counts.worst_lateness_s = max(self.counts.worst_lateness_s, (now - due[start]) * 1e-9)
                await self._offer(b"".join(t.data for t in batch[start:end]))
            start = end

    async def _offer(self, data: bytes) -> None:
        for piece in self._pieces(data):
            if self.transport.offer(piece):
                self.counts.sent_bytes += len(piece)
            else:
                self.counts.dropped_bytes += len(piece)
                self.counts.dropped_chunks += 1
            if self._is_byte_by_byte:
                await asyncio.sleep(0)

    async def _send_fast(self, batch: list[Transmission]) -> None:
        chunk = b""
        for transmission in batch:
            chunk += transmission.data
            if len(chunk) >= _FAST_CHUNK_SIZE:
                await self._insist(chunk)
                chunk = b""
        await self._insist(chunk)

    async def _insist(self, data: bytes) -> None:
        for piece in self._pieces(data):
            # A terminal tells nobody when it has room.
            while not self.transport.offer(piece):  # noqa: ASYNC110
                await asyncio.sleep(_RETRY_S)
            self.counts.sent_bytes += len(piece)
            await asyncio.sleep(0)

    def _pieces(self, data: bytes) -> Iterable[bytes]:
        if self._is_byte_by_byte:
            return (data[i : i + 1] for i in range(len(data)))
        return (data,) if data else ()

    async def _linger(self) -> None:
        end_ns = gateway_time_ns() + round(self._linger_s * 1e9)
        while gateway_time_ns() < end_ns:
            self.transport.offer(b"")  # moves on the rest of a chunk that was taken in part
            await asyncio.sleep(0.01)
