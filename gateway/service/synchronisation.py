"""Two-way time exchanges with the modules, while capturing: the I/O shell of ``gateway.sources.exchanges``.

Every so often all modules are asked what time they have. Those whose firmware answers get clocks whose
offset is free of the transport's delay, to a bound that is published; the others lose nothing.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Sequence

from devices.link import Link, gateway_time_ns
from firmware_protocol import BROADCAST, SyncRequest, WireFrame, wire_frame
from gateway.service.host_sender import HostSender

UNEVENNESS = 0.9, 1.1
"""Parts of the interval that questions are apart: in step with nothing, so that answers wait now longer, now
shorter for a relay's tick or a slot of USB."""
_TOKENS = 1 << 16


def question(asked: int, now_ns: int) -> WireFrame:
    """Return what time do you have? To all modules; asked: how many questions went before; now_ns: gateway
    time."""
    token, now_us = asked % _TOKENS, now_ns // 1000
    return wire_frame(SyncRequest(token=token, host_time_us=now_us), BROADCAST, token, now_us % 2**32)


class Synchroniser:
    """Asks over every link in turn; belongs to one event loop."""

    name = "synchroniser"

    def __init__(
        self,
        links: Sequence[Link],
        sender: HostSender,
        interval_s: float,
        clock_ns: Callable[[], int] = gateway_time_ns,
    ) -> None:
        """Ask over ``links`` every ``interval_s`` seconds; the list may grow while this runs."""
        self._links = links
        self._sender = sender
        self._interval_s = interval_s
        self._clock_ns = clock_ns
        self._asked = 0

    async def run(self) -> None:
        """Ask for ever."""
        while True:
            await asyncio.sleep(self._interval_s * random.uniform(*UNEVENNESS))
            await self.request_all()

    def statistics(self) -> dict[str, object]:
        """Return nothing: the clocks have the figures of what the answers are worth."""
        return {}

    async def request_all(self) -> None:
        """Ask once, over every link."""
        for link in self._links:
            await self._ask(link)

    async def _ask(self, link: Link) -> None:
        """Send one time request to all modules on a link; a link that is down is skipped until it is back."""
        frame = question(self._asked, self._clock_ns())
        self._asked += 1
        await self._sender.send(link, frame)
