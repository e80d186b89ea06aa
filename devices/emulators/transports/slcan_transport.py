"""A CAN adapter that speaks slcan over a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path

from devices.emulators.transports.pty_transport import PtyTransport
from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing
from devices.links.slcan import SlcanDecoder, encode_slcan
from firmware_protocol import pack_can_records, unpack_can_records

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
