"""A serial port of another computer, by the telnet COM port option (RFC 2217), as a link."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import serial

from devices.link import Framing, LinkError
from devices.links.reader_thread import ThreadLink
from devices.links.serial_link import DEFAULT_BAUD

# How long the reading thread may take to notice that the link is being closed.
_READ_TIMEOUT_S = 0.05


class Rfc2217Link(ThreadLink[serial.Serial]):
    """Bytes of a remote serial port, by pyserial, read in a thread of its own."""

    framing = Framing.BYTE_STREAM

    def __init__(self, host: str, port: int, *, baud: int = DEFAULT_BAUD, name: str | None = None) -> None:
        self.url = f"rfc2217://{host}:{port}"
        self.baud = baud
        super().__init__(name or self.url)

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send ``data`` to the serial server. Raises ``LinkError`` when it is closed or lost."""
        port = self._in_use()
        try:
            await asyncio.to_thread(port.write, data)
        except OSError as error:  # SerialException among them
            raise LinkError(f"{self.name} was lost while writing: {error}") from error

    def _open(self) -> serial.Serial:
        try:
            return serial.serial_for_url(self.url, baudrate=self.baud, timeout=_READ_TIMEOUT_S)
        except (OSError, ValueError) as error:  # SerialException among them
            raise LinkError(
                f"{self.url} cannot be opened ({error}): check that a serial server listens there"
            ) from error

    def _read(self, opened: serial.Serial) -> bytes:
        first = opened.read(1)
        return first + opened.read(opened.in_waiting) if first else b""

    def _close(self, opened: serial.Serial) -> None:
        opened.close()
