"""What is in a recording, at a glance: duration, size, modules, losses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.reader import SeekingReader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from devices import recording_format as fmt
from devices.recording_file import (
    DAMAGE,
    LARGEST_RECORD,
    RecordingError,
    RecordingFile,
    chunk_records,
    most_records,
    parse_json,
)
from firmware_protocol import RELAY
from gateway.errors import GatewayError
from gateway.recording.reading import Recording


@dataclass
class RecordingSummary:
    """Figures of a recording."""

    path: str
    name: str
    begun_utc_ns: int
    duration_s: float
    bytes: int
    parts: int
    messages: dict[str, int] = field(default_factory=dict)
    """By topic."""
    modules: dict[str, dict[str, int]] = field(default_factory=dict)
    """By module id: packets received and lost, as last counted while recording."""
    from_start: bool = False
    defect: str | None = None

    @property
    def n_modules(self) -> int:
        """How many modules and devices were heard, without the relay that they sent through."""
        return len(self.modules.keys() - {str(RELAY)})

    @property
    def loss_percent(self) -> float | None:
        """Packets lost of those sent; None when it was not counted."""
        received = sum(module["received"] for module in self.modules.values())
        lost = sum(module["lost"] for module in self.modules.values())
        return 100.0 * lost / (received + lost) if received else None


@dataclass
class _Figures:
    messages: Counter[str] = field(default_factory=Counter)
    first_ns: int | None = None
    last_ns: int | None = None
    statistics: dict[str, Any] = field(default_factory=dict)

    def saw(self, first_ns: int, last_ns: int) -> None:
        """Extend the span by the times of one more part, ns."""
        self.first_ns = first_ns if self.first_ns is None else min(first_ns, self.first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(last_ns, self.last_ns)


def summarise(recording: Recording) -> RecordingSummary:
    """Return figures of all parts: from their indices, or by reading a file that has none to its end."""
    figures = _Figures()
    defects = []
    for file in recording.parts.files:
        # Without an index, as after a kill, the file itself must be read.
        if not _by_index(file, figures):
            _by_reading(file, figures)
        if file.defect is not None:
            defects.append(file.defect)
    meta = recording.meta
    duration_ns = 0 if figures.first_ns is None else (figures.last_ns or 0) - figures.first_ns
    return RecordingSummary(
        path=str(meta.path),
        name=meta.name,
        begun_utc_ns=meta.begun_utc_ns,
        duration_s=duration_ns * 1e-9,
        bytes=meta.size,
        parts=meta.n_parts,
        messages=dict(figures.messages),
        modules=_modules(figures.statistics),
        from_start=meta.from_start,
        defect="; ".join(defects) or None,
    )


def recordings_in(folder: Path) -> Iterator[Recording | RecordingError]:
    """Yield the recordings of a folder, oldest first, each with its later parts; errors of files that are
    none.

    Raises ``RecordingError`` for a folder that cannot be read.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if fmt.is_recording(path))
    except FileNotFoundError as error:
        raise RecordingError(
            f"there is no folder {folder}: the first `mocap-gateway record` makes it; or name another one"
        ) from error
    except OSError as error:
        raise RecordingError(f"{folder} cannot be read: {error.strerror}") from error
    shown: set[Path] = set()
    for path in paths:
        if path in shown:
            continue
        try:
            recording = Recording(path)
        except RecordingError as error:
            yield error
            continue
        except GatewayError as error:
            yield RecordingError(str(error))
            continue
        # Later parts follow by themselves; listed again, they would look like sessions of their own.
        shown.update(file.path for file in recording.parts.files)
        yield recording


def _by_index(file: RecordingFile, figures: _Figures) -> bool:
    """Return whether the file has an index; if so, its figures were taken."""
    try:
        with file.path.open("rb") as stream:
            summary = SeekingReader(stream, record_size_limit=LARGEST_RECORD).get_summary()
            # A recording that was not closed has no summary at its end.
            if summary is None or summary.statistics is None:
                return False
            for number, count in summary.statistics.channel_message_counts.items():
                figures.messages[summary.channels[number].topic] += count
            if summary.statistics.message_count:
                figures.saw(summary.statistics.message_start_time, summary.statistics.message_end_time)
            figures.statistics = _newest_statistics(stream, summary) or figures.statistics
    except (*DAMAGE, KeyError, StopIteration, OSError):
        return False
    return True


def _newest_statistics(stream: BinaryIO, summary: Summary) -> dict[str, Any] | None:
    """Return the last statistics in the file; None: it has none. Raises one of ``DAMAGE``."""
    # The index names the chunks that hold statistics: one chunk is read instead of the whole file.
    numbers = {channel.id for channel in summary.channels.values() if channel.topic == fmt.STATISTICS}
    holding = [index for index in summary.chunk_indexes if numbers & index.message_index_offsets.keys()]
    if not holding:
        return None
    stream.seek(max(holding, key=lambda index: index.message_end_time).chunk_start_offset)
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=LARGEST_RECORD)
    chunk = next(iter(reader.records))
    found = chunk_records(chunk, most_records(stream.tell())) if isinstance(chunk, Chunk) else []
    payloads = [part.data for part in found if isinstance(part, Message) and part.channel_id in numbers]
    return _plain(payloads[-1]) if payloads else None


def _by_reading(file: RecordingFile, figures: _Figures) -> None:
    for message in file.messages():
        figures.messages[message.topic] += 1
        figures.saw(message.time_ns, message.time_ns)
        if message.topic == fmt.STATISTICS:
            figures.statistics = _plain(message.data)


def _plain(data: bytes) -> dict[str, Any]:
    """Return the object in a message; empty for what is none."""
    try:
        found = parse_json(data)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _modules(statistics: dict[str, Any]) -> dict[str, dict[str, int]]:
    """Return counts by module id, without entries that are malformed."""
    modules = statistics.get("modules")
    if not isinstance(modules, dict):
        return {}
    by_module = {
        name: figures for name, figures in modules.items() if name.isdecimal() and isinstance(figures, dict)
    }
    return {
        name: {key: _count(by_module[name].get(key)) for key in ("received", "lost")}
        for name in sorted(by_module, key=int)
    }


def _count(value: object) -> int:
    return value if isinstance(value, int) else 0
