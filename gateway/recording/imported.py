"""What a recording says of itself when it was made from files that another system wrote."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gateway
from devices.recording_writer import session_record


def imported_session(
    links: Mapping[str, str],
    target: Path,
    imported_from: str,
    begun_ns: int,
    begun_utc_ns: int = 0,
    solved_by: str = "",
) -> dict[str, str]:
    """The metadata record of ``target``.

    imported_from: kind of source; begun_utc_ns: 0 where the date is not known; solved_by: a method that the
    configuration does not name.
    """
    record = session_record(
        links,
        session=uuid.uuid4().hex,
        software=gateway.__version__,
        begun_ns=str(begun_ns),
        begun_utc_ns=str(begun_utc_ns),
        from_start="1",
        name=target.stem,
        imported_from=imported_from,
    )
    return record | ({"solved_by": solved_by} if solved_by else {})


def origin_event(kind: str, sources: Iterable[Path], time_ns: int, **more: Any) -> bytes:
    """The event that tells which files, with their checksums, it all came from. Raises OSError."""
    files = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sources
    }
    data = {"format": kind, "files": files, **more}
    return json.dumps({"time_ns": time_ns, "name": "imported", "data": data}).encode()
