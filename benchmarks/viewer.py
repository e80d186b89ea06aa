"""The live page in a browser: how often the body moves in it, what a picture costs, the process behind it.

The browser renders on the processor, as on a machine without graphics; how fast it can is told apart from
how often postures reach it.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

import psutil
import zstandard
from playwright.async_api import Page, Playwright, WebSocket, async_playwright

from benchmarks.figures import Figure, Report, table
from benchmarks.latency import process_of
from benchmarks.synthetic_poses import GATEWAY, INFO, RATE_HZ, frames_of, skeleton_of_size
from benchmarks.viewer_browser import browser_page
from devices.emulators.local_broker import mosquitto
from devices.free_ports import free_port
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings

SECONDS = 8.0
SETTLING_S = 4.0
SIZES = {"desktop": (1280, 800), "phone": (390, 780)}
_ZSTD = b"\x28\xb5\x2f\xfd"
_BODY_MOVES = b"batched_wxyzs"
_COUNT_PICTURES = (
    "window.pictures = 0; (function next() { window.pictures++; requestAnimationFrame(next) })()"
)


@dataclass(frozen=True)
class Seen:
    """One body on one page."""

    n_segments: int
    size: str
    updates_hz: float
    """Postures that reach the page, a second."""
    kilobytes_per_s: float
    pictures_hz: float
    """Pictures that the page draws, a second; each takes the newest posture."""
    picture_ms: float
    """Processor time of the browser a picture, all its processes, ms."""
    viewer_percent: float
    """Of one core, the process behind the page."""


def run() -> Report:
    """17 and 64 segments, on a desktop's page and on a phone's."""
    with mosquitto() as (port, _):
        seen = asyncio.run(_all(port))
    report = Report("viewer")
    for each in seen:
        if each.size == "desktop":
            report.figures += _figures(each)
    report.tables = [_table(seen)]
    return report


def _figures(seen: Seen) -> list[Figure]:
    n = seen.n_segments
    return [
        Figure(
            f"viewer_{n}_updates_hz",
            seen.updates_hz,
            "Hz",
            ">=30",
            f"postures of {n} segments that reach the page, poses at {RATE_HZ:g} Hz",
        ),
        Figure(
            f"viewer_{n}_picture_ms",
            seen.picture_ms,
            "ms",
            "",
            "processor time of the browser a picture, rendered without a graphics processor",
        ),
        Figure(
            f"viewer_{n}_cpu_percent", seen.viewer_percent, "%", "", "of one core, process behind the page"
        ),
    ]


def _table(seen: list[Seen]) -> str:
    heads = [
        "segments",
        "page",
        "postures/s",
        "kB/s",
        "pictures/s",
        "browser CPU ms a picture",
        "viewer CPU %",
    ]
    rows = [
        [
            str(each.n_segments),
            f"{each.size} {SIZES[each.size][0]} × {SIZES[each.size][1]}",
            *(f"{each.updates_hz:.1f}", f"{each.kilobytes_per_s:.0f}", f"{each.pictures_hz:.1f}"),
            *(f"{each.picture_ms:.0f}", f"{each.viewer_percent:.1f}"),
        ]
        for each in seen
    ]
    return "## The page, rendered by the processor alone\n\n" + table(heads, rows)


async def _all(broker_port: int) -> list[Seen]:
    async with async_playwright() as play:
        return [await _see(play, broker_port, n_segments, size) for n_segments in (17, 64) for size in SIZES]


async def _see(play: Playwright, broker_port: int, n_segments: int, size: str) -> Seen:
    page_port = free_port()
    payloads: list[bytes] = []
    arguments = ["view", "--port", str(broker_port), "--gateway", GATEWAY, "--page-port", str(page_port)]
    async with (
        _published(broker_port, n_segments),
        process_of("-m", "gateway", *arguments) as viewer,
        browser_page(play, f"http://127.0.0.1:{page_port}", SIZES[size], _listener(payloads)) as page,
    ):
        await asyncio.sleep(SETTLING_S)
        await page.evaluate(_COUNT_PICTURES)
        payloads.clear()
        before = await _Reading.now(page, viewer.pid)
        await asyncio.sleep(SECONDS)
        after = await _Reading.now(page, viewer.pid)
        received = list(payloads)
    span_s, pictures = after.time_s - before.time_s, after.pictures - before.pictures
    return Seen(
        n_segments=n_segments,
        size=size,
        updates_hz=sum(_unpacked(data).count(_BODY_MOVES) for data in received) / span_s,
        kilobytes_per_s=sum(map(len, received)) / span_s / 1e3,
        pictures_hz=pictures / span_s,
        picture_ms=(after.browser_s - before.browser_s) / max(1, pictures) * 1e3,
        viewer_percent=(after.viewer_s - before.viewer_s) / span_s * 100,
    )


@dataclass(frozen=True)
class _Reading:
    time_s: float
    pictures: int
    browser_s: float
    viewer_s: float

    @classmethod
    async def now(cls, page: Page, viewer: int) -> _Reading:
        pictures = int(await page.evaluate("window.pictures"))
        own = sum(psutil.Process(viewer).cpu_times()[:2])
        return cls(time.perf_counter(), pictures, _browser_s(), own)


def _browser_s() -> float:
    """Processor time of all processes of the browser, s."""
    spent = 0.0
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.name().startswith("chrom"):
                spent += sum(process.cpu_times()[:2])
    return spent


def _listener(payloads: list[bytes]) -> Callable[[Page], None]:
    """Keeps what comes to a page."""

    def keep(data: str | bytes) -> None:
        if isinstance(data, bytes):
            payloads.append(data)

    def opened(connection: WebSocket) -> None:
        connection.on("framereceived", keep)

    return lambda page: page.on("websocket", opened)


def _unpacked(data: bytes) -> bytes:
    """A message of the library as it was before it was compressed."""
    _, magic, packed = data.partition(_ZSTD)
    return zstandard.ZstdDecompressor().decompressobj().decompress(magic + packed) if magic else data


@contextlib.asynccontextmanager
async def _published(broker_port: int, n_segments: int) -> AsyncIterator[None]:
    """Poses of that many segments, as often as a gateway publishes them."""
    skeleton = skeleton_of_size(n_segments)
    frames = frames_of(skeleton)

    async def offer() -> None:
        for k in itertools.count():
            output.offer(frames(k))
            await asyncio.sleep(1 / RATE_HZ)

    async with MqttOutput(MqttSettings(port=broker_port), skeleton, INFO) as output:
        while not output.is_connected:
            await asyncio.sleep(0.01)
        offering = asyncio.create_task(offer())
        try:
            yield
        finally:
            offering.cancel()
