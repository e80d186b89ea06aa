"""What is in a recording, at a glance: duration, size, modules, losses."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader

from devices import recording_format as fmt
from devices.recording_file import RecordingError, RecordingFile
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
        self.first_ns = first_ns if self.first_ns is None else min(first_ns, self.first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(last_ns, self.last_ns)


def summarise(recording: Recording) -> RecordingSummary:
    """Figures of all parts: from their indices, or by reading a file that has none to its end."""
    figures = _Figures()
    defects = []
    for file in recording.parts.files:
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
    """The recordings of a folder, oldest first, each with its later parts; errors of files that are none.

    Raises ``RecordingError`` for a folder that cannot be read.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == fmt.SUFFIX)
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
        shown.update(file.path for file in recording.parts.files)
        yield recording


def _by_index(file: RecordingFile, figures: _Figures) -> bool:
    """Whether the file has an index; if so, its figures were taken."""
    try:
        with file.path.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return False
            for number, count in summary.statistics.channel_message_counts.items():
                figures.messages[summary.channels[number].topic] += count
            if summary.statistics.message_count:
                figures.saw(summary.statistics.message_start_time, summary.statistics.message_end_time)
            newest = next(iter(reader.iter_messages([fmt.STATISTICS], reverse=True)), None)
            if newest is not None:
                figures.statistics = json.loads(newest[2].data)
    except (McapError, ValueError, KeyError, OSError):
        return False
    return True


def _by_reading(file: RecordingFile, figures: _Figures) -> None:
    for message in file.messages():
        figures.messages[message.topic] += 1
        figures.saw(message.time_ns, message.time_ns)
        if message.topic == fmt.STATISTICS:
            figures.statistics = json.loads(message.data)


def _modules(statistics: dict[str, Any]) -> dict[str, dict[str, int]]:
    modules = statistics.get("modules", {})
    return {
        name: {key: int(figures.get(key, 0)) for key in ("received", "lost")}
        for name, figures in sorted(modules.items(), key=lambda item: int(item[0]))
    }
