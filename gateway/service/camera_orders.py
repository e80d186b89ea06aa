"""Where people will be, sent to the cameras on the links that their heat maps come by."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence

from devices.link import LinkError
from devices.reconnect import ReconnectingLink


class CameraOrders:
    """Writes the newest orders to every link, and waits for none: what a link does not take is left out."""

    def __init__(self, links: Sequence[ReconnectingLink]) -> None:
        self._links = links
        self._writing: dict[str, asyncio.Task[None]] = {}

    def send(self, line: bytes) -> None:
        """Hand a line of orders to every link that has taken the one before. Needs a running event loop."""
        for link in self._links:
            before = self._writing.get(link.name)
            if before is None or before.done():
                self._writing[link.name] = asyncio.create_task(_write(link, line), name=f"orders {link.name}")


async def _write(link: ReconnectingLink, line: bytes) -> None:
    with contextlib.suppress(LinkError):  # the link's own state tells that it is down
        await link.write(line)
