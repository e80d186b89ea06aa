"""What every transport of an emulated suit is, and a link for each of its devices, as other makers' have."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
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


class LinkPerDevice:
    """Several transports as one: what a device sends goes by its own."""

    def __init__(self, links: Mapping[int, Transport]) -> None:
        """Join links, by number of the device, all of one framing."""
        self.links = links
        self.framing = next(iter(links.values())).framing
        self._each = list(dict.fromkeys(links.values()))
        """Devices may share one."""

    @property
    def url(self) -> str:
        """What a gateway's links are to be called; empty until all are open."""
        urls = self.urls
        return " ".join(urls.values()) if len(urls) == len(self._each) else ""

    @property
    def urls(self) -> dict[int, str]:
        """The same by device, as far as they are open."""
        first = {link: device for device, link in reversed(list(self.links.items()))}
        return {first[link]: link.url for link in self._each if link.url}

    async def open(self) -> None:
        """Open all. Raises ``OSError``."""
        for link in self._each:
            await link.open()

    def offer(self, data: bytes) -> bool:
        """Give to all: what no device sends is on every line."""
        taken = [link.offer(data) for link in self._each]
        return all(taken)

    def offer_from(self, device: int | None, data: bytes) -> bool:
        """Give to the link of a device."""
        return self.offer(data) if device is None else self.links[device].offer(data)

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what comes, with the number of the device that it came to."""

        def hand_on(device: int, data: bytes, _device: int | None = None, /) -> None:
            on_receive(data, device)

        first = {link: device for device, link in reversed(list(self.links.items()))}
        for link, device in first.items():
            link.listen(partial(hand_on, device))

    async def close(self) -> None:
        """Close all."""
        for link in self._each:
            await link.close()
