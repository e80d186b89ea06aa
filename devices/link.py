"""What a link is: bytes out of a serial port, CAN bus, socket or recording, and bytes back in.

A link opens, reads, writes and closes. It interprets no byte of what the modules say, and it
stamps every chunk in its receive callback, before any queue, so that a busy consumer cannot smear
the arrival times that the clock estimation rests on.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

# Gateway time is the monotonic clock shifted once, at import, to read like UTC. It therefore never
# steps when the host's wall clock is set.
_UTC_ANCHOR_NS = time.time_ns() - time.monotonic_ns()


def gateway_time_ns() -> int:
    """Return the present in gateway time, ns since the Unix epoch as of process start, never stepping."""
    return time.monotonic_ns() + _UTC_ANCHOR_NS


class Framing(StrEnum):
    """How the bytes of a link are cut into wire frames."""

    BYTE_STREAM = "byte_stream"
    """COBS wire frames in a stream of bytes (serial, TCP, UDP)."""

    CAN = "can"
    """CAN frame records as packed by ``firmware_protocol.can_framing.pack_can_records``."""


SUIT = "suit"
"""What a link carries unless the configuration says otherwise: packets of modules."""


def content_of(carries: str, framing: Framing) -> str:
    """Return in one word what the bytes of a link are, as recordings keep it.

    That is the framing where they are packets of modules, else the word of the configuration.
    """
    return framing if carries == SUIT else carries


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as a link gave them."""

    data: bytes
    arrived_ns: int
    """Gateway time of the receive callback, ns."""
    link: str
    """Name of the link it came from."""
    sender: str = ""
    """Address of the sender, as ``HOST:PORT``; empty where only one can be at the other end."""


@dataclass(frozen=True, slots=True)
class SentChunk:
    """Bytes that the gateway itself put on a link: whole wire frames of the host, in the link's framing."""

    data: bytes
    sent_ns: int
    """Gateway time just before they were handed to the system, ns."""
    link: str
    """Name of the link they left by."""


class InputEvent(NamedTuple):
    """Something asked of the gateway, or that happened to it: an input beside the bytes."""

    name: str
    data: Mapping[str, Any]
    time_ns: int = 0
    """Gateway time, ns, where it was recorded."""


LinkItem = Chunk | SentChunk | InputEvent
"""What a link may give: one with something at its other end gives chunks, a recording all that it kept."""


class LinkError(Exception):
    """A link could not be opened, or was lost.

    ``str(error)`` is one line that says what was found and what would do.
    """


class LinkBusyError(LinkError):
    """What a link is to be opened on belongs to another program at the moment."""


class Link(Protocol):
    """An open-able source of chunks.

    ``open`` raises ``LinkError`` when the port is absent, busy or forbidden. Iterating yields
    items until the other side closes (end of iteration) or is lost (``LinkError``). A closed link
    can be opened again. ``write`` sends to those ``to`` names, on a link whose chunks name their senders;
    any other link has one other end and passes ``to`` over.
    """

    name: str
    framing: Framing

    async def open(self) -> None:
        """Open the link. Raises ``LinkError`` that says what was found, and the remedy."""

    def __aiter__(self) -> AsyncIterator[LinkItem]: ...

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Write bytes; ``to`` names the ends on a link with several. Raises ``LinkError``."""

    async def close(self) -> None:
        """Close the link; iterating it ends."""


class LiveLink(Link, Protocol):
    """A link with something at its other end: it gives chunks alone."""

    def __aiter__(self) -> AsyncIterator[Chunk]: ...
