"""A recording as a link: its chunks, what was sent and what happened, in their order and with their times."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from devices import recording_format as fmt
from devices.known_names import nearest
from devices.link import (
    SUIT,
    Framing,
    InputEvent,
    Link,
    LinkError,
    LinkItem,
    SentChunk,
    content_of,
    gateway_time_ns,
)
from devices.recording_file import RecordingParts, parse_json

_log = logging.getLogger(__name__)

# At full speed other tasks still get their turn every so many messages.
_MESSAGES_A_TURN = 32


def speed_from(text: str) -> float | None:
    """Return a factor; None for as fast as possible. Raises ``ValueError``."""
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0 < speed < math.inf:
        raise ValueError("a number above 0, or max, is needed")
    return speed


class ReplayLink:
    """The inputs of a recording, of one of its links or of all; later parts of the session follow.

    Chunks come with what the gateway had written to their links and with what had happened, in its place.

    ``speed`` 1 is as recorded, 2 twice as fast, None as fast as the reader takes them; arrival times are
    those of the recording whatever the speed, and time counts from the first chunk of the file, so that two
    links of one recording keep step. With all links, chunks bear the names of the links they were recorded
    from: see ``contents``. What is written is discarded.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        link: str | None = None,
        speed: float | None = 1.0,
        name: str | None = None,
    ) -> None:
        """Prepare to play; ``link`` is the one recorded link wanted, None: all; ``name`` what to call it."""
        if speed is not None and not speed > 0:
            raise ValueError(f"speed {speed}: give a positive number, or None for as fast as possible")
        self.path = Path(path)
        self.name = name or link or str(path)
        self.framing = Framing.BYTE_STREAM
        """That of its first link with packets of modules, known as soon as the file can be read."""
        self.contents: dict[str, str] = {self.name: self.framing}
        """What each of its links carries (``devices.link.content_of``), by the name that its chunks bear;
        known as soon as the file can be read."""
        self.hold: Callable[[], Awaitable[None]] | None = None
        """Awaited now and then before reading on: for a reader that must not be overrun at full speed."""
        self.defect: str | None = None
        """What was wrong with the tail of the file, once the end was reached."""
        self._link = link
        self._speed = speed
        self._given_name = name
        self._parts: RecordingParts | None = None
        self._names: dict[str, str] = {}  # recorded link → what its chunks are called
        self._is_open = False
        self._closing: asyncio.Event | None = None
        with contextlib.suppress(LinkError):  # said by open()
            self._select()

    @property
    def position(self) -> int:
        """Bytes read so far."""
        return 0 if self._parts is None else self._parts.position

    @property
    def size(self) -> int:
        """Bytes in all."""
        return 0 if self._parts is None else self._parts.size

    async def open(self) -> None:
        """Open the recording. Raises ``LinkError``: not there, not ours, or without such a link."""
        if self._is_open:
            raise LinkError(f"{self.name} is already open")
        self._select()
        self._closing = asyncio.Event()
        self._is_open = True

    async def __aiter__(self) -> AsyncIterator[LinkItem]:
        if self._parts is None or self._closing is None:
            raise LinkError(f"{self.name} is not open: call open() before reading")
        pace = _Pace(self._speed, self._closing)
        for count, (topic, time_ns, data) in enumerate(self._parts.messages()):
            if count % _MESSAGES_A_TURN == 0:
                # Other tasks get their turn, however fast the file is read.
                await (asyncio.sleep(0) if self.hold is None else self.hold())
            if (chunk := fmt.chunk_of(topic, time_ns, data)) is not None:
                name = self._names.get(chunk.link)
                await pace.until(time_ns, is_ours=name is not None)
                # Waiting may have taken long: the link may have been closed meanwhile.
                if self._closing.is_set():
                    return
                if name is not None:
                    yield replace(chunk, link=name)
            elif topic.startswith(fmt.SENT):
                name = self._names.get(topic.removeprefix(fmt.SENT))
                if name is not None:
                    yield SentChunk(data, time_ns, name)
            elif topic == fmt.EVENTS and (event := event_of(data)) is not None:
                yield event
        self.defect = self._parts.defect
        if self.defect is not None:
            _log.warning("%s", self.defect)

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Do nothing: the modules of a recording take no commands."""

    async def close(self) -> None:
        """End iterating, also while it waits for the next chunk's time."""
        self._is_open = False
        if self._closing is not None:
            self._closing.set()

    def _select(self) -> None:
        """Open the recording and find the links in it."""
        self._parts = RecordingParts(self.path)
        recorded = self._parts.links
        chosen = _chosen(self.path, recorded, self._link)
        if len(chosen) == 1:
            self.name = self._given_name or next(iter(chosen))
            self._names = {next(iter(chosen)): self.name}
        else:
            self._names = {name: name for name in chosen}
        self.contents = {self._names[name]: content for name, content in chosen.items()}
        # Not every content is wire frames: markers and the like have no framing.
        framings = (Framing(content) for content in chosen.values() if content in list(Framing))
        self.framing = next(framings, Framing.BYTE_STREAM)


class _Pace:
    """When each chunk has its turn."""

    def __init__(self, speed: float | None, closing: asyncio.Event) -> None:
        self._speed = speed
        self._closing = closing
        self._start_ns = gateway_time_ns()
        self._first_ns: int | None = None

    async def until(self, arrived_ns: int, *, is_ours: bool) -> None:
        """Wait for the turn of a chunk that arrived then; one of another link only sets where time begins."""
        if self._first_ns is None:
            self._first_ns = arrived_ns
        if not is_ours or self._speed is None:
            return
        turn_ns = self._start_ns + (arrived_ns - self._first_ns) / self._speed
        wait_s = (turn_ns - gateway_time_ns()) * 1e-9
        if wait_s > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._closing.wait()


def is_recording(link: Link) -> bool:
    """Return whether a link plays a recording: nobody is at its other end, its arrival times are of another
    day.
    """
    return isinstance(link, ReplayLink)


def contents_of(link: Link, carries: str = SUIT) -> Mapping[str, str]:
    """Return what the chunks of an open link are (``devices.link.content_of``), by the names that they bear.

    One name, but for some recordings, which know by themselves what they carry. carries: what the
    configuration says of the link.
    """
    return link.contents if isinstance(link, ReplayLink) else {link.name: content_of(carries, link.framing)}


def framings_of(link: Link) -> dict[str, Framing]:
    """Return how the packets of modules on an open link are framed, by the names that its chunks bear.

    A recording may hold other links beside, which are left out."""
    return {name: Framing(of) for name, of in contents_of(link).items() if of in list(Framing)}


def event_of(message: bytes) -> InputEvent | None:
    """Return the event that a message on ``recording_format.EVENTS`` holds; None for a damaged one."""
    try:
        plain = parse_json(message)
        return InputEvent(str(plain["name"]), dict(plain["data"]), int(plain["time_ns"]))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def _chosen(path: Path, recorded: dict[str, str], wanted: str | None) -> dict[str, str]:
    if wanted is None:
        return recorded
    if wanted in recorded:
        return {wanted: recorded[wanted]}
    raise LinkError(f"{path} has no link '{wanted}'{nearest(wanted, recorded)}")
