"""Two-way time exchanges with the modules, while capturing: the I/O shell of ``clocks.sync_exchange``.

Every so often all modules are asked what time they have. Those whose firmware answers get clocks whose
offset is free of the transport's delay, to a bound that is published; the others lose nothing.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from devices.command_client import host_bytes
from devices.link import Chunk, Link, LinkError, gateway_time_ns
from firmware_protocol import (
    BROADCAST,
    ReceivedPacket,
    SyncRequest,
    SyncResponse,
    wire_frame,
)
from gateway.clocks import EstimatedClock, SyncExchanges
from gateway.stream import Stream

log = logging.getLogger(__name__)

_TOKENS = 1 << 16
_SEND_TIMEOUT_S = 0.5


class Synchroniser:
    """Asks over every link in turn; belongs to one event loop."""

    def __init__(
        self,
        links: Sequence[Link],
        stream: Stream,
        interval_s: float,
        clock_ns: Callable[[], int] = gateway_time_ns,
    ) -> None:
        self._links = links
        self._stream = stream
        self._interval_s = interval_s
        self._clock_ns = clock_ns
        self._exchanges: dict[int, SyncExchanges] = {}
        self._link_of: dict[int, str] = {}
        self._asked = 0
        stream.listen(SyncResponse, self._take)

    async def run(self) -> None:
        """Ask for ever."""
        while True:
            await asyncio.sleep(self._interval_s)
            await self.ask_all()

    async def ask_all(self) -> None:
        """Ask once, over every link."""
        for link in self._links:
            await self._ask(link)

    async def _ask(self, link: Link) -> None:
        """One request to all modules on a link; a link that is away is left alone until it is back."""
        token = self._asked % _TOKENS
        self._asked += 1
        sent_ns = self._clock_ns()
        request = SyncRequest(token=token, host_time_us=sent_ns // 1000)
        frame = wire_frame(request, BROADCAST, token, sent_ns // 1000 % 2**32)
        for module, record in self._stream.modules.items():
            if isinstance(record.clock, EstimatedClock) and self._link_of.get(module, link.name) == link.name:
                self._exchanges.setdefault(module, SyncExchanges()).sent(token, sent_ns)
        try:
            async with asyncio.timeout(_SEND_TIMEOUT_S):
                await link.write(host_bytes(frame, link.framing))
        except (LinkError, TimeoutError) as error:
            log.debug("no time asked for on %s: %s", link.name, error)

    def _take(self, received: ReceivedPacket, chunk: Chunk) -> None:
        record, exchanges = self._stream.modules.get(received.module), self._exchanges.get(received.module)
        if record is None or exchanges is None or not isinstance(record.clock, EstimatedClock):
            return
        assert isinstance(received.packet, SyncResponse)
        response = received.packet
        self._link_of[received.module] = chunk.link
        exchange = exchanges.answered(
            response.token, response.received_us, response.sent_us, chunk.arrived_ns
        )
        if exchange is not None:
            record.clock.add_exchange(*exchange)
