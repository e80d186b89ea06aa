"""Stands in for Qualisys QTM: a server of its real-time protocol that plays a marker trial.

Written from the published description (docs.qualisys.com/qtm-rt-protocol), against which it is no witness: it
shows that the gateway and the vendor's client work together, not that QTM does as described.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
from collections.abc import Callable, Collection
from enum import IntEnum
from xml.sax.saxutils import escape

import numpy as np

from devices.marker_files import MarkerTrial

_log = logging.getLogger(__name__)
_HEADER = struct.Struct("<II")  # size of the whole packet, its type
_DATA = struct.Struct("<qII")  # instant µs, number of the frame, number of components
_COMPONENT = struct.Struct("<IIIHH")  # size, type, markers, ‰ dropped, ‰ out of step
_NAMED, _NAMELESS = 1, 2
_FIRST_ID = 1000


class Kind(IntEnum):
    """Types of packets."""

    ERROR = 0
    COMMAND = 1
    XML = 2
    DATA = 3
    NO_MORE_DATA = 4
    EVENT = 6


FILE_STARTED, FILE_STOPPED = 8, 9
"""Events."""


def packet(kind: Kind, content: bytes = b"") -> bytes:
    """Return a packet of the protocol."""
    return _HEADER.pack(_HEADER.size + len(content), kind) + content


def data_packet(trial: MarkerTrial, frame: int, number: int) -> bytes:
    """Return one frame: components 3D and 3D no labels, mm; a marker that is not seen is NaN."""
    named = (1e3 * trial.positions[frame, _named(trial)]).astype("<f4")
    nameless = 1e3 * trial.unlabelled()[frame]
    nameless = nameless[np.isfinite(nameless).all(axis=1)]
    points = np.zeros(len(nameless), dtype=[("place", "<f4", 3), ("id", "<i4")])
    points["place"], points["id"] = nameless, _FIRST_ID + np.arange(len(nameless))
    components = b"".join(
        _COMPONENT.pack(_COMPONENT.size + len(content), kind, count, 0, 0) + content
        for kind, count, content in (
            (_NAMED, len(named), named.tobytes()),
            (_NAMELESS, len(points), points.tobytes()),
        )
    )
    return packet(Kind.DATA, _DATA.pack(round(frame * 1e6 / trial.rate_hz), number, 2) + components)


def parameters(trial: MarkerTrial, up: str) -> str:
    """Return the answer to ``GetParameters 3D``."""
    labels = "".join(
        f"<Label><Name>{escape(trial.labels[i])}</Name><RGBColor>0</RGBColor></Label>" for i in _named(trial)
    )
    return (
        f"<QTM_Parameters_Ver_1.20><The_3D><AxisUpwards>{up}</AxisUpwards><CalibrationTime/>"
        f"<Labels>{len(_named(trial))}</Labels>{labels}<Bones/></The_3D></QTM_Parameters_Ver_1.20>"
    )


class QtmStandIn:
    """Serves whoever connects; every client that asks for frames has them from the first one on."""

    def __init__(
        self,
        trial: MarkerTrial | None,
        *,
        up: str = "+Z",
        newest: int = 25,
        left_out: Collection[int] = (),
        speed: float = 1.0,
        repeats: bool = False,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare to serve a trial.

        trial: None: QTM without a measurement. newest: version 1.… of the protocol that it knows.
        left_out: frames that it does not send. speed: 1 is as captured. repeats: from the beginning at the
        end.
        on_end: called when a client has had all frames.
        """
        self.trial = trial
        self.port = 0
        """Listened on, once it is started."""
        self.sent = 0
        """Frames, to all clients."""

        self._up = up
        self._newest = newest
        self._left_out = frozenset(left_out)
        self._speed = speed
        self._repeats = repeats
        self._on_end = on_end
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.StreamWriter] = set()
        self._serving: set[asyncio.Task[None]] = set()
        self._streams: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}

    async def start(self, host: str = "127.0.0.1", port: int = 0) -> None:
        """Listen; port 0 lets the system choose. Raises OSError where the port is taken."""
        self._server = await asyncio.start_server(self._connected, host, port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Hang up on everybody, and listen no more."""
        if self._server is not None:
            self._server.close()
            self.hang_up()
            await asyncio.gather(*self._serving)
            await self._server.wait_closed()
            self._server = None

    def hang_up(self) -> None:
        """Hang up on everybody, as when QTM dies; who connects again is served."""
        for writer in list(self._clients):
            writer.transport.abort()

    def send_event(self, event: int) -> None:
        """Send an event to everybody."""
        for writer in self._clients:
            writer.write(packet(Kind.EVENT, bytes([event])))

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(self._serve(reader, writer))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        try:
            writer.write(packet(Kind.COMMAND, b"QTM RT Interface connected\0"))
            while True:
                size, _ = _HEADER.unpack(await reader.readexactly(_HEADER.size))
                request = await reader.readexactly(size - _HEADER.size)
                self._answer(writer, request.rstrip(b"\0").decode().lower().split())
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            _log.debug("a client has hung up")
        finally:
            self._clients.discard(writer)
            self._end_stream(writer)
            writer.close()

    def _answer(self, writer: asyncio.StreamWriter, words: list[str]) -> None:
        match words:
            case ["version", version] if self._supports(version):
                writer.write(packet(Kind.COMMAND, f"Version set to {version}\0".encode()))
            case ["version", _]:
                writer.write(packet(Kind.ERROR, b"Version NOT supported\0"))
            case ["getparameters", *_] if self.trial is None:
                writer.write(packet(Kind.ERROR, b"Parameters not available\0"))
            case ["getparameters", *_] if self.trial is not None:
                writer.write(packet(Kind.XML, parameters(self.trial, self._up).encode() + b"\0"))
            case ["streamframes", "stop"]:
                self._end_stream(writer)
            case ["streamframes", *_] if self.trial is None:
                writer.write(packet(Kind.NO_MORE_DATA))
            case ["streamframes", *_] if self.trial is not None:
                self._end_stream(writer)
                self._streams[writer] = asyncio.create_task(self._play(writer, self.trial))
            case _:
                writer.write(packet(Kind.ERROR, b"Parse error\0"))

    def _supports(self, version: str) -> bool:
        major, _, minor = version.partition(".")
        return major == "1" and minor.isdigit() and int(minor) <= self._newest

    async def _play(self, writer: asyncio.StreamWriter, trial: MarkerTrial) -> None:
        with contextlib.suppress(ConnectionError):  # who has hung up is served no more: see _serve
            await self._play_once(writer, trial)
            while self._repeats:
                await self._play_once(writer, trial)
            writer.write(packet(Kind.NO_MORE_DATA))
            writer.write(packet(Kind.EVENT, bytes([FILE_STOPPED])))
            await writer.drain()
            self._on_end()

    async def _play_once(self, writer: asyncio.StreamWriter, trial: MarkerTrial) -> None:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        for frame in range(trial.n_frames):
            await asyncio.sleep(max(0.0, begun_s + frame / (trial.rate_hz * self._speed) - loop.time()))
            if frame not in self._left_out:
                writer.write(data_packet(trial, frame, frame + 1))
                await writer.drain()
                self.sent += 1
        await asyncio.sleep(1 / (trial.rate_hz * self._speed))

    def _end_stream(self, writer: asyncio.StreamWriter) -> None:
        task = self._streams.pop(writer, None)
        if task is not None:
            task.cancel()


def _named(trial: MarkerTrial) -> list[int]:
    return [i for i, label in enumerate(trial.labels) if label and not label.startswith("*")]
