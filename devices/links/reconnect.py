"""Keeps a link open for ever.

States: ``CLOSED`` → ``CONNECTING`` → ``UP`` ⇄ ``DOWN`` (being retried) → ``CLOSED``.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from devices.back_off import BackOff
from devices.link import Link, LinkBusyError, LinkError, LinkItem
from devices.links.link_counts import LinkCounts
from devices.links.marker_file_link import MarkerFileLink
from devices.replay_link import ReplayLink

_log = logging.getLogger(__name__)

FIRST_DELAY_S = 0.1
LONGEST_DELAY_S = 0.5


class LinkState(Enum):
    """Where a link that is kept open stands."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    UP = "up"
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """The state, and when it is ``DOWN`` why."""

    state: LinkState
    reason: str = ""
    """One line that says what would do."""
    is_busy: bool = False
    """Whether another program has the port."""


_FILE = ReplayLink | MarkerFileLink
"""Links that come to an end; where such a file is absent, it will not come by itself."""


def kept_open(link: Link, on_change: Callable[[LinkStatus], None] | None = None) -> Link:
    """Return a link that is opened again whenever it is lost; a file that was read to its end is not."""
    if isinstance(link, _FILE):
        return link
    return ReconnectingLink(link, on_change=on_change)


class ReconnectingLink:
    """A link that is opened again whenever it is lost; iterating it ends only when it is closed.

    ``on_change`` is called, and one line logged, at every change of status and not at every attempt.
    A connection counts as a success, which makes the back-off start anew, once a chunk came or it
    held for the longest delay: a server that accepts and hangs up at once is not hammered.
    """

    def __init__(
        self,
        link: Link,
        *,
        strict: bool = False,
        back_off: BackOff | None = None,
        on_change: Callable[[LinkStatus], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        """Keep ``link`` open.

        strict: whether the first ``open`` raises ``LinkError`` instead of retrying, as that of a file always
        does.
        """
        self.link = link
        self.name = link.name
        self.framing = link.framing
        self.status = LinkStatus(LinkState.CLOSED)
        self.reconnections = 0
        """How often the link came up again since it was opened."""
        self._strict = strict or isinstance(link, _FILE)
        self._back_off = back_off or BackOff(FIRST_DELAY_S, LONGEST_DELAY_S)
        self._on_change = on_change
        self._clock = clock
        self._sleep = sleep
        self._has_been_up = False
        self._closing: asyncio.Event | None = None
        self._transition = asyncio.Lock()

    @property
    def counts(self) -> LinkCounts:
        """What became of its bytes; empty for a link that counts nothing."""
        counts = getattr(self.link, "counts", None)
        return counts if isinstance(counts, LinkCounts) else LinkCounts()

    @property
    def state(self) -> LinkState:
        """Whether the link is up now."""
        return self.status.state

    async def open(self) -> None:
        """Make one attempt; when it fails, iterating goes on trying (``strict``: raises ``LinkError``)."""
        if self.state is not LinkState.CLOSED:
            raise LinkError(f"{self.name} is already open")
        self._closing = asyncio.Event()
        self._back_off.reset()
        self.reconnections = 0
        self._has_been_up = False
        self._set(LinkStatus(LinkState.CONNECTING))
        try:
            await self._until_closed(self._attempt())
            if self._strict and self.status.state is LinkState.DOWN:
                raise (LinkBusyError if self.status.is_busy else LinkError)(self.status.reason)
        # Whatever happens, also cancellation, the link is not left half open.
        except BaseException:
            await self.link.close()
            self._closing = None
            self._set(LinkStatus(LinkState.CLOSED))
            raise

    async def __aiter__(self) -> AsyncIterator[LinkItem]:
        if self._closing is None:
            raise LinkError(f"{self.name} is not open: call open() before reading")
        while not self._closing.is_set():
            if self.state is not LinkState.UP:
                await self._until_closed(self._retry())
                continue
            up_since = self._clock()
            has_received = False
            reason = "the other side closed it"
            try:
                async for item in self.link:
                    has_received = True
                    yield item
            except LinkError as error:
                reason = str(error)
            if not self._closing.is_set():
                # A link that comes up and fails at once must not be tried without a pause for ever.
                if has_received or self._clock() - up_since >= self._back_off.longest:
                    self._back_off.reset()
                await self._give_up(reason)

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Write as the link does. Raises ``LinkError`` while it is not up."""
        if self.state is not LinkState.UP:
            raise LinkError(
                f"{self.name} is {self.state.value}{self.status.reason and ': '}{self.status.reason}"
            )
        await self.link.write(data, to)

    async def close(self) -> None:
        """End trying and iterating, and close the link; an attempt under way is given up."""
        if self._closing is None or self._closing.is_set():
            return
        self._closing.set()
        async with self._transition:  # an attempt under way is being cancelled
            await self.link.close()
        self._set(LinkStatus(LinkState.CLOSED))

    async def _retry(self) -> None:
        await self._sleep(self._back_off.next_delay())
        await self._attempt()

    async def _attempt(self) -> None:
        async with self._transition:
            try:
                await self.link.open()
            except LinkError as error:
                is_busy = isinstance(error, LinkBusyError)
                self._set(LinkStatus(LinkState.DOWN, str(error), is_busy))
            else:
                self.framing = self.link.framing
                self.reconnections += self._has_been_up
                self._has_been_up = True
                self._set(LinkStatus(LinkState.UP))

    async def _give_up(self, reason: str) -> None:
        async with self._transition:
            await self.link.close()
            self._set(LinkStatus(LinkState.DOWN, reason))

    async def _until_closed(self, step: Coroutine[Any, Any, None]) -> None:
        """Run ``step``; when the link is closed meanwhile, cancel it."""
        assert self._closing is not None
        running = asyncio.ensure_future(step)
        closed = asyncio.ensure_future(self._closing.wait())
        try:
            await asyncio.wait((running, closed), return_when=asyncio.FIRST_COMPLETED)
        finally:
            closed.cancel()
            if not running.done():
                running.cancel()
                # Waited for, so that nothing of the step runs on after the link is closed.
                await asyncio.wait((running,))
        if not running.cancelled():
            running.result()

    def _set(self, status: LinkStatus) -> None:
        if status == self.status:
            return
        self.status = status
        if status.state is LinkState.DOWN:
            _log.warning("%s: down, trying again: %s", self.name, status.reason)
        else:
            _log.info("%s: %s", self.name, status.state.value)
        if self._on_change is not None:
            self._on_change(status)
