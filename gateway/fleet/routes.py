"""The network between the nodes of a cluster on this machine, which can be cut; to try and measure.

A cut is silent, as that of a cable: nothing passes and nobody is told. What was sent meanwhile arrives when
it is mended, as TCP would send it again.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

_PIECE = 1 << 16
_START_S = 5.0


Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]


class CuttableRoutes:
    """Passes bytes between nodes, each pair of them over ports of its own, in a thread of its own."""

    def __init__(self, nodes: Sequence[int]) -> None:
        """Let everything pass. nodes: port at which each takes the routes of the others."""
        self._nodes = nodes
        self._ports: dict[tuple[int, int], int] = {}
        self._is_open: dict[tuple[int, int], asyncio.Event] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="routes", daemon=True)
        self._tasks: set[asyncio.Task[None]] = set()
        self._servers: list[asyncio.Server] = []

    def start(self) -> None:
        """Open the ports."""
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._open(), self._loop).result(_START_S)

    def from_node(self, index: int) -> list[int]:
        """Return the ports by which a node reaches the others."""
        return [port for (begin, _), port in self._ports.items() if begin == index]

    def cut(self, index: int | None) -> None:
        """Cut one node off from all others, and no other one; None: let everything pass again."""
        for pair, event in self._is_open.items():
            is_cut = index is not None and index in pair
            self._loop.call_soon_threadsafe(event.clear if is_cut else event.set)

    def stop(self) -> None:
        """Close all connections."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(_START_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _open(self) -> None:
        for pair in itertools.permutations(range(len(self._nodes)), 2):
            is_open = self._is_open[pair] = asyncio.Event()
            is_open.set()
            server = await asyncio.start_server(self._serve_pair(pair[1], is_open), "127.0.0.1", 0)
            self._servers.append(server)
            self._ports[pair] = int(server.sockets[0].getsockname()[1])

    async def _close(self) -> None:
        for server in self._servers:
            server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _serve_pair(self, end: int, is_open: asyncio.Event) -> Serve:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            self._tasks.add(task)
            try:
                await is_open.wait()
                there, back = await asyncio.open_connection("127.0.0.1", self._nodes[end])
                await asyncio.gather(_pass_on(reader, back, is_open), _pass_on(there, writer, is_open))
            except (OSError, asyncio.CancelledError):  # the node is not there, or all is over
                writer.close()
            finally:
                self._tasks.discard(task)

        return serve


async def _pass_on(source: asyncio.StreamReader, sink: asyncio.StreamWriter, is_open: asyncio.Event) -> None:
    with contextlib.suppress(OSError):
        while data := await source.read(_PIECE):
            await is_open.wait()
            sink.write(data)
            await sink.drain()
        await is_open.wait()
    sink.close()
