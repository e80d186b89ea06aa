"""Listens to the samples and events of all modules until one of them is shaken or tapped."""

from __future__ import annotations

import asyncio

from devices.link import Chunk, gateway_time_ns
from firmware_protocol import InertialSample, InertialSampleFine, ReceivedPacket
from firmware_protocol.messages import Event
from gateway.errors import GatewayError
from gateway.modules.motion import Motion, MotionDetector
from gateway.sources.stream import Stream

_POLL_S = 0.05
_IDLE_S = 60.0
"""Listening ends so long after it was last of use: it costs a little for each sample."""


class AmbiguousMotionError(GatewayError):
    """More than one module moved."""


class MotionWatch:
    """A ``MotionDetector`` on a stream. What is usual is learnt from the first use on."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._detector = MotionDetector()
        self._end: asyncio.TimerHandle | None = None
        self._turn = asyncio.Lock()

    async def next(self, seconds: float, continues: bool = False) -> Motion | None:
        """Return the next module that is shaken or tapped; None when none is within the time.

        continues: what has moved since the last look counts too.
        Whoever looks meanwhile waits: one motion is told to one of them.

        Raises ``AmbiguousMotionError`` naming the modules when there is no telling which.
        """
        async with self._turn:
            return await self._next(seconds, continues)

    async def _next(self, seconds: float, continues: bool) -> Motion | None:
        self._listen()
        if not continues:
            self._detector.begin_anew()
        end_ns = gateway_time_ns() + round(seconds * 1e9)
        while (now_ns := gateway_time_ns()) < end_ns:
            self._listen()  # a long look must not end as an idle one
            decision = self._detector.decide(now_ns * 1e-9)
            if isinstance(decision, Motion):
                return decision
            if decision is not None:
                moved = " and ".join(map(str, decision))
                raise AmbiguousMotionError(
                    f"modules {moved} all moved: hold still, and shake or tap one alone"
                )
            await asyncio.sleep(_POLL_S)
        return None

    def _listen(self) -> None:
        if self._end is None:
            for packet_class in (InertialSample, InertialSampleFine, Event):
                self._stream.listen(packet_class, self._take)
        else:
            self._end.cancel()
        self._end = asyncio.get_running_loop().call_later(_IDLE_S, self._stop)

    def _stop(self) -> None:
        self._end = None
        self._detector = MotionDetector()
        for packet_class in (InertialSample, InertialSampleFine, Event):
            self._stream.stop_listening(packet_class, self._take)

    def _take(self, received: ReceivedPacket, chunk: Chunk) -> None:
        now_s = chunk.arrived_ns * 1e-9
        if isinstance(received.packet, Event):
            self._detector.take_event(received.module, received.packet, now_s)
        elif isinstance(received.packet, InertialSample | InertialSampleFine):
            self._detector.take_sample(received.module, received.packet, now_s)
