"""Runs an emulated suit, or a recording, against the clock: the I/O shell of the emulators.

    traffic = SuitTraffic(walking_motion(body, seed=1), SuitSettings(has_relay=True), TYPICAL, seed=1)
    suit = EmulatedSuit(traffic, PtyTransport("/tmp/suit"))  # obeys the host
    suit = EmulatedSuit(traffic.transmissions(), PtyTransport("/tmp/suit"))  # only speaks
    await suit.run()

Meanwhile ``motion.state([suit.motion_time_s(frame.time_ns)])`` is the truth at a published instant.
Timers of the default event loop are as coarse as a millisecond; a loop on
``selectors.SelectSelector`` is finer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from devices.emulators.delivery import Transmission
from devices.emulators.transports.transport import DatagramTransport, Transport
from devices.link import Framing, gateway_time_ns

_PREPARED_S = 0.25
_STEP_S = 0.008
_LEAD_S = 0.004
_LONGEST_STEP_S = 0.25
"""Computed at once. Without it a machine that is too busy for a while has each step follow on a longer one,
up to minutes in one piece, which take memory without bound and keep everything else waiting."""
_FAST_STEP_S = 0.05
_RETRY_S = 0.001
_FAST_CHUNK_SIZE = 4096


@runtime_checkable
class Conversation(Protocol):
    """A suit that obeys what the host sends, as ``SuitTraffic`` does. Times are motion time, s."""

    def receive(self, data: bytes, at_s: float, device: int | None = None) -> None:
        """Take bytes that the host sent, at a motion time, s; ``device`` None: they come to all."""

    def advance(self, to_s: float) -> list[Transmission]:
        """Return what is sent until a motion time, s."""

    def rest(self) -> list[Transmission]:
        """Return what is still under way."""


@dataclass
class SuitCounts:
    """What became of the bytes that were due."""

    sent_bytes: int = 0
    dropped_bytes: int = 0
    """Refused because the reader was absent or slow."""
    dropped_chunks: int = 0
    received_bytes: int = 0
    """What the host sent."""
    worst_lateness_s: float = 0.0
    """Longest time from the moment a transmission was due until it was offered."""
    lateness_s: float = 0.0
    """The same of the newest one."""


class EmulatedSuit:
    """Sends transmissions when they are due; waits for a slow or absent reader at full speed only."""

    def __init__(
        self,
        source: Conversation | Iterable[Transmission],
        transport: Transport,
        *,
        speed: float | None = 1.0,
        is_byte_by_byte: bool = False,
        start_ns: int | None = None,
        linger_s: float = 0.2,
        duration_s: float | None = None,
    ) -> None:
        """Prepare to run.

        source: a suit that obeys the host, computed a few milliseconds ahead so that it answers promptly; or
        transmissions in order of time, prepared far ahead. Both in a thread. Pass a list to have all of them
        computed beforehand, which keeps the computation out of the timing.
        speed: motion seconds in a second; None: as fast as the reader takes it, without drops.
        is_byte_by_byte: every byte in a write of its own (byte streams only).
        start_ns: gateway time of motion time 0; default: when ``run`` begins to send.
        linger_s: how long the transport stays open after the last byte, so that it can be read.
        duration_s: motion time at which a suit that obeys the host ends; default: never.

        Raises ``ValueError`` for a speed that is not positive, or single bytes on a CAN bus or in datagrams.
        """

        if speed is not None and speed <= 0.0:
            raise ValueError(f"speed {speed}: give a positive factor, or None for as fast as it is read")
        if is_byte_by_byte and (transport.framing is Framing.CAN or isinstance(transport, DatagramTransport)):
            raise ValueError("byte by byte needs a byte stream, not a CAN bus or datagrams")

        self.transport = transport
        self.counts = SuitCounts()
        self.start_ns = start_ns
        """Gateway time of motion time 0, once running."""
        self._conversation = source if isinstance(source, Conversation) else None
        self._source: Iterator[Transmission] = iter(()) if isinstance(source, Conversation) else iter(source)
        self._duration_s = duration_s
        self._inbox: list[tuple[bytes, float, int | None]] = []
        self._acts: list[Callable[[], None]] = []
        self._speed = speed
        self._is_byte_by_byte = is_byte_by_byte
        self._linger_s = linger_s

    def instant_ns(self, motion_time_s: float) -> int:
        """Gateway time at which a motion time is reached. Raises ``RuntimeError`` before the start."""
        return self._start() + round(motion_time_s * 1e9 / (self._speed or 1.0))

    def motion_time_s(self, instant_ns: int) -> float:
        """Motion time at a gateway time, s. Raises ``RuntimeError`` before the start."""
        return (instant_ns - self._start()) * 1e-9 * (self._speed or 1.0)

    def do(self, act: Callable[[], None]) -> None:
        """Have something done to a suit that obeys the host, between two steps of its computation."""
        self._acts.append(act)

    async def run(self) -> None:
        """Open the transport, send everything, close it. Cancelling stops the suit at once."""
        self.transport.listen(self._receive)
        await self.transport.open()
        try:
            if self._conversation is not None:
                await self._converse(self._conversation)
            else:
                await self._send_all()
            await self._linger()
        finally:
            await self.transport.close()

    def _start(self) -> int:
        if self.start_ns is None:
            raise RuntimeError("the suit has not started: call run first")
        return self.start_ns

    def _receive(self, data: bytes, device: int | None = None, /) -> None:
        self.counts.received_bytes += len(data)
        if self._conversation is not None:
            at_s = 0.0 if self.start_ns is None else self.motion_time_s(gateway_time_ns())
            self._inbox.append((data, at_s, device))

    async def _converse(self, suit: Conversation) -> None:
        """Compute the suit step by step, each while what came of the one before is being sent."""
        self.start_ns = self.start_ns or gateway_time_ns()
        end_s = float("inf") if self._duration_s is None else self._duration_s
        sending, now_s = asyncio.create_task(self._send([])), 0.0
        # A thread of its own: what it takes megabytes of memory for comes from the same heap every time.
        computing = ThreadPoolExecutor(1, thread_name_prefix="emulated suit")
        loop = asyncio.get_running_loop()
        try:
            while now_s < end_s:
                now_s = await self._time_of_next_step(now_s, end_s)
                received, self._inbox = self._inbox, []
                for data, at_s, device in received:
                    suit.receive(data, at_s, device)
                acts, self._acts = self._acts, []
                for act in acts:
                    act()
                batch = await loop.run_in_executor(computing, suit.advance, now_s)
                await sending
                sending = asyncio.create_task(self._send(batch))
            await sending
            await self._send(suit.rest())
        finally:
            sending.cancel()
            computing.shutdown(wait=False)

    async def _time_of_next_step(self, now_s: float, end_s: float) -> float:
        """Wait until the next step is to be computed; the motion time it reaches to."""
        if self._speed is None:
            await asyncio.sleep(0)
            return min(now_s + _FAST_STEP_S, end_s)
        lead_s = _LEAD_S * self._speed
        wait_s = (self.instant_ns(now_s - lead_s) - gateway_time_ns()) * 1e-9
        await asyncio.sleep(max(0.0, wait_s))
        # A step that begins late is longer, which is cheaper, so that a busy machine catches up.
        late_s = self.motion_time_s(gateway_time_ns()) + lead_s - now_s
        step_s = min(max(_STEP_S * self._speed, late_s), _LONGEST_STEP_S * self._speed)
        return min(now_s + step_s, end_s)

    async def _send(self, batch: list[Transmission]) -> None:
        await (self._send_fast(batch) if self._speed is None else self._send_timely(batch))

    async def _send_all(self) -> None:
        upcoming = asyncio.create_task(asyncio.to_thread(self._prepare))
        try:
            while batch := await upcoming:
                upcoming = asyncio.create_task(asyncio.to_thread(self._prepare))
                self.start_ns = self.start_ns or gateway_time_ns()
                await self._send(batch)
        finally:
            upcoming.cancel()

    def _prepare(self) -> list[Transmission]:
        """Return the next stretch of transmissions; empty at the end."""
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
                self.counts.lateness_s = (now - due[start]) * 1e-9
                self.counts.worst_lateness_s = max(self.counts.worst_lateness_s, self.counts.lateness_s)
                await self._offer(batch[start:end])
            start = end

    async def _offer(self, batch: list[Transmission]) -> None:
        if isinstance(self.transport, DatagramTransport):
            for transmission in batch:
                self._count(
                    transmission.data, self.transport.offer_from(transmission.device, transmission.data)
                )
            return
        for piece in self._pieces(b"".join(transmission.data for transmission in batch)):
            self._count(piece, self.transport.offer(piece))
            if self._is_byte_by_byte:
                await asyncio.sleep(0)

    def _count(self, piece: bytes, was_taken: bool) -> None:
        if was_taken:
            self.counts.sent_bytes += len(piece)
        else:
            self.counts.dropped_bytes += len(piece)
            self.counts.dropped_chunks += 1

    async def _send_fast(self, batch: list[Transmission]) -> None:
        if isinstance(self.transport, DatagramTransport):
            await self._offer(batch)  # at any speed: a network refuses nothing for long
            await asyncio.sleep(0)
            return
        chunk = b""
        for transmission in batch:
            chunk += transmission.data
            if len(chunk) >= _FAST_CHUNK_SIZE:
                await self._insist(chunk)
                chunk = b""
        await self._insist(chunk)

    async def _insist(self, data: bytes) -> None:
        for piece in self._pieces(data):
            # A terminal does not report when it has room.
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
