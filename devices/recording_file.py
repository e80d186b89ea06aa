"""Reads recordings, whole or cut off anywhere.

The default readers of the MCAP library go by the index at the end of a file, which a killed process never
wrote; here files are read from the front, up to their end or the last good byte.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from devices import recording_format as fmt
from devices.link import LinkError

LARGEST_RECORD = 1 << 28
"""Bytes; a longer length can only be damage."""

LARGEST_CHUNK = 1 << 26
"""Bytes of a chunk, unpacked; those of the recorder have a few hundred kB. A file that was made to unpack to
more than memory holds counts as damaged there."""

MOST_GAPS = 200
"""Stretches of a file that are passed over; one with more was made to cost time."""

BYTES_A_RECORD = 8
"""Of a file, at the least, for each record that it unpacks to: its own and 16 of the index that follows."""

MOST_RECORDS_BEFORE = 8192
"""Records beyond that: of a chunk whose index does not follow, since the file was cut off there."""

DEEPEST_JSON = 40
"""Levels: far more than anything that is recorded has."""

_LONGEST_PART = 6
"""Digits."""

_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of what follows."""
_CHUNK_HEAD = struct.Struct("<BQQQQII4sQ")
"""The same of a chunk, with what stands before its data: times, size, checksum, compression, length."""
_CHUNK_BEGINS = re.compile(rb"(?s)\x06.{36}\x04\0\0\0zstd.{8}")
"""Of a chunk as the recorder writes them."""
_KNOWN = frozenset(map(int, Opcode))
_SEARCHED_AT_ONCE = 1 << 20

DAMAGE = (McapError, ValueError, struct.error, ZstdError, RuntimeError, MemoryError, OverflowError)
"""What the library raises for bytes that are not what they should be, lengths beyond any memory too."""


class RecordingError(LinkError):
    """A file that is no recording, or cannot be read or written; ``str(error)`` says which and why."""


class RecordedMessage(NamedTuple):
    """One message as it stands in a file."""

    topic: str
    time_ns: int
    data: bytes


@dataclass(frozen=True)
class Head:
    """What a file says about itself before its first message."""

    session: Mapping[str, str]
    """See ``recording_format.SESSION``."""
    attachments: Mapping[str, bytes]
    links: Mapping[str, str]

    @property
    def part(self) -> int:
        """Number of the file within its session, from 1."""
        return int(self.session.get("part", "1"))  # a number: see ``_read_head``


REMEDY = "; `mocap-gateway recover` makes a whole file of it"
"""How the words for a file that was not closed end."""
_NOT_CLOSED = "was not closed (power cut, kill, full disk)"
_NO_INDEX = "was not closed: all of its data is there, its index is not"


class _Gap:
    """In the place of what cannot be read, before the next chunk that can."""


ContentRecord: TypeAlias = Schema | Channel | Message | Attachment | Metadata


class RecordingFile:
    """One file. Opening raises ``RecordingError`` for one that is absent or no recording."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.defect: str | None = None
        """What was wrong with the file, once reading has come to its end; None for a whole one."""
        self.damaged_chunks = 0
        """MCAP chunks within the file that had to be left out."""
        self.position = 0
        """Bytes read so far, for showing progress."""
        self._good_to = 0
        """Where the last chunk ends whose checksum was right."""
        try:
            self.size = os.path.getsize(path)
            self.head = self._read_head()
        except OSError as error:
            raise RecordingError(f"recording {path} cannot be read: {error.strerror}") from error

    def messages(self) -> Iterator[RecordedMessage]:
        """Yield all messages, in the order in which they were written, up to the end or the last good one."""
        topics: dict[int, str] = {}
        for record in self.records():
            if isinstance(record, Message):
                yield RecordedMessage(topics.get(record.channel_id, ""), record.log_time, record.data)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic

    def records(self) -> Iterator[ContentRecord]:
        """Yield everything that is no index: for copying a file."""
        self.defect, self.damaged_chunks = None, 0
        count, known = 0, set[int]()
        for record in self._outer_records():
            if not isinstance(record, Chunk | _Gap):
                if isinstance(record, Schema | Channel | Message | Attachment | Metadata):
                    yield record
                continue
            try:
                if isinstance(record, _Gap):
                    raise ValueError("not one record could be read")
                inner = chunk_records(record, most_records(self.position) - count)
                self._good_to = self.position
            # One damaged chunk does not end the file: the chunks after it are read as usual.
            except DAMAGE:
                self.damaged_chunks += 1
                # A channel is named in the chunk of its first message alone, and once more after all data.
                missing = [each for each in self._channels_at_end() if each.id not in known]
                known.update(each.id for each in missing)
                yield from missing
                continue
            count += len(inner)
            for part in inner:
                if isinstance(part, Schema | Channel | Message):
                    yield part
                if isinstance(part, Channel):
                    known.add(part.id)
        if self.damaged_chunks and self.defect is None:
            self.defect = f"{self.path}: {self.damaged_chunks} damaged pieces were left out"

    def _channels_at_end(self) -> list[Channel]:
        """Return the channels that the end of the file names; none where it has no end."""
        with contextlib.suppress(*DAMAGE), self.path.open("rb") as file:
            summary = SeekingReader(file, record_size_limit=LARGEST_RECORD).get_summary()
            return [] if summary is None else list(summary.channels.values())
        return []

    def _outer_records(self) -> Iterator[McapRecord | _Gap]:
        """Yield records up to the end of the data; set ``defect`` where that is not the end of the file.

        Where no record can be read, a ``_Gap`` is yielded, and reading goes on with the next whole chunk.
        """
        self.position = self._good_to = 0
        with self.path.open("rb") as file:
            self.size = os.fstat(file.fileno()).st_size
            at = 0
            for _ in range(MOST_GAPS):
                try:
                    yield from self._records_from(file, at)
                except DAMAGE:
                    failed_at = self.position
                else:
                    self.defect = None if self._has_end(file) else f"{self.path} {_NO_INDEX}{REMEDY}"
                    break
                # A damaged length may have led anywhere: nothing good before that place is passed over.
                found = self._next_chunk(file, max(self._good_to, at + 1)) if failed_at else None
                what = "is damaged" if self._has_end(file) else _NOT_CLOSED
                self.defect = f"{self.path} {what}: read up to byte {failed_at} of {self.size}{REMEDY}"
                if found is None:
                    break
                at = found
                yield _Gap()
        self.position = self.size

    def _has_end(self, file: BinaryIO) -> bool:
        """Return whether a file has the closing magic, which is the last thing written."""
        file.seek(max(self.size - len(MCAP0_MAGIC), 0))
        return file.read() == MCAP0_MAGIC

    def _records_from(self, file: BinaryIO, at: int) -> Iterator[McapRecord]:
        """Yield records from a place on, up to the end of the data. Raises one of ``DAMAGE``."""
        file.seek(at)
        if at == 0 and file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise ValueError("no MCAP file")
        while not isinstance(record := self._next_record(file), DataEnd):
            self.position = file.tell()
            if record is not None:
                yield record

    def _next_record(self, file: BinaryIO) -> McapRecord | None:
        """Return the record that a file stands at; None: of an unknown kind. Raises one of ``DAMAGE``.

        The library takes what it gets for a record, however short, and a chunk's own lengths for right.
        """
        head = file.read(_RECORD_HEAD.size)
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode == 0 or length > min(LARGEST_RECORD, self.size - file.tell()):
            raise ValueError(f"no record of {length} bytes can stand here")
        content = head + file.read(length)
        if opcode == Opcode.CHUNK and not _fits(content):
            raise ValueError("the lengths of a chunk contradict each other")
        if opcode not in _KNOWN:
            return None
        reader = StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True)
        return next(iter(reader.records))

    def _next_chunk(self, file: BinaryIO, at: int) -> int | None:
        """Return where the first chunk from ``at`` on begins that the file holds whole; None without one."""
        while at + _CHUNK_HEAD.size <= self.size:
            file.seek(at)
            piece = file.read(_SEARCHED_AT_ONCE + _CHUNK_HEAD.size)
            found = _CHUNK_BEGINS.search(piece)
            while found is not None:
                begin = found.start()
                end = at + begin + _RECORD_HEAD.size + _RECORD_HEAD.unpack_from(piece, begin)[1]
                if end <= self.size and _fits(piece[begin : begin + _CHUNK_HEAD.size]):
                    return at + begin
                found = _CHUNK_BEGINS.search(piece, begin + 1)
            at += _SEARCHED_AT_ONCE
        return None

    def _read_head(self) -> Head:
        session: dict[str, str] | None = None
        attachments: dict[str, bytes] = {}
        read_to, is_cut = 0, False
        for record in self._outer_records():
            if isinstance(record, Metadata) and record.name == fmt.SESSION:
                session = dict(record.metadata)
            elif isinstance(record, Attachment):
                attachments[record.name] = record.data
            # The head is complete where the first chunk begins; the rest may be gigabytes.
            elif isinstance(record, Chunk | _Gap):
                break
            read_to = self.position
        else:
            is_cut = self.defect is not None and self._begins_head_record(read_to)
        self.defect, self.position = None, 0
        part = "1" if session is None else session.get("part", "1")
        # Part numbers become file names: anything but a small number is refused.
        if not (part.isascii() and part.isdecimal() and len(part) <= _LONGEST_PART and int(part) > 0):
            raise RecordingError(
                f"{self.path}: the record '{fmt.SESSION}' is damaged: part {part[:20]!r} is no number from 1"
            )
        if session is None:
            raise RecordingError(
                f"{self.path} is no recording of mocap-gateway: an MCAP file beginning with '{fmt.SESSION}' "
                "is wanted"
            )
        if is_cut:
            raise RecordingError(
                f"{self.path} was cut off at byte {self.size}, before its first sample: nothing that was "
                "recorded is in it"
            )
        if session.get("format") != str(fmt.FORMAT_VERSION):
            raise RecordingError(
                f"{self.path} is a recording of format {session.get('format')}; this program reads format "
                f"{fmt.FORMAT_VERSION}: a newer version may read it"
            )
        return Head(session, attachments, _links(self.path, session))

    def _begins_head_record(self, at: int) -> bool:
        """Return whether what begins at a place of the file belongs before all messages."""
        with self.path.open("rb") as file:
            file.seek(at)
            return file.read(1) in {bytes([Opcode.METADATA]), bytes([Opcode.ATTACHMENT])}


class RecordingParts:
    """A file and those that follow it in its session, read as one."""

    def __init__(self, path: str | Path) -> None:
        """Open the parts of a session. Raises ``RecordingError`` as ``RecordingFile`` does."""
        self.files = [RecordingFile(path), *_following(RecordingFile(path))]
        self.path = self.files[0].path
        self.head = self.files[0].head

    @property
    def links(self) -> dict[str, str]:
        """What every link in it carries (``devices.link.content_of``)."""
        return {name: content for file in self.files for name, content in file.head.links.items()}

    @property
    def defect(self) -> str | None:
        """What was wrong with any of the files read so far."""
        return "; ".join(file.defect for file in self.files if file.defect) or None

    @property
    def size(self) -> int:
        """Bytes, all files."""
        return sum(file.size for file in self.files)

    @property
    def position(self) -> int:
        """Bytes read so far."""
        return sum(file.position for file in self.files)

    def messages(self) -> Iterator[RecordedMessage]:
        """Yield messages as ``RecordingFile`` does, one file after another."""
        for file in self.files:
            file.position = 0
        for file in self.files:
            yield from file.messages()


def most_records(size: int) -> int:
    """Return how many records so many bytes of a file may unpack to."""
    return size // BYTES_A_RECORD + MOST_RECORDS_BEFORE


def chunk_records(chunk: Chunk, most: int) -> list[McapRecord]:
    """Return the records in a chunk, ``most`` at most. Raises one of ``DAMAGE``.

    The bytes unpacked never take more memory than ``LARGEST_CHUNK``.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise ValueError(f"a chunk of {size} bytes: at most {LARGEST_CHUNK} are read")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK).stream_reader(chunk.data) as unpacked:
            # One byte more than the chunk states shows that it understates its size.
            data = unpacked.read(size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"compression '{chunk.compression}': the recorder writes zstd or none")
    if len(data) != size:
        raise ValueError(f"a chunk of {size} bytes has {len(data)}")
    if not _has_at_most(data, most):
        raise ValueError(f"a chunk of more than {most} records")
    return breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)


def _fits(record: bytes) -> bool:
    """Return whether a chunk's length is that of its parts, as far as the recorder's compression tells."""
    if len(record) < _CHUNK_HEAD.size:
        return False
    _, length, *_, n_word, _, n_data = _CHUNK_HEAD.unpack_from(record)
    is_whole: bool = length == _CHUNK_HEAD.size - _RECORD_HEAD.size + n_data
    return is_whole or n_word != len(b"zstd")


def parse_json(data: str | bytes) -> Any:
    """Return JSON from an untrusted file. Raises ``ValueError`` for what is none, or is nested too deeply."""
    try:
        found = json.loads(data)
    except RecursionError:
        raise ValueError(f"JSON of more than {DEEPEST_JSON} levels") from None
    level = [found]
    # Level by level, not by recursion, which such data is meant to exhaust.
    for _ in range(DEEPEST_JSON):
        level = [
            inner
            for value in level
            if isinstance(value, dict | list)
            for inner in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return found
    raise ValueError(f"JSON of more than {DEEPEST_JSON} levels")


def _has_at_most(data: bytes, most: int) -> bool:
    """Return whether unpacked records are at most ``most``; they are only counted, not read."""
    at, count = 0, 0
    while at < len(data) and count <= most:
        at += _RECORD_HEAD.size + _RECORD_HEAD.unpack_from(data, at)[1]
        count += 1
    return count <= most


def part_path(first: Path, part: int) -> Path:
    """Return where a part of the session stands whose first file is ``first``."""
    return first if part == 1 else first.with_name(f"{first.stem}_part{part}{first.suffix}")


def _following(file: RecordingFile) -> list[RecordingFile]:
    """Return the later parts of a session that lie beside this one."""
    mark = f"_part{file.head.part}"
    stem = file.path.stem.removesuffix(mark) if file.head.part > 1 else file.path.stem
    first = file.path.with_name(stem + file.path.suffix)
    found: list[RecordingFile] = []
    part = file.head.part + 1
    while (path := part_path(first, part)).is_file():
        following = RecordingFile(path)
        # A file of that name may be of another session.
        if following.head.session.get("session") != file.head.session.get("session"):
            break
        found.append(following)
        part += 1
    return found


def _links(path: Path, session: Mapping[str, str]) -> dict[str, str]:
    try:
        return {str(name): str(content) for name, content in parse_json(session["links"]).items()}
    except (KeyError, ValueError, AttributeError) as error:
        raise RecordingError(f"{path}: the record '{fmt.SESSION}' is damaged ({error})") from error
