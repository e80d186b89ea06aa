"""What outputs without a connection share: the newest pose goes out, older ones give way and are counted."""

from __future__ import annotations

import asyncio
import logging
from typing import Protocol

from gateway.contract.messages import OutputCounters
from gateway.frames import SkeletonFrame
from gateway.outputs.connection import end_tasks
from gateway.outputs.thinning import Thinning

_log = logging.getLogger(__name__)


class Sink(Protocol):
    """Where poses go. Nothing here waits for whoever reads them."""

    async def open(self) -> None:
        """Raises ``OutputError``."""

    def send(self, frame: SkeletonFrame) -> bool:
        """Whether the system took all of it. May raise ``OSError``."""

    def close(self) -> None: ...


class LatestOutput:
    """An ``Output`` in front of a sink. Belongs to one event loop.

    name: in the counters and the log; rate: most poses a second.
    """

    def __init__(self, name: str, sink: Sink, rate: float) -> None:
        self.name = name
        self.is_paused = False
        """Frames offered meanwhile count as thinned."""
        self._sink = sink
        self._thinning = Thinning(rate)
        self._waiting: SkeletonFrame | None = None
        self._wake = asyncio.Event()
        self._published = self._dropped = self._thinned = 0
        self._has_complained = False
        self._task: asyncio.Task[None] | None = None
        self._is_open = False

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return OutputCounters(
            published=self._published,
            dropped=self._dropped,
            thinned=self._thinned,
            queued=int(self._waiting is not None),
        )

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame. Never waits; one that still waits gives way."""
        if self.is_paused or not self._thinning.admits(frame.time_ns):
            self._thinned += 1
            return
        if self._waiting is not None:
            self._dropped += 1
        self._waiting = frame
        self._wake.set()

    async def open(self) -> None:
        """Open the sink; does nothing for the second time. Raises ``OutputError``."""
        if not self._is_open:
            await self._sink.open()
            self._is_open = True

    async def start(self) -> None:
        """Begin. Raises ``OutputError`` when the sink cannot be opened."""
        await self.open()
        self._task = asyncio.create_task(self._run(), name=f"output {self.name}")

    async def stop(self) -> None:
        """End, begun or not; what still waits is dropped."""
        if self._task is not None:
            await end_tasks(self._task)
            self._task = None
        self._sink.close()
        self._is_open = False

    async def _run(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            frame, self._waiting = self._waiting, None
            if frame is not None:
                self._send(frame)

    def _send(self, frame: SkeletonFrame) -> None:
        try:
            is_sent = self._sink.send(frame)
        except Exception as error:
            # Nothing that is wrong with one output may end it, or the others.
            is_sent = False
            if not self._has_complained:
                self._has_complained = True
                _log.warning("output %s: a pose could not be sent (%s)", self.name, error)
        if is_sent:
            self._published += 1
        else:
            self._dropped += 1
