"""What runs while a test looks at it: an emulated suit, a gateway."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from typing import Any, Protocol


class Runs(Protocol):
    """An ``EmulatedSuit``, or a ``Service``."""

    def run(self) -> Coroutine[Any, Any, None]:
        """Run until cancelled."""


@contextlib.asynccontextmanager
async def running(part: Runs) -> AsyncIterator[asyncio.Task[None]]:
    """Its task, which ends with the block."""
    task = asyncio.create_task(part.run())
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
