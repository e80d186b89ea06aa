"""Writes recordings: one file at a time, whole up to its last flush whatever happens after it."""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from devices import recording_format as fmt
from devices.link import Chunk
from devices.recording_file import RecordingError

_CHUNK_SIZE = 1 << 22
"""Bytes of messages that make an MCAP chunk without a flush, so that none grows without bound."""
_INDEX_OF_WRITER = "_Writer__chunk_indices"
"""Where the library keeps what its index will be made of."""
_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml"}


class RecordingWriter:
    """One new file. Not for two threads at once.

    What is added goes to the system with ``flush``: killing the process then loses none of it. After an
    OSError (a full disk) the file ends with the last good flush and can be read; nothing more can be added.
    """

    def __init__(
        self, path: str | Path, session: Mapping[str, str], attachments: Mapping[str, bytes], created_ns: int
    ) -> None:
        """Begin a file.

        session: the keys of ``recording_format.SESSION``.

        Raises ``RecordingError`` when the file exists, ``OSError`` as ``open`` does and for a full disk; then
        there is no file.
        """
        self.path = Path(path)
        self._indices = _ChunkIndices(self.path.parent)
        try:
            self._file = _Buffered(self.path)
        except FileExistsError:
            self._indices.close()
            raise RecordingError(f"{path} exists already: choose another name") from None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._begin(session, attachments, created_ns)
        except BaseException:  # a full disk: a file without even its beginning is of no use
            self.abandon()
            self.path.unlink(missing_ok=True)
            raise

    def _begin(self, session: Mapping[str, str], attachments: Mapping[str, bytes], created_ns: int) -> None:
        self._writer = Writer(
            cast(IO[Any], self._file), chunk_size=_CHUNK_SIZE, compression=CompressionType.ZSTD
        )
        setattr(self._writer, _INDEX_OF_WRITER, self._indices)
        self._writer.start(fmt.PROFILE, f"mocap-gateway {session.get('software', '')}".strip())
        self._writer.add_metadata(fmt.SESSION, dict(session))
        for name, data in attachments.items():
            media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            self._writer.add_attachment(created_ns, created_ns, name, media_type, data)
        self.flush()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.written

    def add(self, topic: str, time_ns: int, data: bytes, metadata: Mapping[str, str] | None = None) -> None:
        """Append a message; ``metadata`` describes the channel when the topic is a new one."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic, dict(metadata or {}))
        self._writer.add_message(channel, max(time_ns, 0), data, max(time_ns, 0))

    def add_chunk(self, chunk: Chunk, content: str) -> None:
        """Append what a link gave. content: what the link carries (``devices.link.content_of``)."""
        topic, data = fmt.message_of(chunk)
        self.add(topic, chunk.arrived_ns, data, {"link": chunk.link, "framing": str(content)})

    def flush(self) -> None:
        """Hand all to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def sync(self) -> None:
        """Return when the disk has all that was flushed: also a power cut then loses nothing of it."""
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index, and close."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        self.sync()
        self.abandon()

    def abandon(self) -> None:
        """Close as it is, without an index."""
        self._indices.close()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abandon()

    def _register(self, topic: str, metadata: dict[str, str]) -> int:
        kind = fmt.kind_of(topic)
        if kind.schema not in self._schemas:
            self._schemas[kind.schema] = self._writer.register_schema(
                kind.schema, kind.schema_encoding, kind.schema_text.encode()
            )
        return self._writer.register_channel(
            topic, kind.message_encoding, self._schemas[kind.schema], metadata
        )


def refuse_other_name(path: Path) -> None:
    """Raise ``RecordingError`` for a name by which nothing would take a file for a recording."""
    if not fmt.is_recording(path):
        stem = path.name.partition(".")[0]
        raise RecordingError(f"{path}: what is written is a recording: name it {stem}{fmt.SUFFIX}")


class DerivedRecordingWriter(RecordingWriter):
    """A recording made of something that is kept: it appears under its name once it is whole.

    Until then it is ``.NAME.unfinished`` beside it. One that was begun and not ended (an error, a killed
    process) is in nobody's way: the first is taken away again, the second by the next of that name.
    """

    def __init__(
        self,
        path: str | Path,
        session: Mapping[str, str],
        attachments: Mapping[str, bytes],
        created_ns: int,
        *,
        replaces: bool = False,
    ) -> None:
        """Begin a file as ``RecordingWriter`` does; ``replaces`` lets it replace an existing one.

        A new one is refused as by ``refuse_other_name``.
        """
        self._target = Path(path)
        if not replaces:
            refuse_other_name(self._target)
            if self._target.exists():
                raise RecordingError(f"{path} exists already: choose another name")
        # Hidden beside its target, so that nobody takes half a file for a recording.
        unfinished = self._target.with_name(f".{self._target.name}.unfinished")
        unfinished.unlink(missing_ok=True)
        super().__init__(unfinished, session, attachments, created_ns)

    def finish(self) -> None:
        """Write the index, close, and give the file its name."""
        super().finish()
        self.path.replace(self._target)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            super().__exit__(kind, error, traceback)
        finally:
            self.path.unlink(missing_ok=True)


class _ChunkIndices:
    """The index of a file while it is written, in a file without a name beside it.

    The library's own list takes 17 MB for an hour's; packed in memory they were megabytes that still grew.
    """

    def __init__(self, folder: Path) -> None:
        """Open a temporary file. Raises ``OSError`` naming the folder: users do not know the file itself."""
        try:
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed with the writer
        except OSError as error:
            error.filename = str(folder)
            raise

    def append(self, index: ChunkIndex) -> None:
        """Keep the index of a chunk until the file is finished."""
        record = RecordBuilder()
        index.write(record)
        self._file.write(record.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator[ChunkIndex]:
        size = self._file.seek(0, io.SEEK_END)
        self._file.seek(0)
        stream = ReadDataStream(self._file)
        while stream.count < size:
            stream.read1(), stream.read8()  # opcode and length: all are of one kind
            yield ChunkIndex.read(stream)

    def close(self) -> None:
        """Close and remove the temporary file."""
        with contextlib.suppress(OSError):  # a full disk: nobody wants what is still to be written to it
            self._file.close()


class _Buffered:
    """A file that gets everything since the last flush in one piece, or nothing of it."""

    def __init__(self, path: Path) -> None:
        self.written = 0
        self._folder = path.parent
        self._pending = bytearray()
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)

    def write(self, data: bytes) -> int:
        """Hold bytes until ``flush``; return how many they are."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Return the position behind everything written and pending, bytes."""
        return self.written + len(self._pending)

    def flush(self) -> None:
        """Write everything that is pending; on an error cut the file back to what was whole."""
        remaining = memoryview(bytes(self._pending))
        self._pending.clear()
        length = len(remaining)
        try:
            while remaining:
                # One call may write only a part.
                remaining = remaining[os.write(self._descriptor, remaining) :]
        except OSError as error:
            # A record of which a part was written would spoil all that follow.
            os.ftruncate(self._descriptor, self.written)
            error.filename = str(self._folder)  # its disk: the file may have a name that users do not know
            raise
        self.written += length

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._descriptor

    def close(self) -> None:
        """Close the file; what is pending is lost."""
        os.close(self._descriptor)


def session_record(links: Mapping[str, str], **keys: str) -> dict[str, str]:
    """Return the metadata record at the beginning of a file. links: what each carries."""
    return {"format": str(fmt.FORMAT_VERSION), "links": json.dumps(dict(links)), "part": "1", **keys}
