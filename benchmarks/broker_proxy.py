"""A network between gateway and broker that can be slow, or cut without a word."""

from __future__ import annotations

import asyncio
import contextlib

_PIECE = 4096
_SLOW_PIECE = 256
_POLL_S = 0.01


class BrokerProxy:
    """Passes bytes between its port and the broker's.

    bytes_per_s: how fast it takes the gateway's bytes; None: at once. is_cut: nothing passes, and nobody is
    told; what was sent meanwhile is still there afterwards, as TCP would send it again.
    """

    def __init__(self, broker_port: int) -> None:
        self.port = 0
        self.bytes_per_s: float | None = None
        self.is_cut = False
        self._broker_port = broker_port
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> BrokerProxy:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0, limit=_PIECE)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._broker_port, limit=_PIECE)
            up = self._pass_on(reader, back, is_up=True)
            down = self._pass_on(there, writer, is_up=False)
            await asyncio.gather(up, down)
        except OSError:
            writer.close()  # the broker is not there: nor is this
        finally:
            self._tasks.discard(task)

    async def _pass_on(
        self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, is_up: bool
    ) -> None:
        with contextlib.suppress(OSError):
            while True:
                rate = self.bytes_per_s if is_up else None
                data = await source.read(_PIECE if rate is None else _SLOW_PIECE)
                while self.is_cut:
                    await asyncio.sleep(_POLL_S)
                if not data:
                    break
                sink.write(data)
                await sink.drain()
                if rate is not None:
                    await asyncio.sleep(len(data) / rate)
        sink.close()
