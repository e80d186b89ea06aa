"""A serial port of another computer, by the telnet COM port option (RFC 2217), as a link."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence

import serial

from devices.arrivals import Arrivals
from devices.link import Chunk, Framing, LinkError
from devices.link_counts import LinkCounts
from devices.reader_thread import ReaderThread, open_in_thread
from devices.serial_link import DEFAULT_BAUD

# How long the reading thread may take to notice that the link is being closed.
_READ_TIMEOUT_S = 0.05


class Rfc2217Link:
    """Bytes of a remote serial port, by pyserial, read in a thread of its own."""

    framing = Framing.BYTE_STREAM

    def __init__(self, host: str, port: int, *, baud: int = DEFAULT_BAUD, name: str | None = None) -> None:
        self.url = f"rfc2217://{host}:{port}"
        self.name = name or self.url
        self.baud = baud
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(self.name)
        self._port: serial.Serial | None = None
        self._reader: ReaderThread | None = None

    async def open(self) -> None:
        """Connect in a thread, set the far port up, and begin to read. Raises ``LinkError``."""
        if self._port is not None:
            raise LinkError(f"{self.name} is already open")
        port = await open_in_thread(self._open_port, lambda port: port.close())
        self._port = port
        self._arrivals = Arrivals(self.name, counts=self.counts)
        self._reader = ReaderThread(self.name, lambda: _waiting_bytes(port), self._arrivals)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send ``data`` to the serial server. Raises ``LinkError`` when it is closed or lost."""
        if self._port is None or self._arrivals.has_ended:
            raise self._arrivals.error or LinkError(f"{self.name} is closed")
        try:
            await asyncio.to_thread(self._port.write, data)
        except OSError as error:  # SerialException among them
            raise LinkError(f"{self.name} was lost while writing: {error}") from error

    async def close(self) -> None:
        """End the reader, then the connection; does nothing on a closed link."""
        port, reader = self._port, self._reader
        self._port = self._reader = None
        self._arrivals.end()
        try:
            if reader is not None:
                await reader.stop()
        finally:
            if port is not None:
                await asyncio.to_thread(port.close)

    def _open_port(self) -> serial.Serial:
        try:
            return serial.serial_for_url(self.url, baudrate=self.baud, timeout=_READ_TIMEOUT_S)
        except (OSError, ValueError) as error:  # SerialException among them
            raise LinkError(
                f"{self.url} cannot be opened ({error}): check that a serial server listens there"
            ) from error


def _waiting_bytes(port: serial.Serial) -> bytes:
    first = port.read(1)
    return first + port.read(port.in_waiting) if first else b""
