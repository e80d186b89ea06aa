"""What every transport of an emulated suit is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from devices.link import Framing


class OnReceive(Protocol):
    """Takes what the host has sent: bytes in any chunks, or whole CAN records, as the framing says."""

    def __call__(self, data: bytes, device: int | None = None, /) -> None:
        """Take bytes of the host; ``device`` is the one that they came to, None: all on the link."""
        ...


def ignore(data: bytes, device: int | None = None, /) -> None:
    """Discard the host's bytes while no listener is set."""


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

    async def open(self) -> None:
        """Open the transport, for gateways to connect to."""

    def offer(self, data: bytes) -> bool:
        """Send bytes if the reader takes them now; return whether it did."""

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host sends, in the event loop, within a few milliseconds."""
        ...

    async def close(self) -> None:
        """Close the transport."""


@runtime_checkable
class DatagramTransport(Transport, Protocol):
    """One on which each device has an address of its own, and each transmission is a datagram."""

    def offer_from(self, device: int | None, data: bytes) -> bool:
        """Send as ``offer``, from a device by its number; None: from none of them."""
        ...
