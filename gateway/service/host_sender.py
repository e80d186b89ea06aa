"""Puts the gateway's own wire frames on links, and says what left and when: one way for all that is timed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from devices.commands.command_client import host_bytes
from devices.link import Link, LinkError, SentChunk, gateway_time_ns
from firmware_protocol import WireFrame

log = logging.getLogger(__name__)

_SEND_TIMEOUT_S = 0.5


class HostSender:
    """Stamps each wire frame just before it is written."""

    def __init__(
        self,
        note: Callable[[SentChunk], None],
        clock_ns: Callable[[], int] = gateway_time_ns,
        senders: Callable[[str], Sequence[str]] = lambda _link: (),
    ) -> None:
        """Prepare to write frames.

        note: called with everything that was sent, at once and in order.
        senders: returns who is to be written to on a link with several senders; see ``SuitSource.senders``.
        """
        self._note = note
        self._senders = senders
        self._clock_ns = clock_ns

    async def send(self, link: Link, frame: WireFrame, within_ns: int | None = None) -> SentChunk | None:
        """Write to a link. None, and nothing noted, when it is away or does not take the whole frame.

        within_ns: when the write took longer, the stamp does not say when the frame left: not noted either.
        """
        data = host_bytes(frame, link.framing)
        # Stamped before the write: a write may return late, but the bytes leave at once.
        sent_ns = self._clock_ns()
        try:
            async with asyncio.timeout(_SEND_TIMEOUT_S):
                await link.write(data, self._senders(link.name))
        except (LinkError, TimeoutError) as error:
            log.debug("not sent over %s: %s", link.name, error)
            return None
        # A system that held the bytes back makes the stamp wrong, and a wrong stamp is worse than none.
        if within_ns is not None and self._clock_ns() - sent_ns > within_ns:
            return None
        sent = SentChunk(data, sent_ns, link.name)
        self._note(sent)
        return sent
