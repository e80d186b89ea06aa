"""What stood in the modules before each change, kept on disk so that it can be written back.

An entry is on the disk before anything is sent: whatever happens in the middle, what was there is not lost.
The file is the truth, never a copy in memory: a running gateway and a command line share it under a lock.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, TypeAdapter, ValidationError

from devices.commands.configure import Change
from gateway.contract.requests import UniqueId
from gateway.errors import GatewayError
from gateway.support.file_lock import file_lock
from gateway.support.former_names import current
from gateway.support.whole_files import write_whole

_log = logging.getLogger(__name__)

_LONGEST = 50
"""Entries remembered."""

_LOCK_PATIENCE_S = 5.0


class JournalError(GatewayError):
    """The journal cannot be read or written, so that nothing may be changed."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One change of one or more modules."""

    key: str
    changes: tuple[Change, ...]
    """At most one for each module."""


class _Values(BaseModel):
    model_config = ConfigDict(extra="forbid")

    before: Annotated[dict[str, Any], BeforeValidator(current)]
    after: Annotated[dict[str, Any], BeforeValidator(current)]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid")

    key: str
    modules: dict[UniqueId, _Values]


_RECORDS = TypeAdapter(list[_Record])


def default_journal_path() -> Path:
    """Return the path of ``module_changes.json`` among the user's state files."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "mocap-gateway" / "module_changes.json"


class Journal:
    """A stack of changes in a file. Its methods wait for the disk: call them in a thread of their own.

    All raise ``JournalError``, saying what would do, where the file can be neither read nor written.
    """

    def __init__(self, path: Path) -> None:
        """Open nothing yet."""
        self._path = path

    def record(self, changes: Iterable[Change]) -> Entry:
        """Add an entry with what is about to be written; it is on the disk when this returns."""
        entry = Entry(secrets.token_hex(8), _merged(changes))
        with self._locked():
            self._save([*self._load(), _record(entry)][-_LONGEST:])
        return entry

    def last(self) -> Entry | None:
        """Return the newest entry, None when there is none."""
        with self._locked():
            records = self._load()
        return _entry(records[-1]) if records else None

    def settle(self, entry: Entry, changes: Iterable[Change]) -> None:
        """Keep of an entry only what the modules hold: ``changes``. None at all: forget it."""
        kept = Entry(entry.key, _merged(changes))
        with self._locked():
            records = [
                _record(kept) if record.key == entry.key else record
                for record in self._load()
                if record.key != entry.key or kept.changes
            ]
            self._save(records)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock that all processes take before they read or write the file."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with file_lock(self._path.with_suffix(".lock"), _LOCK_PATIENCE_S):
                yield
        except BlockingIOError:
            raise JournalError(
                f"{self._path} is held by another process for more than {_LOCK_PATIENCE_S:.0f} s: "
                "nothing was changed; is a mocap-gateway stopped (Ctrl-Z)? continue or end it"
            ) from None
        except OSError as error:
            raise self._unusable(error) from error

    def _load(self) -> list[_Record]:
        try:
            return _RECORDS.validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return []
        except ValidationError as error:
            aside = self._set_aside()
            _log.warning(
                "%s cannot be read (%s): earlier changes of modules cannot be undone; it is kept as %s",
                self._path, error.errors()[0]["msg"], aside,
            )  # fmt: skip
            return []

    def _set_aside(self) -> Path:
        number = 1
        while (aside := self._path.with_suffix(f".damaged-{number}")).exists():
            number += 1
        self._path.replace(aside)
        return aside

    def _save(self, records: list[_Record]) -> None:
        """Replace the file as a whole, and wait until the disk has it."""
        write_whole(self._path, _RECORDS.dump_json(records, indent=2))
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name too
        finally:
            os.close(folder)

    def _unusable(self, error: OSError) -> JournalError:
        return JournalError(
            f"{self._path}: what stands in the modules cannot be kept for `modules undo` "
            f"({error.strerror}), so nothing was changed: make room or give access there, or name another "
            "folder in XDG_STATE_HOME"
        )


def _merged(changes: Iterable[Change]) -> tuple[Change, ...]:
    """Return one change for each module."""
    by_module: dict[bytes, Change] = {}
    for change in changes:
        known = by_module.get(change.unique_id, Change(change.unique_id, {}, {}))
        by_module[change.unique_id] = Change(
            change.unique_id, {**known.before, **change.before}, {**known.after, **change.after}
        )
    return tuple(by_module.values())


def _record(entry: Entry) -> _Record:
    modules = {
        change.unique_id.hex(): _Values(before=dict(change.before), after=dict(change.after))
        for change in entry.changes
    }
    return _Record(key=entry.key, modules=modules)


def _entry(record: _Record) -> Entry:
    return Entry(
        record.key,
        tuple(
            Change(bytes.fromhex(uid), values.before, values.after) for uid, values in record.modules.items()
        ),
    )
