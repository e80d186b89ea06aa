"""What became of all that one link took from the system, over all its connections."""

from __future__ import annotations

import array
import fcntl
import select
import socket
import sys
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from firmware_protocol import Defect

# asm-generic/ioctls.h, linux/serial.h (struct serial_icounter_struct: eleven counters and room), and
# asm-generic/socket.h; Python's modules lack them.
_TIOCGICOUNT = 0x545D
_ICOUNTER_WORDS = 20
_FRAME, _OVERRUN, _PARITY, _BUFFER_OVERRUN = 6, 7, 8, 10
_SO_RXQ_OVFL = 40
_COUNT_MODULUS = 2**32

ANCILLARY_SIZE = socket.CMSG_SPACE(4)
"""Room for the system's count of what it had to drop, for ``recvmsg``."""


class LostBefore(Enum):
    """Where something was lost before this program could read it."""

    SERIAL_OVERRUN = "the serial port's buffer was full: so many times bytes were lost"
    SERIAL_DAMAGED = "bytes came with a framing or parity error"
    KERNEL_OVERFLOW = "the socket's buffer was full: CAN frames or datagrams were lost"
    CONTROLLER_OVERFLOW = "the CAN controller's buffer was full: so many times frames were lost"
    NOT_SENT = "frames that an optical system left out, by the gaps in its numbers"


@dataclass
class LinkCounts:
    """Bytes taken = handed on + dropped because the reader was too far behind + waiting."""

    taken: int = 0
    """Bytes read from the system."""
    handed: int = 0
    """Bytes given to the reader."""
    behind: int = 0
    """Bytes dropped because the reader was too far behind."""
    waiting: int = 0
    """Bytes that the reader has not asked for yet."""
    refused: int = 0
    """Datagrams of senders that the link was told to take nothing from; not among what was taken."""
    unverified: Counter[Defect] = field(default_factory=Counter)
    """Wire frames that a signed link dropped for their signatures, by reason; among what was handed."""
    before: Counter[LostBefore] = field(default_factory=Counter)
    """What the system says that it lost."""
    backlog_since_ns: int | None = None
    """Gateway time since which the system has had more than was read at a turn; None: it has nothing more.
    What waits there has no arrival time yet: this is the least by which the reader is behind."""

    def end_turn(self, begun_ns: int, bound: socket.socket) -> None:
        """Note after reading as much as one turn of the loop may take, whether the socket holds more."""
        if not _has_more(bound):
            self.backlog_since_ns = None
        elif self.backlog_since_ns is None:
            self.backlog_since_ns = begun_ns

    @property
    def losses(self) -> int:
        """A number that grows with every loss, of whatever kind."""
        return self.behind + self.before.total()

    def summary(self) -> dict[str, int]:
        """Return the counts by name, for the health message."""
        before = {place.name.lower(): count for place, count in self.before.items()}
        refused = {"refused": self.refused} if self.refused else {}
        unverified = {defect.name.lower(): count for defect, count in self.unverified.items()}
        taken = {"taken": self.taken, "handed": self.handed, "behind": self.behind}
        return {**taken, **refused, **unverified, **before}


class SystemCount:
    """A count of the system's that begins anew with every connection, added to those of the link."""

    def __init__(self, counts: LinkCounts, place: LostBefore) -> None:
        self._counts = counts
        self._place = place
        self._seen = 0

    def begin_at(self, value: int) -> None:
        """Begin to count a new connection's losses at ``value``."""
        self._seen = value

    def now(self, value: int) -> None:
        """Add what the system has lost since the last call; ``value`` counts modulo 2^32."""
        self._counts.before[self._place] += (value - self._seen) % _COUNT_MODULUS
        self._seen = value


class SerialErrors:
    """What a serial driver counts; pseudo-terminals and some drivers do not."""

    def __init__(self, counts: LinkCounts, descriptor: int) -> None:
        self._overruns = SystemCount(counts, LostBefore.SERIAL_OVERRUN)
        self._damaged = SystemCount(counts, LostBefore.SERIAL_DAMAGED)
        self._descriptor = descriptor
        found = self._read()
        self.are_reported = found is not None
        if found is not None:
            self._overruns.begin_at(found[0])
            self._damaged.begin_at(found[1])

    def look(self) -> None:
        """Add what has been lost since the last look."""
        found = self._read() if self.are_reported else None
        if found is not None:
            self._overruns.now(found[0])
            self._damaged.now(found[1])

    def _read(self) -> tuple[int, int] | None:
        counters = array.array("i", [0] * _ICOUNTER_WORDS)
        try:
            fcntl.ioctl(self._descriptor, _TIOCGICOUNT, counters)
        except OSError:
            return None
        overruns = (counters[_OVERRUN] + counters[_BUFFER_OVERRUN]) % _COUNT_MODULUS
        return overruns, (counters[_FRAME] + counters[_PARITY]) % _COUNT_MODULUS


def _has_more(bound: socket.socket) -> bool:
    poll = select.poll()
    poll.register(bound, select.POLLIN)
    return bool(poll.poll(0))


def ask_for_drops(bound: socket.socket) -> None:
    """Have the system say with each datagram how many it had to drop on this socket."""
    bound.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)


def reported_drops(ancillary: list[tuple[int, int, bytes]] | Any) -> int | None:
    """Return the count that came with something received; None when none did."""
    for _, kind, content in ancillary:
        if kind == _SO_RXQ_OVFL:
            return int.from_bytes(content, sys.byteorder)
    return None
