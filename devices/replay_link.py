"""A recording as a link: the chunks of a log with the arrival times they had."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import logging
from collections.abc import AsyncIterator
from pathlib import Path

from devices.chunk_log import ChunkLogError, ChunkLogReader, LoggedLink
from devices.link import Chunk, Framing, LinkError, gateway_time_ns

_log = logging.getLogger(__name__)

# At full speed other tasks still get their turn every so many chunks.
_CHUNKS_A_TURN = 32


class ReplayLink:
    """The chunks of one link of a chunk log.

    ``speed`` 1 is as recorded, 2 twice as fast, None as fast as the reader takes them; arrival times
    are those of the recording whatever the speed. All links of a log replayed at the same time keep
    step: time counts from the first chunk of the log. What is written is discarded.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        link: str | None = None,
        speed: float | None = 1.0,
        name: str | None = None,
    ) -> None:
        """``link`` names the recorded link; it may be left out when the log holds only one."""
        if speed is not None and not speed > 0:
            raise ValueError(f"speed {speed}: give a positive number, or None for as fast as possible")
        self.path = Path(path)
        self.name = name or link or str(path)
        self.framing = Framing.BYTE_STREAM
        """That of the recording, known as soon as the file can be read."""
        self.defect: str | None = None
        """What was wrong with the tail of the file, once the end was reached."""
        self._link = link
        self._speed = speed
        self._has_own_name = name is not None
        self._reader: ChunkLogReader | None = None
        self._is_open = False
        self._closing: asyncio.Event | None = None
        with contextlib.suppress(LinkError):  # said by open()
            self._select()

    async def open(self) -> None:
        if self._is_open:
            raise LinkError(f"{self.name} is already open")
        self._select()
        self._closing = asyncio.Event()
        self._is_open = True

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        if self._reader is None or self._closing is None:
            raise LinkError(f"{self.name} is not open: call open() before reading")
        start_ns = gateway_time_ns()
        first_ns: int | None = None
        for count, chunk in enumerate(self._reader):
            first_ns = chunk.arrived_ns if first_ns is None else first_ns
            if count % _CHUNKS_A_TURN == 0:
                await asyncio.sleep(0)
            if chunk.link == self._link and self._speed is not None:
                turn_ns = start_ns + (chunk.arrived_ns - first_ns) / self._speed
                await _wait_until(turn_ns, self._closing)
            if self._closing.is_set():
                return
            if chunk.link == self._link:
                yield Chunk(chunk.data, chunk.arrived_ns, self.name)
        self.defect = self._reader.defect
        if self.defect is not None:
            _log.warning("%s", self.defect)

    async def write(self, data: bytes) -> None:
        """Nothing: the modules of a recording take no commands."""

    async def close(self) -> None:
        self._is_open = False
        if self._closing is not None:
            self._closing.set()

    def _select(self) -> None:
        """Open the log and find the link in it."""
        try:
            self._reader = ChunkLogReader(self.path)
        except ChunkLogError:
            raise
        except OSError as error:
            raise LinkError(f"recording {self.path} cannot be read: {error.strerror}") from error
        recorded = self._recorded_link(self._reader.links)
        self._link = recorded.name
        self.framing = recorded.framing
        if not self._has_own_name:
            self.name = recorded.name

    def _recorded_link(self, links: tuple[LoggedLink, ...]) -> LoggedLink:
        by_name = {link.name: link for link in links}
        if self._link is None and len(links) == 1:
            return links[0]
        if self._link is not None and self._link in by_name:
            return by_name[self._link]
        known = ", ".join(by_name) or "none"
        if self._link is None:
            raise LinkError(f"{self.path} holds several links: choose one with link= ({known})")
        near = difflib.get_close_matches(self._link, by_name, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"it has: {known}"
        raise LinkError(f"{self.path} has no link '{self._link}': {hint}")


async def _wait_until(turn_ns: float, closing: asyncio.Event) -> None:
    wait_s = (turn_ns - gateway_time_ns()) * 1e-9
    if wait_s > 0:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closing.wait(), wait_s)
