"""When pictures are due."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

PICTURES_HZ = 33.0
"""Somewhat above the 30 that a page is to get: a late picture is not made up for."""


async def pictures(rate_hz: float = PICTURES_HZ) -> AsyncIterator[float]:
    """For ever, so many times a second: the time since the last one, s; at first none."""
    loop = asyncio.get_running_loop()
    due = before = loop.time()
    while True:
        now = loop.time()
        yield now - before
        before = now
        due = max(due + 1.0 / rate_hz, loop.time())
        await asyncio.sleep(due - loop.time())
