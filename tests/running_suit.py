"""An emulated suit that runs while a test looks at it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from devices.emulators.emulated_suit import EmulatedSuit


@contextlib.asynccontextmanager
async def running(suit: EmulatedSuit) -> AsyncIterator[asyncio.Task[None]]:
    """Its task, which ends with the block."""
    task = asyncio.create_task(suit.run())
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
