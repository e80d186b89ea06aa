"""Files of a relay's memory card: to files of this computer, and from there to recordings.

Downloads go in order, are resumed where they were cut, and verified. What has come so far is in
``<target>.part``. Only a file whose checksum is what the card said gets its own name, so that a target which
is there is whole.

The card holds the wire frames that the relay gathered, stuffed, one after another, in the order in
which they came. When each came is read from the clock of its sender: the first of every sender came when
those before it in the file did. ``convert_card_file`` makes a recording of them, to be replayed like any
other.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from devices.commands.command_client import CommandClient
from devices.commands.device_errors import CardError
from devices.link import Chunk, Framing
from devices.recording_writer import DerivedRecordingWriter, session_record
from firmware_protocol import FrameDecoder, WireFrame, encode_frame
from firmware_protocol.commands import ALL_FILES, MAX_CARD_READ, Verb

_AT_ONCE = 6
"""Pieces asked for together: fewer than the answers that a device remembers."""

ReadPiece = Callable[[int, int, int], Awaitable[bytes]]
"""File, offset, length to the bytes there: fewer at the end of the file."""


class CardFile(NamedTuple):
    """What a card says of one of its files."""

    file: int
    size: int
    """Bytes."""
    start_time_us: int
    """The relay's clock when it was begun, µs modulo 2^32."""
    crc32: int


class Card:
    """The memory card of one device, through its commands. Methods raise as ``CommandClient.request``."""

    def __init__(self, client: CommandClient, unique_id: bytes) -> None:
        self._client = client
        self._unique_id = unique_id

    async def files(self) -> list[CardFile]:
        """Return all files, in the order in which the card lists them."""
        files: list[CardFile] = []
        while True:
            total, entries = await self._client.request(self._unique_id, Verb.CARD_LIST, len(files))
            listed = [CardFile(*entry) for entry in entries]
            files += listed
            if not listed or len(files) >= total:
                return files

    async def read(self, file: int, offset: int, length: int) -> bytes:
        """Read any number of bytes, fewer at the file's end.

        Raises ``CardError`` for an answer to something else.
        """
        # Several requests are on their way at a time, or else each would wait for the answer to the one
        # before.
        starts = range(offset, offset + length, MAX_CARD_READ)
        pieces = []
        for first in range(0, len(starts), _AT_ONCE):
            asked = [
                self._piece(file, start, min(MAX_CARD_READ, offset + length - start))
                for start in starts[first : first + _AT_ONCE]
            ]
            pieces += await asyncio.gather(*asked)
        return b"".join(pieces)

    async def erase(self, file: int = ALL_FILES) -> None:
        """Erase one file, or all. Raises ``WritesLockedError`` where that is not allowed."""
        await self._client.request(self._unique_id, Verb.CARD_ERASE, file)

    async def _piece(self, file: int, offset: int, length: int) -> bytes:
        answered, start, data = await self._client.request(
            self._unique_id, Verb.CARD_READ, file, offset, length
        )
        if (answered, start) != (file, offset) or len(data) > length:
            raise CardError(
                f"the card was asked for byte {offset} of file {file} and gave byte {start} of file "
                f"{answered}: start the download again, it goes on where it stopped"
            )
        return bytes(data)


async def download(
    read: ReadPiece,
    entry: CardFile,
    target: Path,
    on_progress: Callable[[int], None] = lambda done: None,
    *,
    step: int = MAX_CARD_READ * _AT_ONCE,
) -> None:
    """Fetch one file; goes on from a partial one. What was fetched when it is cancelled or fails stays.

    read: ``Card.read``, or the same through a running gateway. on_progress: called with the bytes had so far.
    Raises ``CardError`` when the content does not have the checksum that the card says it has, or
    the file ends early; OSError as ``open`` does.
    """
    partial = target.with_name(target.name + ".part")
    resumed = partial.exists() and 0 < partial.stat().st_size <= entry.size
    if not resumed:
        partial.write_bytes(b"")
    await _fetch_rest(read, entry, partial, on_progress, step)
    if not _is_whole(partial, entry) and resumed:
        # The beginning may be that of another file: once more from the start, before it counts as damage.
        partial.write_bytes(b"")
        await _fetch_rest(read, entry, partial, on_progress, step)
    if not _is_whole(partial, entry):
        raise CardError(
            f"file {entry.file} does not have the checksum that the card gives for it: its content is kept "
            f"in {partial} and may be damaged; download it again after removing that file"
        )
    partial.replace(target)


async def _fetch_rest(
    read: ReadPiece, entry: CardFile, partial: Path, on_progress: Callable[[int], None], step: int
) -> None:
    with partial.open("ab") as file:
        # What an earlier attempt left is not read again.
        done = file.tell()
        on_progress(done)
        while done < entry.size:
            data = await read(entry.file, done, min(step, entry.size - done))
            if not data:
                raise CardError(f"file {entry.file} ends after {done} bytes; the card said {entry.size}")
            file.write(data)
            file.flush()
            done += len(data)
            on_progress(done)


def _is_whole(partial: Path, entry: CardFile) -> bool:
    checksum = 0
    with partial.open("rb") as file:
        while block := file.read(1 << 20):
            checksum = zlib.crc32(block, checksum)
    return partial.stat().st_size == entry.size and checksum == entry.crc32


LINK = "card"
"""Name of the link in the recording."""


_COUNTER = 2**32
_JUMP_US = 10_000_000
_BLOCK = 1 << 16


class ConvertedCard(NamedTuple):
    """What came out of a card file."""

    chunks: int
    dropped: int
    """Wire frames that were damaged."""
    duration_s: float


class _Elapsed:
    """32-bit stamps of one sender to µs since the file was begun."""

    def __init__(self, stamp_us: int, elapsed_us: int) -> None:
        """Begin with a stamp that came ``elapsed_us`` after the file was begun."""
        self._last_us = stamp_us
        self._elapsed_us = elapsed_us

    def at(self, stamp_us: int, latest_us: int) -> int:
        """Return when a further stamp came, µs; a clock that has jumped is taken to have begun anew."""
        # Stamps wrap, and may come a little out of order: the step is the one nearest to zero.
        step_us = (stamp_us - self._last_us + _COUNTER // 2) % _COUNTER - _COUNTER // 2
        self._last_us = stamp_us
        expected_us = self._elapsed_us + step_us
        has_jumped = abs(expected_us - latest_us) > _JUMP_US
        self._elapsed_us = latest_us if has_jumped else expected_us
        return self._elapsed_us


def convert_card_file(
    source: Path, target: Path, *, start_ns: int | None = None, end_ns: int = 0
) -> ConvertedCard:
    """Write the recording ``target`` from a downloaded card file, in the place of one that is there.

    start_ns: gateway time at which the file was begun; None: such that the recording ends at ``end_ns``.
    Raises OSError as ``open`` does.
    """
    # Read twice: where the recording begins follows from its length, if only its end is known.
    duration_us = max((elapsed_us for elapsed_us, _ in _arrivals(source, FrameDecoder())), default=0)
    base_ns = end_ns - duration_us * 1000 if start_ns is None else start_ns
    chunks = 0
    decoder = FrameDecoder()
    session = session_record({LINK: Framing.BYTE_STREAM}, begun_ns=str(base_ns), name=target.stem)
    with DerivedRecordingWriter(target, session, {}, base_ns, replaces=True) as recording:
        for elapsed_us, frame in _arrivals(source, decoder):
            # Without the clock of the host no arrival is known: each frame stands as a chunk of its own.
            chunk = Chunk(encode_frame(frame), base_ns + elapsed_us * 1000, LINK)
            recording.add_chunk(chunk, Framing.BYTE_STREAM)
            chunks += 1
    return ConvertedCard(chunks, sum(decoder.dropped.values()), duration_us * 1e-6)


def _arrivals(source: Path, decoder: FrameDecoder) -> Iterator[tuple[int, WireFrame]]:
    """Yield wire frames with the time since the file was begun, µs; times never decrease."""
    clocks: dict[int, _Elapsed] = {}
    latest_us = 0
    for frame in _frames(source, decoder):
        clock = clocks.get(frame.module)
        if clock is None:
            clocks[frame.module] = _Elapsed(frame.module_time_us, latest_us)
        else:
            latest_us = max(latest_us, clock.at(frame.module_time_us, latest_us))
        yield latest_us, frame


def _frames(source: Path, decoder: FrameDecoder) -> Iterator[WireFrame]:
    with source.open("rb") as file:
        while block := file.read(_BLOCK):
            yield from decoder.feed(block)
