"""What stood in the modules before each change, kept on disk so that it can be written back.

It is written before anything is sent: whatever happens in the middle, what was there is not lost.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson

from devices.configure import Change

_log = logging.getLogger(__name__)

_LONGEST = 50
"""Changes remembered."""

Settings = Mapping[str, Any]


def default_journal_path() -> Path:
    """``module_changes.json`` among the user's state files."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "mocap-gateway" / "module_changes.json"


class Journal:
    """A stack of changes. Where it cannot be written it is kept in memory, with one warning."""

    def __init__(self, path: Path | None) -> None:
        """``path``: None keeps it in memory."""
        self._path = path
        self._records: list[dict[str, dict[str, dict[str, Any]]]] = self._load()

    def record(self, changes: list[Change]) -> None:
        """Remember what is about to be written."""
        self._records.append(
            {
                change.unique_id.hex(): {"before": dict(change.before), "after": dict(change.after)}
                for change in changes
            }
        )
        del self._records[:-_LONGEST]
        self._save()

    def last(self) -> list[Change]:
        """The newest change, empty when there is none."""
        newest = self._records[-1] if self._records else {}
        return [
            Change(bytes.fromhex(unique_id), values["before"], values["after"])
            for unique_id, values in newest.items()
        ]

    def drop_last(self) -> None:
        """Forget the newest change: it was taken back, or never made."""
        del self._records[-1:]
        self._save()

    def _load(self) -> list[dict[str, dict[str, dict[str, Any]]]]:
        if self._path is None or not self._path.exists():
            return []
        try:
            records = orjson.loads(self._path.read_bytes())
            return [dict(record) for record in records]
        except (OSError, ValueError, TypeError) as error:
            _log.warning("%s: earlier changes of modules cannot be undone: %s", self._path, error)
            return []

    def _save(self) -> None:
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            beside = self._path.with_suffix(".new")
            beside.write_bytes(orjson.dumps(self._records, option=orjson.OPT_INDENT_2))
            beside.replace(self._path)
        except OSError as error:
            _log.warning(
                "%s: changes of modules can be undone in this run only: %s", self._path, error.strerror
            )
            self._path = None
