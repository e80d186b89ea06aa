"""A serial port, USB receiver or pseudo-terminal as a link."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Sequence

from devices.arrivals import Arrivals
from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.link_counts import LinkCounts, SerialErrors
from devices.raw_tty import open_raw_tty

DEFAULT_BAUD = 1_000_000  # 17 modules at 100 Hz need about 1.1 Mbit/s uncompressed, batches less
_READ_SIZE = 65536
_LOOK_INTERVAL_NS = 100_000_000
"""How often the driver is asked for what it lost."""


class SerialLink:
    """Bytes of one serial port, raw and exclusive.

    The path is resolved at every ``open``, so a by-id name or a symlink to a pseudo-terminal finds
    its device again after it came back elsewhere. Once the port is lost it is released at once:
    a receiver that is plugged in again can have its old name.
    """

    framing = Framing.BYTE_STREAM

    def __init__(self, path: str, *, baud: int = DEFAULT_BAUD, name: str | None = None) -> None:
        self.name = name or path
        self.path = path
        self.baud = baud
        self._descriptor: int | None = None
        self._errors: SerialErrors | None = None
        self._look_due_ns = 0
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(self.name)
        self._write_turn = asyncio.Lock()
        self._writable: asyncio.Future[None] | None = None

    async def open(self) -> None:
        """Open the port raw at its baud rate. Raises ``LinkError``: absent, forbidden, busy, no such rate."""
        if self._descriptor is not None:
            raise LinkError(f"{self.name} is already open")
        self._descriptor = open_raw_tty(self.path, self.baud)
        self._arrivals = Arrivals(self.name, counts=self.counts)
        self._errors = SerialErrors(self.counts, self._descriptor)
        asyncio.get_running_loop().add_reader(self._descriptor, self._receive, self._descriptor)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Write all of ``data``, waiting (not blocking) while the port is full.

        Raises ``LinkError`` when the link is closed or lost before all is written.
        """
        # One writer at a time: frames of two must not mix on the line.
        async with self._write_turn:
            remaining = memoryview(data)
            while remaining:
                descriptor = self._open_descriptor()
                sent = self._write_some(descriptor, remaining)
                remaining = remaining[sent:]
                if not sent:
                    await self._wait_until_writable(descriptor)

    async def close(self) -> None:
        """Give the port back; iterating the link ends."""
        self._release(None)

    def _receive(self, descriptor: int) -> None:
        arrived_ns = gateway_time_ns()
        try:
            data = os.read(descriptor, _READ_SIZE)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(error.strerror)
            return
        if self._errors is not None and arrived_ns >= self._look_due_ns:
            self._look_due_ns = arrived_ns + _LOOK_INTERVAL_NS
            self._errors.look()
        if data:
            self._arrivals.put(data, arrived_ns)
        else:
            self._lose("hung up")

    def _open_descriptor(self) -> int:
        if self._descriptor is None:
            raise self._arrivals.error or LinkError(f"{self.name} is closed")
        return self._descriptor

    def _write_some(self, descriptor: int, data: memoryview) -> int:
        try:
            return os.write(descriptor, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self._lose(error.strerror) from error

    async def _wait_until_writable(self, descriptor: int) -> None:
        loop = asyncio.get_running_loop()
        self._writable = loop.create_future()
        loop.add_writer(descriptor, self._note_writable)
        try:
            await self._writable
        finally:
            self._writable = None
            # Once closed, the number may be another file's.
            if self._descriptor == descriptor:
                loop.remove_writer(descriptor)

    def _note_writable(self) -> None:
        if self._writable is not None and not self._writable.done():
            self._writable.set_result(None)

    def _lose(self, reason: str | None) -> LinkError:
        error = LinkError(f"{self.path} was lost ({reason}): the device was unplugged or switched off")
        self._release(error)
        return error

    def _release(self, error: LinkError | None) -> None:
        if self._descriptor is None:
            return
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._descriptor)
        loop.remove_writer(self._descriptor)
        os.close(self._descriptor)
        self._descriptor = None
        self._arrivals.end(error)
        if self._writable is not None and not self._writable.done():
            self._writable.set_exception(error or LinkError(f"{self.name} was closed while writing"))
