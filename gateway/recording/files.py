"""The files of one session: names, rotation, room on the disk, syncing. Used by the recorder's thread."""

from __future__ import annotations

import json
import logging
import re
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from devices import recording_format as fmt
from devices.link import gateway_time_ns
from devices.recording_file import RecordingError, part_path
from devices.recording_writer import RecordingWriter, session_record
from gateway.settings import RecordingSettings
from gateway.support.names import IN_WORDS, RECORDING_NAME
from gateway.support.whole_files import free_bytes

log = logging.getLogger(__name__)

_MB = 1e6


@dataclass(frozen=True)
class Contents:
    """What every part of a session begins with."""

    links: Mapping[str, str]
    attachments: Mapping[str, bytes]
    software: str
    from_start: bool


def prepare_folder(settings: RecordingSettings, free: Callable[[Path], int] = free_bytes) -> Path:
    """Return the folder of the recordings, made if absent, with room for one.

    Raises ``RecordingError`` where no file can be made in it, or the room is too little.
    """
    folder = Path(settings.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Written to at once: permissions alone do not say whether a full or read-only disk takes a file.
        with tempfile.TemporaryFile(dir=folder):
            room = free(folder)
    except OSError as error:
        raise RecordingError(
            f"recordings cannot go to {folder} ({error.strerror}): set recording.folder to a folder "
            "that can be written"
        ) from error
    if room < settings.min_free_mb * _MB:
        raise RecordingError(
            f"{folder} has {room / _MB:.0f} MB free, less than recording.min_free_mb "
            f"({settings.min_free_mb:g}): make room, or choose another recording.folder"
        )
    return folder


class SessionFiles:
    """Opens the first file at once; begins another when one is large or old enough."""

    def __init__(
        self,
        settings: RecordingSettings,
        contents: Contents,
        name: str | None = None,
        *,
        free: Callable[[Path], int] = free_bytes,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the first file of a session.

        Raises ``RecordingError`` if the folder cannot be written, or has no room.
        """
        self._name = _checked(settings.name if name is None else name)
        self.folder = prepare_folder(settings, free)
        self.warning: str | None = None
        """Said about the disk; None while it has room."""
        self.bytes_before = 0
        """In the finished parts."""
        self.part = 1
        self._settings = settings
        self._contents = contents
        self._session = uuid.uuid4().hex
        self._free = free
        self._monotonic = monotonic
        self._writer = self._open_first()
        self._synced_at = monotonic()

    @property
    def path(self) -> Path:
        """The part being written."""
        return self._writer.path

    @property
    def size(self) -> int:
        """Bytes in all parts."""
        return self.bytes_before + self._writer.size

    def write(self, topic: str, time_ns: int, data: bytes, metadata: Mapping[str, str]) -> None:
        """Write one message to the file that is open."""
        self._writer.add(topic, time_ns, data, metadata)

    def flush(self) -> str | None:
        """Hand everything to the system; sync, rotate and look at the disk when it is time to.

        Returns why the recording must end, or None. Raises OSError when the disk is full or gone.
        """
        self._writer.flush()
        if self._settings.fsync_s and self._monotonic() - self._synced_at >= self._settings.fsync_s:
            self._writer.sync()
            self._synced_at = self._monotonic()
        reason = self._look_at_disk()
        if reason is None and self._is_due():
            self._rotate()
        return reason

    def close(self) -> None:
        """Write the index. Raises OSError."""
        try:
            self._writer.finish()
        except OSError:
            self._writer.abandon()
            raise

    def abandon(self) -> None:
        """Leave the file as it is after an error: it can be read as far as it was flushed."""
        self._writer.abandon()

    def _open_first(self) -> RecordingWriter:
        stem = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ") + (f"_{self._name}" if self._name else "")
        attempt = 1
        while True:
            again = f"_{attempt}" if attempt > 1 else ""
            try:
                self._first = self.folder / f"{stem}{again}{fmt.SUFFIX}"
                return self._open(self._first)
            except RecordingError:
                attempt += 1  # two within one second
            except OSError as error:
                raise RecordingError(
                    f"{self._first} cannot be written ({error.strerror}): choose another recording.folder"
                ) from error

    def _open(self, path: Path) -> RecordingWriter:
        self._begun = self._monotonic()
        begun_ns = gateway_time_ns()
        session = session_record(
            self._contents.links,
            session=self._session,
            part=str(self.part),
            software=self._contents.software,
            begun_ns=str(begun_ns),
            begun_utc_ns=str(time.time_ns()),
            from_start=str(int(self._contents.from_start)),
            name=self._name or "",
        )
        return RecordingWriter(path, session, self._contents.attachments, begun_ns)

    def _is_due(self) -> bool:
        size, minutes = self._settings.rotate_mb * _MB, self._settings.rotate_minutes
        is_large = bool(size) and self._writer.size >= size
        return is_large or (bool(minutes) and self._monotonic() - self._begun >= 60 * minutes)

    def _rotate(self) -> None:
        self._writer.add(fmt.EVENTS, gateway_time_ns(), self._rotation_event())
        self._writer.finish()
        self.bytes_before += self._writer.size
        self.part += 1
        self._writer = self._open(part_path(self._first, self.part))
        log.info("recording goes on in %s", self._writer.path)

    def _rotation_event(self) -> bytes:
        following = part_path(self._first, self.part + 1).name
        event = {"time_ns": gateway_time_ns(), "name": "rotated", "data": {"next": following}}
        return json.dumps(event).encode()

    def _look_at_disk(self) -> str | None:
        free = self._free(self.folder) / _MB
        if free < self._settings.min_free_mb:
            return (
                f"{self.folder} has {free:.0f} MB free, less than min_free_mb {self._settings.min_free_mb:g}"
            )
        if free < self._settings.warn_free_mb:
            # Warned once, not at every look, but the state is shown as long as it lasts.
            if self.warning is None:
                log.warning(
                    "%s has %.0f MB free: recording stops at %g MB",
                    self.folder,
                    free,
                    self._settings.min_free_mb,
                )
            self.warning = f"{free:.0f} MB free; recording stops at {self._settings.min_free_mb:g} MB"
        else:
            self.warning = None
        return None


def _checked(name: str | None) -> str | None:
    """Return the name itself, or none. Raises ``RecordingError`` for one that could mean another folder."""
    if name is not None and not re.fullmatch(RECORDING_NAME, name):
        raise RecordingError(f"'{name[:80]}' is no name for a recording: {IN_WORDS[RECORDING_NAME]}")
    return name
