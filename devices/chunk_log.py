"""A log of chunks: all that arrived, as it arrived, enough to run the gateway again bit for bit.

The file is made to survive being cut off anywhere. All numbers little-endian::

    header   magic:8 version:u8 n_links:u8, per link [framing:u8 length:u8 name:utf-8], crc32:u32
    chunk    arrived_ns:i64 link:u8 length:u32 crc32:u32 data:length

``link`` counts the links of the header from 0; ``framing`` is 1 for a byte stream, 2 for CAN frame
records. ``crc32`` is over all of the header or chunk before and after it.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from devices.link import Chunk, Framing, LinkError

MAGIC = b"mocapch\n"
VERSION = 1
LARGEST_CHUNK = 16 * 1024 * 1024
"""Bytes; a longer length can only be damage."""

_PREFIX = struct.Struct("<8sBB")
_LINK = struct.Struct("<BB")
_CRC = struct.Struct("<I")
_HEAD = struct.Struct("<qBI")
_FRAMING_CODES = {Framing.BYTE_STREAM: 1, Framing.CAN: 2}
_FRAMINGS = {code: framing for framing, code in _FRAMING_CODES.items()}


class ChunkLogError(LinkError):
    """A file that is no chunk log, or not the one expected."""


@dataclass(frozen=True, slots=True)
class LoggedLink:
    """A link whose chunks are in a log."""

    name: str
    framing: Framing


class ChunkLogReader:
    """The chunks of a log in the order they were written, up to its end or the first damage.

    Opening raises ``ChunkLogError`` for a file that is no chunk log, and OSError as ``open`` does.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.defect: str | None = None
        """What was wrong with the tail, once iterating has come to it; None when all was read."""
        self.end = 0
        """File offset after the last good chunk read, bytes."""
        with self.path.open("rb") as file:
            self.links: tuple[LoggedLink, ...] = _read_header(file, self.path)
            self._start = file.tell()

    def __iter__(self) -> Iterator[Chunk]:
        self.defect = None
        self.end = self._start
        with self.path.open("rb") as file:
            file.seek(self._start)
            while isinstance(found := self._read_chunk(file), Chunk):
                self.end = file.tell()
                yield found
        if found:
            self.defect = f"{self.path} is {found} at byte {self.end}; all before that was read"

    def _read_chunk(self, file: BinaryIO) -> Chunk | str:
        """The next chunk, or what is wrong with it, or "" at the end."""
        head = file.read(_HEAD.size + _CRC.size)
        if not head:
            return ""
        if len(head) < _HEAD.size + _CRC.size:
            return "cut off inside the head of the chunk"
        arrived_ns, link, length = _HEAD.unpack_from(head)
        if length > LARGEST_CHUNK or link >= len(self.links):
            return "damaged in the chunk"
        data = file.read(length)
        if len(data) < length:
            return "cut off inside the chunk"
        if _CRC.unpack_from(head, _HEAD.size)[0] != _checksum(head[: _HEAD.size], data):
            return "damaged in the chunk"
        return Chunk(data, arrived_ns, self.links[link].name)


class ChunkLogWriter:
    """Appends chunks to a log, a new one or one of the same links.

    Every chunk is with the system before ``append`` returns: killing the process loses none. A broken
    tail of an earlier run is cut off first. Not for two writers at once.
    """

    def __init__(self, path: str | Path, links: Sequence[LoggedLink]) -> None:
        """Raises ``ChunkLogError`` when the file there is no log of these links; OSError as ``open`` does."""
        self.path = Path(path)
        self._index = {link.name: index for index, link in enumerate(links)}
        header = _header(links)
        self._end = self._existing_end(links)
        self._file = open(self.path, "r+b" if self._end else "w+b", buffering=0)  # noqa: SIM115 - held open
        if self._end == 0:
            self._write(header)
        self._file.truncate(self._end)
        self._file.seek(self._end)

    def append(self, chunk: Chunk) -> None:
        """Write one chunk. Raises KeyError for a link not in the header, OSError when the disk is full.

        After an error the log is as it was before, and more may be appended.
        """
        if len(chunk.data) > LARGEST_CHUNK:
            raise ValueError(f"chunk of {len(chunk.data)} bytes: a log takes at most {LARGEST_CHUNK}")
        head = _HEAD.pack(chunk.arrived_ns, self._index[chunk.link], len(chunk.data))
        self._write(head + _CRC.pack(_checksum(head, chunk.data)) + chunk.data)

    def sync(self) -> None:
        """Return when the disk has all: also a power cut then loses nothing."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _existing_end(self, links: Sequence[LoggedLink]) -> int:
        """Where to go on writing; 0 for a new file."""
        if not self.path.exists() or self.path.stat().st_size == 0:
            return 0
        reader = ChunkLogReader(self.path)
        if reader.links != tuple(links):
            raise ChunkLogError(
                f"{self.path} is a log of {_names(reader.links)}, not {_names(links)}: choose another"
            )
        for _ in reader:
            pass
        return reader.end

    def _write(self, data: bytes) -> None:
        remaining = memoryview(data)
        try:
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
        except OSError:
            self._file.truncate(self._end)
            self._file.seek(self._end)
            raise
        self._end += len(data)


def _header(links: Sequence[LoggedLink]) -> bytes:
    names = [link.name.encode() for link in links]
    if len(set(names)) != len(links) or len(links) > 255 or any(len(name) > 255 for name in names):
        raise ValueError(
            f"a log takes up to 255 links of different names up to 255 bytes; got {_names(links)}"
        )
    header = _PREFIX.pack(MAGIC, VERSION, len(links))
    for link, name in zip(links, names, strict=True):
        header += _LINK.pack(_FRAMING_CODES[link.framing], len(name)) + name
    return header + _CRC.pack(zlib.crc32(header))


def _read_header(file: BinaryIO, path: Path) -> tuple[LoggedLink, ...]:
    header = file.read(_PREFIX.size)
    if len(header) < _PREFIX.size or not header.startswith(MAGIC):
        raise ChunkLogError(f"{path} is not a chunk log: it does not begin with {MAGIC!r}")
    _, version, n_links = _PREFIX.unpack(header)
    if version != VERSION:
        raise ChunkLogError(
            f"{path} is a chunk log of version {version}; this program reads version {VERSION}"
        )
    links = []
    for _ in range(n_links):
        entry = file.read(_LINK.size)
        code, length = _LINK.unpack(entry) if len(entry) == _LINK.size else (0, 0)
        name = file.read(length)
        header += entry + name
        links.append((name, code))
    if file.read(_CRC.size) != _CRC.pack(zlib.crc32(header)) or any(
        code not in _FRAMINGS for _, code in links
    ):
        raise ChunkLogError(f"{path} is a chunk log with a damaged header: nothing can be read")
    return tuple(LoggedLink(name.decode(errors="replace"), _FRAMINGS[code]) for name, code in links)


def _checksum(head: bytes, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(head))


def _names(links: Sequence[LoggedLink]) -> str:
    return ", ".join(f"{link.name} ({link.framing.value})" for link in links) or "no links"
