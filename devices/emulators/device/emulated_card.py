"""A relay's memory card: what the modules send, kept as files that a host can fetch later. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple
from zlib import crc32

CAPACITY = 64 * 1024 * 1024
"""Bytes of all files together."""

LAST_FILE = 0xFFFE
"""Highest number of a file: 0xFFFF stands for all."""


class CardEntry(NamedTuple):
    """What the list of files says of one."""

    file: int
    size: int
    """Bytes."""
    start_time_us: int
    """Relay's clock when it was begun, µs modulo 2^32."""
    crc32: int


@dataclass
class _File:
    start_time_us: int
    content: bytearray = field(default_factory=bytearray)
    crc32: int = 0


class EmulatedCard:
    """Files of stuffed wire frames, one after the other as on a byte stream.

    They are numbered from 1 and no number comes twice while the card lasts. It keeps them over a loss
    of power.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._files: dict[int, _File] = {}
        self._last = 0
        self._open: int | None = None
        self._used = 0

    @property
    def recording(self) -> int | None:
        """Number of the file being written, if any."""
        return self._open

    def begin(self, start_time_us: int) -> bool:
        """End the open file and begin another; False when the card is full."""
        self.end()
        if self._last >= LAST_FILE or self._used >= self._capacity:
            return False
        self._last += 1
        self._open = self._last
        self._files[self._last] = _File(start_time_us)
        return True

    def end(self) -> None:
        """Record no more."""
        self._open = None

    def write(self, data: bytes) -> bool:
        """Append to the open file. False when it does not fit: the recording has then ended."""
        if self._open is None:
            return True
        if self._used + len(data) > self._capacity:
            self.end()
            return False
        written = self._files[self._open]
        written.content += data
        written.crc32 = crc32(data, written.crc32)
        self._used += len(data)
        return True

    def entries(self) -> list[CardEntry]:
        """Return all files in order of their numbers; the open one as far as it goes."""
        return [
            CardEntry(number, len(file.content), file.start_time_us, file.crc32)
            for number, file in self._files.items()
        ]

    def __contains__(self, file: int) -> bool:
        return file in self._files

    def read(self, file: int, offset: int, length: int) -> bytes | None:
        """Return so many bytes, fewer at the end; None beyond it.

        Raises ``KeyError`` for a file that is not there.
        """
        content = self._files[file].content
        return bytes(content[offset : offset + length]) if offset <= len(content) else None

    def erase(self, file: int) -> None:
        """Forget a file, an open one too. Raises ``KeyError`` when there is none."""
        if file == self._open:
            self.end()
        self._used -= len(self._files.pop(file).content)

    def erase_all(self) -> None:
        """Forget all files."""
        for file in tuple(self._files):
            self.erase(file)
