"""Two-way time exchanges with the modules, while capturing: the I/O shell of ``gateway.exchanges``.

Every so often all modules are asked what time they have. Those whose firmware answers get clocks whose
offset is free of the transport's delay, to a bound that is published; the others lose nothing.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Sequence

from devices.link import Link, gateway_time_ns
from firmware_protocol import BROADCAST, SyncRequest, wire_frame
from gateway.host_sender import HostSender

_TOKENS = 1 << 16


class Synchroniser:
    """Asks over every link in turn; belongs to one event loop."""

    def __init__(
        self,
        links: Sequence[Link],
        sender: HostSender,
        interval_s: float,
        clock_ns: Callable[[], int] = gateway_time_ns,
    ) -> None:
        """links: those that are announced to the pipeline; others may join them."""
        self._links = links
        self._sender = sender
        self._interval_s = interval_s
        self._clock_ns = clock_ns
        self._asked = 0

    async def run(self) -> None:
        """Ask for ever."""
        while True:
            # In step with nothing: answers wait now longer, now shorter for a relay's tick or a slot of USB.
            await asyncio.sleep(self._interval_s * random.uniform(0.9, 1.1))
            await self.ask_all()

    async def ask_all(self) -> None:
        """Ask once, over every link."""
        for link in self._links:
            await self._ask(link)

    async def _ask(self, link: Link) -> None:
        """One request to all modules on a link; a link that is away is left alone until it is back."""
        token = self._asked % _TOKENS
        self._asked += 1
        now_us = self._clock_ns() // 1000
        request = SyncRequest(token=token, host_time_us=now_us)
        await self._sender.send(link, wire_frame(request, BROADCAST, token, now_us % 2**32))
