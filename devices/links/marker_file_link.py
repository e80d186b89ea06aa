"""A file of marker trajectories as a link: played at its own rate, or as fast as it is taken."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from pathlib import Path

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.marker_files import MarkerTrial, read_markers
from devices.marker_files.naming import spelt
from devices.marker_messages import encode_markers
from devices.vendor_formats.sheets import FormatError


def trial_chunks(trial: MarkerTrial, begun_ns: int, link: str) -> Iterator[Chunk]:
    """Yield the messages that an optical system would have sent, each at its instant."""
    named = [i for i, label in enumerate(trial.labels) if label and not label.startswith("*")]
    labels = [trial.labels[i] for i in named]
    nameless = trial.unlabelled()
    for frame in range(trial.n_frames):
        time_ns = begun_ns + round(frame * 1e9 / trial.rate_hz)
        places = trial.positions[frame, named].tolist()
        yield Chunk(encode_markers(frame, time_ns, labels, places, nameless[frame].tolist()), time_ns, link)


class MarkerFileLink:
    """Plays a C3D or TRC file. ``speed`` 1 is as captured, None as fast as the reader takes it."""

    framing = Framing.BYTE_STREAM

    def __init__(
        self,
        path: str | Path,
        *,
        speed: float | None = 1.0,
        name: str | None = None,
        labels: Sequence[str] = (),
        person: str | None = None,
    ) -> None:
        """Prepare to play a file.

        labels: names that markers are to have where the file spells them otherwise.
        person: whose markers, where the file holds several people's.
        """
        self.path = Path(path)
        self.name = name or self.path.stem
        self.position = 0
        """Frames played."""
        self.size = 0
        """Frames in all, once open."""
        self.hold: Callable[[], Awaitable[None]] | None = None
        """Awaited before every frame: for a reader that must not be overrun, or is not there yet."""
        self._speed = speed
        self._labels = labels
        self._person = person
        self._trial: MarkerTrial | None = None
        self._closing = asyncio.Event()

    async def open(self) -> None:
        """Read the whole file. Raises ``LinkError``."""
        try:
            self._trial = spelt(read_markers(self.path), self._labels, person=self._person)
        except FormatError as error:
            raise LinkError(str(error)) from error
        self.size, self.position = self._trial.n_frames, 0
        self._closing = asyncio.Event()

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        if self._trial is None:
            raise LinkError(f"{self.name} is not open: call open() before reading")
        await (asyncio.sleep(0) if self.hold is None else self.hold())
        begun_ns = gateway_time_ns()
        for chunk in trial_chunks(self._trial, begun_ns, self.name):
            await (asyncio.sleep(0) if self.hold is None else self.hold())
            await self._until_turn(chunk.arrived_ns - begun_ns, begun_ns)
            if self._closing.is_set():
                return
            self.position += 1
            yield chunk

    async def _until_turn(self, elapsed_ns: int, begun_ns: int) -> None:
        if self._speed is None:
            return
        wait_s = (begun_ns + elapsed_ns / self._speed - gateway_time_ns()) * 1e-9
        if wait_s > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._closing.wait()

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Do nothing: a file takes no commands."""

    async def close(self) -> None:
        """Stop playing."""
        self._closing.set()
