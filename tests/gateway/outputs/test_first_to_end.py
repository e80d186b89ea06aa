"""Parts of one connection: the first to end, or to fail, ends the others."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from gateway.outputs.connection import first_to_end
from tests.patience import PATIENCE_S


class Part:
    """Something that runs for a while."""

    def __init__(self, seconds: float, error: Exception | None = None) -> None:
        self.was_cancelled = False
        self._seconds = seconds
        self._error = error

    async def run(self) -> None:
        try:
            await asyncio.sleep(self._seconds)
        except asyncio.CancelledError:
            self.was_cancelled = True
            raise
        if self._error is not None:
            raise self._error


async def test_a_part_that_fails_is_no_silent_death():
    """The task that keeps retained messages up to date once died of a slow broker, and nobody noticed."""
    endless, failing = Part(2 * PATIENCE_S), Part(0.01, ConnectionError("no acknowledgement"))
    with pytest.raises(ConnectionError, match="no acknowledgement"):
        await asyncio.wait_for(first_to_end(endless.run(), failing.run()), PATIENCE_S)
    assert endless.was_cancelled


async def test_a_loss_ends_a_publication_that_waits_for_nothing():
    """A publication on a connection that was just lost once waited for its whole time-out of two seconds."""
    waiting = Part(2 * PATIENCE_S)
    await asyncio.wait_for(first_to_end(waiting.run(), Part(0.01).run()), PATIENCE_S)
    assert waiting.was_cancelled


async def test_cancelling_ends_all_parts():
    parts = Part(2 * PATIENCE_S), Part(2 * PATIENCE_S)
    running = asyncio.create_task(first_to_end(*(part.run() for part in parts)))
    await asyncio.sleep(0.01)
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert all(part.was_cancelled for part in parts)


async def test_a_part_that_loses_its_cancellation_is_ended_all_the_same():
    """In Python 3.11 one that comes together with an answer is lost: who reconnects for ever went on, and the
    loss of a node was never told."""
    begun = 0

    async def reconnecting() -> None:
        nonlocal begun
        while True:
            begun += 1
            with contextlib.suppress(asyncio.CancelledError if begun == 1 else TimeoutError):
                await asyncio.sleep(2 * PATIENCE_S)

    failing = Part(0.01, ConnectionError("lost"))
    with pytest.raises(ConnectionError, match="lost"):
        await asyncio.wait_for(first_to_end(reconnecting(), failing.run()), PATIENCE_S)
    assert begun == 2
