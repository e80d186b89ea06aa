"""What a link is: bytes out of a serial port, CAN bus, socket or recording, and bytes back in.

A link opens, reads, writes and closes. It interprets no byte of what the modules say, and it
stamps every chunk in its receive callback, before any queue, so that a busy consumer cannot smear
the arrival times that the clock estimation rests on.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

# Gateway time is the monotonic clock shifted once, at import, to read like UTC. It therefore never
# steps when the host's wall clock is set.
_UTC_ANCHOR_NS = time.time_ns() - time.monotonic_ns()


def gateway_time_ns() -> int:
    """Now, in gateway time: nanoseconds since the Unix epoch as of process start, never stepping."""
    return time.monotonic_ns() + _UTC_ANCHOR_NS


class Framing(Enum):
    """How the bytes of a link are to be taken apart."""

    BYTE_STREAM = "byte_stream"
    """COBS wire frames in a stream of bytes (serial, TCP, UDP)."""

    CAN = "can"
    """CAN frame records as packed by ``firmware_protocol.can_framing.pack_can_records``."""

    GNSS = "gnss"
    """NMEA 0183 and UBX messages of a satellite receiver; nothing of ours, and nothing is written to it."""

    MARKERS = "markers"
    """Marker messages of an optical system (``devices.marker_messages``); nothing is written to it."""

    HEAT_MAPS = "heat_maps"
    """Heat maps of cameras (``devices.cameras.heat_map_messages``); nothing is written to it."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as a link gave them."""

    data: bytes
    arrived_ns: int
    """Gateway time of the receive callback, ns."""
    link: str
    """Name of the link it came from."""
    sender: str = ""
    """Address of whoever sent it, as ``HOST:PORT``; empty where only one can be at the other end."""


@dataclass(frozen=True, slots=True)
class SentChunk:
    """Bytes that the gateway itself put on a link: whole wire frames of the host, in the link's framing."""

    data: bytes
    sent_ns: int
    """Gateway time just before they were handed to the system, ns."""
    link: str
    """Name of the link they left by."""


class LinkError(Exception):
    """A link could not be opened, or was lost.

    ``str(error)`` is one line that says what was found and what would do.
    """


class Link(Protocol):
    """An open-able source of chunks.

    ``open`` raises ``LinkError`` when the port is absent, busy or forbidden. Iterating yields
    chunks until the other side closes (end of iteration) or is lost (``LinkError``). A closed link
    can be opened again. ``write`` sends to those ``to`` names, on a link whose chunks name their senders;
    any other link has one other end and passes ``to`` over.
    """

    name: str
    framing: Framing

    async def open(self) -> None: ...

    def __aiter__(self) -> AsyncIterator[Chunk]: ...

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None: ...

    async def close(self) -> None: ...
