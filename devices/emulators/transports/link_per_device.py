"""Devices that have a link each, as modules of other makers do."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from devices.emulators.transports.transport import OnReceive, Transport


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
