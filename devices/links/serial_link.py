"""A serial port, USB receiver or pseudo-terminal as a link: opened raw, exclusive and non-blocking.

Works alike for UARTs, USB receivers and pseudo-terminals.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import struct
import termios
from array import array
from collections.abc import AsyncIterator, Sequence

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts, SerialErrors
from devices.links.serial_ports import open_error

# Linux: any speed at all goes through termios2 (asm-generic/termbits.h), standard ones through termios.
_TCGETS2 = 0x802C542A
_TCSETS2 = 0x402C542B
_TERMIOS2 = struct.Struct("<4I B 19s 2I")  # iflag oflag cflag lflag, line, cc, ispeed ospeed
_CBAUD = 0o010017
_BOTHER = 0o010000

_ASYNC_LOW_LATENCY = 1 << 13
_SERIAL_STRUCT_WORDS = 32  # struct serial_struct has 72 bytes at most; the rest is room
_SERIAL_STRUCT_FLAGS = 4  # index of its flags word


def open_raw_tty(path: str, baud: int) -> int:
    """Open ``path`` raw (8N1, no flow control, no echo) and exclusive; the descriptor never blocks.

    What waited in the input buffer is discarded: it is older than its arrival time would say.
    Raises ``LinkError`` when the port is absent, forbidden, busy or no terminal.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise open_error(path, error) from error
    try:
        _configure(descriptor, path, baud)
    except termios.error as error:  # not an OSError, though it carries the same numbers
        os.close(descriptor)
        raise open_error(path, OSError(*error.args)) from error
    except OSError as error:
        os.close(descriptor)
        raise open_error(path, error) from error
    return descriptor


def _configure(descriptor: int, path: str, baud: int) -> None:
    termios.tcgetattr(descriptor)  # refuses what is not a terminal before anything is locked
    _lock(descriptor, path)
    _set_raw(descriptor)
    _set_speed(descriptor, baud)
    _set_low_latency(descriptor)
    termios.tcflush(descriptor, termios.TCIFLUSH)


def _lock(descriptor: int, path: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY)) from error
    # The kernel's own exclusive mode also keeps out programs that do not lock. Not on a
    # pseudo-terminal: if we were killed it would stay set for as long as the emulator keeps its end.
    if not os.path.realpath(path).startswith("/dev/pts/"):
        fcntl.ioctl(descriptor, termios.TIOCEXCL)


def _set_raw(descriptor: int) -> None:
    iflag, oflag, cflag, lflag, ispeed, ospeed, characters = termios.tcgetattr(descriptor)
    iflag &= ~(termios.IGNBRK | termios.BRKINT | termios.PARMRK | termios.ISTRIP | termios.INPCK)
    iflag &= ~(termios.INLCR | termios.IGNCR | termios.ICRNL | termios.IXON | termios.IXOFF | termios.IXANY)
    oflag &= ~termios.OPOST
    lflag &= ~(termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG | termios.IEXTEN)
    cflag &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    cflag |= termios.CS8 | termios.CREAD | termios.CLOCAL
    # With VMIN 0 "nothing yet" and "hung up" would both read as zero bytes.
    characters[termios.VMIN] = 1
    characters[termios.VTIME] = 0
    attributes = [iflag, oflag, cflag, lflag, ispeed, ospeed, characters]
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)


def _set_speed(descriptor: int, baud: int) -> None:
    standard = getattr(termios, f"B{baud}", None)
    if standard is not None:
        attributes = termios.tcgetattr(descriptor)
        attributes[4] = attributes[5] = standard
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
        return
    # Other rates go through Linux's termios2, where the rate is a number and not one of a list.
    settings = bytearray(_TERMIOS2.size)
    fcntl.ioctl(descriptor, _TCGETS2, settings)
    iflag, oflag, cflag, lflag, line, characters, _, _ = _TERMIOS2.unpack(settings)
    cflag = (cflag & ~_CBAUD) | _BOTHER
    fcntl.ioctl(
        descriptor, _TCSETS2, _TERMIOS2.pack(iflag, oflag, cflag, lflag, line, characters, baud, baud)
    )


def _set_low_latency(descriptor: int) -> None:
    """Ask the driver to hand bytes on at once: an FTDI receiver otherwise holds them for 16 ms."""
    settings = array("i", [0] * _SERIAL_STRUCT_WORDS)
    # Drivers and pseudo-terminals without this setting refuse it, and some allow it to root only.
    with contextlib.suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCGSERIAL, settings)
        settings[_SERIAL_STRUCT_FLAGS] |= _ASYNC_LOW_LATENCY
        fcntl.ioctl(descriptor, termios.TIOCSSERIAL, settings)


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
