"""What a batch has done already: one line of JSON a recording, appended as each is finished."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from gateway.batch.job import Job, JobResult
from gateway.support.whole_files import writing

NAME = "manifest.jsonl"


class Manifest:
    """The file in the folder of the results. A line cut off by a power cut is passed over."""

    def __init__(self, folder: Path) -> None:
        """Open the manifest of a folder. Raises ``GatewayError`` when the folder cannot be written."""
        self.path = folder / NAME
        self._entries: dict[str, dict[str, Any]] = {}
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            text = self.path.read_text(encoding="utf-8") if self.path.exists() else ""
            self._file = self.path.open("a", encoding="utf-8")
        # A batch that was killed may have left half a line: what is appended must not join it.
        if text and not text.endswith("\n"):
            self._file.write("\n")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._entries[str(entry["name"])] = entry
            except (ValueError, KeyError, TypeError):
                continue

    def is_done(self, job: Job) -> bool:
        """Return whether the same was made of the same recording, and is still there."""
        entry = self._entries.get(job.name)
        if entry is None or entry.get("error") or entry.get("task") != job.task.key:
            return False
        return _is_same(job.source, entry.get("source", {})) and all(
            _size(job.folder / name) == size for name, size in entry.get("outputs", {}).items()
        )

    def add(self, job: Job, outcome: JobResult) -> None:
        """Remember a finished job, on the disk when this returns."""
        entry = {
            "name": job.name,
            "task": job.task.key,
            "source": {} if outcome.error else _identity(job.source),
            "outputs": outcome.outputs,
            "seconds": round(outcome.seconds, 3),
            "error": outcome.error,
        }
        self._entries[job.name] = entry
        self._file.write(json.dumps(entry, ensure_ascii=False) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file: nothing more will be added."""
        self._file.close()


def _identity(path: Path) -> dict[str, Any]:
    status = path.stat()
    return {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns, "sha256": _hash(path)}


def _is_same(path: Path, known: dict[str, Any]) -> bool:
    """Return whether a file is the same by size and time; if only the time differs (a copy), by content."""
    status = path.stat()
    if status.st_size != known.get("bytes"):
        return False
    return status.st_mtime_ns == known.get("mtime_ns") or _hash(path) == known.get("sha256")


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else -1
