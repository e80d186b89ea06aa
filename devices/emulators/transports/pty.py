"""A pseudo-terminal in place of a USB receiver's serial port, or of a CAN adapter that speaks slcan."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import termios
import tty
from pathlib import Path

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing
from devices.links.slcan import SlcanDecoder, encode_slcan
from firmware_protocol import pack_can_records, unpack_can_records

_POLL_INTERVAL_S = 0.002
_READ_SIZE = 4096


class PtyTransport:
    """Creates a pseudo-terminal; a gateway opens its slave side as it would a serial port.

    The reader may come, go and come again. While nobody has the port open, what is offered is
    refused, and what a reader left unread is discarded: a closed port receives nothing.
    """

    framing = Framing.BYTE_STREAM

    def __init__(self, link_path: str | Path | None = None) -> None:
        """Prepare; ``link_path`` is where a symbolic link to the slave side goes, to give it a fixed name."""
        self.path = ""
        """Path of the slave side (the symbolic link if one was asked for), once open."""
        self._link_path = None if link_path is None else Path(link_path)
        self._on_receive: OnReceive = ignore
        self._master = -1
        self._slave_path = ""
        self._rest = b""
        self._has_reader = False
        self._poll = select.poll()
        self._poller: asyncio.Task[None] | None = None

    @property
    def url(self) -> str:
        """Where a host finds it, as a ``url`` of its configuration; empty while closed."""
        return self.path

    async def open(self) -> None:
        """Create the pseudo-terminal. Raises ``FileExistsError`` when the link's path is something else."""
        self._master, slave = os.openpty()
        os.set_blocking(self._master, False)
        tty.setraw(slave)
        self._slave_path = self.path = os.ttyname(slave)
        os.close(slave)  # only then can the master see whether a reader is there
        self._poll.register(self._master, select.POLLIN)
        if self._link_path is not None:
            if self._link_path.is_symlink():
                self._link_path.unlink()
            self._link_path.symlink_to(self._slave_path)
            self.path = str(self._link_path)
        self._poller = asyncio.create_task(self._keep_polling())

    def offer(self, data: bytes) -> bool:
        """Write data if a reader is there and has taken what was written before."""
        if self._master < 0 or not self._look():
            return False
        self._write_rest()
        if self._rest:
            return False
        written = self._write(data)
        if data and not written:
            return False
        self._rest = data[written:]
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand what the reader writes to a callback."""
        self._on_receive = on_receive

    async def close(self) -> None:
        """Remove the pseudo-terminal; the reader sees a lost port."""
        if self._poller is not None:
            self._poller.cancel()
            self._poller = None
        # First: the kernel gives the number of a closed pseudo-terminal to the next one, anybody's.
        if self._link_path is not None and self._points_here(self._link_path):
            self._link_path.unlink()
        if self._master >= 0:
            self._poll.unregister(self._master)
            os.close(self._master)
            self._master = -1
        self._rest, self._has_reader = b"", False

    def _points_here(self, link: Path) -> bool:
        """Return whether a link is still ours: another suit may have taken its place."""
        return link.is_symlink() and os.readlink(link) == self._slave_path

    async def _keep_polling(self) -> None:
        # Not by the event loop's readiness: while nobody has the slave open that would fire without end.
        while True:
            if self._look():
                self._write_rest()
            await asyncio.sleep(_POLL_INTERVAL_S)

    def _look(self) -> bool:
        """Return whether there is a reader; take in what it wrote."""
        events = self._poll.poll(0)
        state = events[0][1] if events else 0
        if state & select.POLLIN:
            with contextlib.suppress(OSError):  # EIO: the reader has just gone
                self._on_receive(os.read(self._master, _READ_SIZE))
        has_reader = not state & select.POLLHUP
        if self._has_reader and not has_reader:
            self._discard_unread()
        self._has_reader = has_reader
        return has_reader

    def _write_rest(self) -> None:
        """Go on with a chunk that was taken in part; nobody may offer another for a while."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest) :]

    def _write(self, data: bytes) -> int:
        """Write what fits; return how many bytes went out."""
        try:
            return os.write(self._master, data)
        except OSError:  # full, or the reader has just gone
            return 0

    def _discard_unread(self) -> None:
        self._rest = b""
        slave = os.open(self._slave_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        with contextlib.suppress(termios.error):
            termios.tcflush(slave, termios.TCIFLUSH)
        os.close(slave)


_DONE, _REFUSED = b"\r", b"\x07"
_SETTINGS = frozenset(b"SsYyZMmW")  # bit rates, time stamps, filters: acknowledged, without effect
_SENDING = {**dict.fromkeys(b"trdb", b"z\r"), **dict.fromkeys(b"TRDB", b"Z\r")}
_ANSWERS = {ord("V"): b"V1013\r", ord("N"): b"NEMUL\r", ord("F"): b"F00\r"}
_LONGEST_COMMAND = 256


class SlcanTransport:
    """Answers the adapter's commands; frames of the bus flow while the host has the channel open."""

    framing = Framing.CAN

    def __init__(self, link_path: str | Path | None = None) -> None:
        """Prepare an adapter; ``link_path`` as in ``PtyTransport``."""
        self.is_channel_open = False
        self.commands: list[bytes] = []
        """What the host asked for, without the carriage returns, frames to be sent not included."""
        self.frames_received = 0
        """CAN frames that the host sent."""
        self._pty = PtyTransport(link_path)
        self._pty.listen(self._take)
        self._partial = b""
        self._lines = SlcanDecoder()
        self._on_receive: OnReceive = ignore

    @property
    def path(self) -> str:
        """Path of the slave side, once open."""
        return self._pty.path

    @property
    def url(self) -> str:
        """Where a host finds it, as a ``url`` of its configuration; empty while closed."""
        return f"slcan://{self.path}" if self.path else ""

    async def open(self) -> None:
        """Create the pseudo-terminal."""
        await self._pty.open()

    def offer(self, data: bytes) -> bool:
        """Write CAN records as lines of text, if the channel is open."""
        if not self.is_channel_open:
            return False
        return self._pty.offer(b"".join(map(encode_slcan, unpack_can_records(data))))

    def listen(self, on_receive: OnReceive) -> None:
        """Hand the frames that the host sends to a callback, as CAN records."""
        self._on_receive = on_receive

    async def close(self) -> None:
        """Remove the pseudo-terminal."""
        self.is_channel_open = False
        await self._pty.close()

    def _take(self, data: bytes, _device: int | None = None, /) -> None:
        *commands, self._partial = (self._partial + data).split(b"\r")
        self._partial = self._partial[-_LONGEST_COMMAND:]
        for command in commands:
            self._pty.offer(self._answer(command))

    def _answer(self, command: bytes) -> bytes:
        letter = command[0] if command else 0
        if letter in _SENDING:
            self.frames_received += 1
            # As adapters do: frames are refused until the channel is opened.
            if not self.is_channel_open:
                return _REFUSED
            if frames := self._lines.feed(command + b"\r"):
                self._on_receive(pack_can_records(frames))
            return _SENDING[letter]
        if command:
            self.commands.append(command)
        if command in (b"O", b"L"):
            self.is_channel_open = True
        elif command == b"C":
            self.is_channel_open = False
        elif command and letter not in _SETTINGS and letter not in _ANSWERS:
            return _REFUSED
        return _ANSWERS.get(letter, _DONE)
