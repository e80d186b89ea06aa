"""What every transport of an emulated suit is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from devices.link import Framing

OnReceive = Callable[[bytes], None]
"""Takes what the host has sent: bytes in any chunks, or whole CAN records, as the framing says."""


def ignore(data: bytes) -> None:
    """What is done with the host's bytes while nobody listens."""


class Transport(Protocol):
    """A way into the host, and from the host to the suit.

    ``offer`` takes data whole or refuses it: it never waits, raises nothing for an absent, slow or lost
    reader, and holds back no more than the rest of one chunk. Offering ``b""`` moves such a rest on
    and says whether there is room.
    """

    framing: Framing

    @property
    def url(self) -> str:
        """What a gateway's link is to be called to read this (``devices.endpoints``); empty until open."""
        ...

    async def open(self) -> None: ...

    def offer(self, data: bytes) -> bool: ...

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host sends, in the event loop, within a few milliseconds."""
        ...

    async def close(self) -> None: ...
