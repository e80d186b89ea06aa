"""Real pseudo-terminals, and reading from links with a time limit."""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any

import pytest

from devices.link import Chunk, Link, gateway_time_ns
from tests.patience import PATIENCE_S


class PseudoTerminal:
    """The device's end of a serial line; ``path`` is what the gateway opens."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self.master, False)

    def write(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    async def read(self, size: int) -> bytes:
        """Exactly ``size`` bytes from the gateway."""
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(data) < size:
                try:
                    data += os.read(self.master, size - len(data))
                except OSError:  # nothing there, or the gateway has not opened its end
                    await asyncio.sleep(0.001)
        return data

    def close(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.master = -1


@pytest.fixture
def pseudo_terminal() -> Iterator[Callable[[], PseudoTerminal]]:
    made: list[PseudoTerminal] = []

    def make() -> PseudoTerminal:
        made.append(PseudoTerminal())
        return made[-1]

    yield make
    for terminal in made:
        terminal.close()


@pytest.fixture
def next_chunk() -> Callable[[AsyncIterator[Chunk]], Awaitable[Chunk]]:
    async def read(chunks: AsyncIterator[Chunk]) -> Chunk:
        async with asyncio.timeout(PATIENCE_S):
            return await anext(chunks)

    return read


@pytest.fixture
def read_bytes() -> Callable[[Link, int], Awaitable[bytes]]:
    """Bytes from a link until at least so many have come."""

    async def read(link: Link, size: int) -> bytes:
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            async for chunk in link:
                assert chunk.link == link.name
                data += chunk.data
                if len(data) >= size:
                    break
        return data

    return read


@pytest.fixture
def stamped_on_arrival(
    until: Callable[..., Awaitable[None]],
) -> Callable[[Any, Callable[[], object]], Awaitable[None]]:
    """``await stamped_on_arrival(link, send)``: a chunk is as old as it is, however late it is looked at."""

    async def check(link: Any, send: Callable[[], object]) -> None:
        before_ns = gateway_time_ns()
        send()
        await until(lambda: link.counts.waiting > 0)
        there_ns = gateway_time_ns()
        await asyncio.sleep(0.01)
        assert before_ns < (await anext(aiter(link))).arrived_ns <= there_ns

    return check
