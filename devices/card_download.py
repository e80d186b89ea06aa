"""Files of a memory card to files of this computer: in order, resumed where they were cut, verified.

What has come so far is in ``<target>.part``. Only a file whose checksum is what the card said gets its
own name, so that a target which is there is whole.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple

from devices.command_client import CommandClient
from devices.device_errors import CardError
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
