"""Two-way time exchanges of all modules: which request an answer belongs to, and whose clock it corrects."""

from __future__ import annotations

from collections.abc import Mapping

from devices.link import Chunk, SentChunk
from firmware_protocol import ReceivedPacket, SyncResponse
from gateway.clocks import EstimatedClock, SyncExchanges
from gateway.sources.statistics import ModuleRecord


class TimeExchanges:
    """Takes note of every request that left and of every answer that came. Sans-I/O."""

    def __init__(self, modules: Mapping[int, ModuleRecord]) -> None:
        """Match the exchanges of ``modules``, which is by id and grows as modules are heard."""
        self._modules = modules
        self._exchanges: dict[int, SyncExchanges] = {}
        self._link_of: dict[int, str] = {}

    def asked(self, token: int, sent: SentChunk) -> None:
        """Note that a time request has left on a link, for every module that may answer it."""
        for module, record in self._modules.items():
            if isinstance(record.clock, EstimatedClock) and self._link_of.get(module, sent.link) == sent.link:
                self._exchanges.setdefault(module, SyncExchanges()).sent(token, sent.sent_ns)

    def answered(self, received: ReceivedPacket, chunk: Chunk) -> None:
        """Match a ``SyncResponse`` to its request, and correct the clock of the module that sent it."""
        record, exchanges = self._modules.get(received.module), self._exchanges.get(received.module)
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
