"""Makes a whole file of one that was cut off or damaged: everything that can be read, with an index."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message

from devices import recording_format as fmt
from devices.recording_file import REMEDY, RecordingError, RecordingFile
from devices.recording_writer import DerivedRecordingWriter
from gateway.support.whole_files import remedy_of

_MESSAGES_A_FLUSH = 256


@dataclass(frozen=True)
class Recovered:
    """What became of a file."""

    path: Path
    messages: int
    defect: str | None
    """What was wrong with it, without the advice to recover it; None: nothing was."""


def recover(source: Path, target: Path, progress: Callable[[int, int], None] | None = None) -> Recovered:
    """Write ``target`` from all that can be read of one file.

    Raises ``RecordingError`` when ``source`` is no recording, ``target`` exists or cannot be written.
    """
    return _recovered(source, target, progress, replaces=False)


def recover_in_place(source: Path, progress: Callable[[int, int], None] | None = None) -> Recovered:
    """Recover ``source`` in place; it stays as it is until the new file is whole. See ``recover``."""
    return _recovered(source, source, progress, replaces=True)


def _recovered(
    source: Path, target: Path, progress: Callable[[int, int], None] | None, *, replaces: bool
) -> Recovered:
    file = RecordingFile(source)
    try:
        messages = _copy(file, target, progress, replaces=replaces)
    except OSError as error:
        remedy = remedy_of(error)
        what_to_do = "" if remedy is None else f": {remedy}"
        raise RecordingError(f"{target} cannot be written: {error.strerror}{what_to_do}") from error
    return Recovered(target, messages, (file.defect or "").removesuffix(REMEDY) or None)


def _copy(
    file: RecordingFile, target: Path, progress: Callable[[int, int], None] | None, *, replaces: bool
) -> int:
    channels: dict[int, Channel] = {}
    messages = 0
    head = file.head
    created_ns = int(head.session.get("begun_ns", 0))
    with DerivedRecordingWriter(
        target, head.session, head.attachments, created_ns, replaces=replaces
    ) as writer:
        for record in file.records():
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                # A topic of a newer version cannot be checked, and so not vouched for.
                if not fmt.is_known(channel.topic):
                    continue
                writer.add(channel.topic, record.log_time, record.data, channel.metadata)
                messages += 1
                if messages % _MESSAGES_A_FLUSH == 0:
                    writer.flush()
                    if progress is not None:
                        progress(file.position, file.size)
    return messages
