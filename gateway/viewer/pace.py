"""When pictures are due."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

PICTURES_HZ = 33.0
"""Somewhat above the 30 that a page is to get: a late picture is not made up for."""


async def pictures(rate_hz: float = PICTURES_HZ) -> AsyncIterator[float]:
    """Yield for ever, ``rate_hz`` times a second, the time since the last picture, s; 0 at first."""
    loop = asyncio.get_running_loop()
    due = before = loop.time()
    while True:
        now = loop.time()
        yield now - before
        before = now
        # A picture that took too long is not made up for by a burst of pictures after it.
        due = max(due + 1.0 / rate_hz, loop.time())
        await asyncio.sleep(due - loop.time())
