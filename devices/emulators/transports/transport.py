"""What every transport of an emulated suit is."""

from __future__ import annotations

from typing import Protocol

from devices.link import Framing


class Transport(Protocol):
    """A way into the host.

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

    async def close(self) -> None: ...
