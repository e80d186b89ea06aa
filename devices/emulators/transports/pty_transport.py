"""A pseudo-terminal in place of a USB receiver's serial port."""

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
