"""A broker behind a line that carries less than is published: how old poses get, and what is dropped."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass

import psutil

from benchmarks.synthetic_poses import GATEWAY, INFO, RATE_HZ, frames_of, skeleton_of_size
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber

BYTES_PER_S = 80_000.0
"""About half of what 17 segments at 100 Hz need."""
SECONDS = 8.0
SETTLING_S = 2.0
_READ_BYTES = 2048
_BUFFER_BYTES = 8192
"""Of the line's sockets: a slow line, not a deep one."""


@dataclass(frozen=True)
class Slow:
    """Poses at 100 Hz through that line."""

    worst_ms: float
    """Oldest pose when it came, once the line was full."""
    offered: int
    received: int
    dropped: int
    rss_growth_mb: float


async def measure(broker_port: int) -> Slow:
    """Publish for a while through the line; subscribe beside it."""
    skeleton = skeleton_of_size(17)
    frames = frames_of(skeleton)
    ages_ms: list[tuple[float, float]] = []  # (arrival, age)
    async with (
        _narrow_line(broker_port) as port,
        PoseSubscriber(MqttSettings(port=broker_port), GATEWAY) as poses,
        MqttOutput(MqttSettings(port=port), skeleton, INFO) as output,
    ):

        async def collect() -> None:
            async for pose in poses:
                ages_ms.append((time.perf_counter(), pose.latency_s * 1e3))

        collecting = asyncio.create_task(collect())
        while not output.is_connected:
            await asyncio.sleep(0.01)
        begun, rss = time.perf_counter(), psutil.Process().memory_info().rss
        for k in range(round(SECONDS * RATE_HZ)):
            output.offer(frames(k))
            await asyncio.sleep(max(0.0, begun + (k + 1) / RATE_HZ - time.perf_counter()))
        growth = psutil.Process().memory_info().rss - rss
        counters = output.counters
        collecting.cancel()
    return Slow(
        worst_ms=max(age for at, age in ages_ms if at > begun + SETTLING_S),
        offered=round(SECONDS * RATE_HZ),
        received=len(ages_ms),
        dropped=counters.dropped,
        rss_growth_mb=growth / 1e6,
    )


@contextlib.asynccontextmanager
async def _narrow_line(broker_port: int) -> AsyncIterator[int]:
    """The port of a forwarder to the broker that takes ``BYTES_PER_S``."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    listener.bind(("127.0.0.1", 0))

    async def forward(near: asyncio.StreamReader, near_writer: asyncio.StreamWriter) -> None:
        far, far_writer = await asyncio.open_connection("127.0.0.1", broker_port)
        both = (_carry(near, far_writer, BYTES_PER_S), _carry(far, near_writer, float("inf")))
        with contextlib.suppress(OSError, asyncio.CancelledError):  # the measurement is over
            await asyncio.gather(*both)
        for writer in (near_writer, far_writer):
            writer.close()

    server = await asyncio.start_server(forward, sock=listener, limit=_READ_BYTES)
    async with server:
        yield int(listener.getsockname()[1])


async def _carry(source: asyncio.StreamReader, target: asyncio.StreamWriter, bytes_per_s: float) -> None:
    due = time.perf_counter()
    while data := await source.read(_READ_BYTES):
        target.write(data)
        await target.drain()
        due = max(due, time.perf_counter()) + len(data) / bytes_per_s
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
