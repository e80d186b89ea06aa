"""The folder of the recordings as requests see it: ``recording/list``, ``export`` and ``read``.

Nothing outside of the folder is reached, and nothing is removed. Exports are made by a process of their own,
so that poses go on meanwhile.
"""

from __future__ import annotations

import asyncio
import base64
import json
import re
import sys
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import SeekingReader

from devices import recording_format as fmt
from devices.recording_file import DAMAGE, LARGEST_RECORD, RecordingError
from gateway.contract.requests import (
    ExportRecordingRequest,
    ListRecordingsRequest,
    ReadRecordingRequest,
    asked,
)
from gateway.errors import GatewayError, nearest
from gateway.frames import SkeletonFrame
from gateway.geometry import quaternion
from gateway.recording.exporters.formats import FORMATS
from gateway.recording.pose_encoding import decode_skeleton_frame
from gateway.recording.reading import Recording
from gateway.recording.summary import recordings_in, summarise
from gateway.settings import RecordingSettings
from gateway.support.names import KEPT_FILE
from gateway.support.whole_files import free_bytes

_UNNAMED = "{name}: a name of up to 128 letters a to z, digits, '-', '_' and '.' is wanted here: rename it"
_LONGEST_QUOTED = 60
"""Letters shown of a name."""
Perform = Callable[[str, Mapping[str, Any]], Awaitable[dict[str, Any]]]
_ENDINGS = frozenset({fmt.SUFFIX, *(each.suffix for each in FORMATS.values())})
_MB = 1e6


class Shelf:
    """Answers at any time, beside whatever is recorded."""

    def __init__(self, settings: RecordingSettings, under_way: Callable[[], Path | None]) -> None:
        """Serve the folder of recordings; ``under_way`` returns the file being written, which is not listed,
        or None.
        """
        self._folder = Path(settings.folder)
        self._under_way = under_way
        self._exporting = asyncio.Lock()
        self._verbs: dict[str, Callable[[Any], Awaitable[dict[str, Any]]]] = {
            "list": self._list,
            "export": self._export,
            "read": self._read,
        }

    def beside(self, others: Perform) -> Perform:
        """Return all verbs of the family: these, and those that ``others`` carries out."""

        async def perform(verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
            if verb not in self._verbs:
                return await others(verb, data)
            return await self._verbs[verb](asked("recording", verb, data))

        return perform

    async def _list(self, request: ListRecordingsRequest) -> dict[str, Any]:
        return await asyncio.to_thread(self._listed, request.most)

    def _listed(self, most: int) -> dict[str, Any]:
        formats = {name: each.meaning for name, each in FORMATS.items()}
        answer: dict[str, Any] = {"folder": str(self._folder), "formats": formats, "recordings": []}
        if not self._folder.is_dir():
            return answer | {"problems": []}
        found = list(recordings_in(self._folder))
        recordings = [each for each in found if isinstance(each, Recording)]
        under_way = self._under_way()
        # The file that is being written has no index yet, and grows while it is read.
        if under_way is not None:
            recordings = [r for r in recordings if under_way not in {file.path for file in r.parts.files}]
        # Names that requests cannot carry are listed, not dropped in silence.
        unnamed = [r for r in recordings if not _can_be_asked_for(r)]
        recordings = [r for r in recordings if _can_be_asked_for(r)]
        recordings.sort(key=lambda each: each.meta.begun_utc_ns, reverse=True)
        answer["recordings"] = [self._summary(recording) for recording in islice(recordings, most)]
        answer["problems"] = [str(each) for each in found if isinstance(each, RecordingError)]
        answer["problems"] += [
            _UNNAMED.format(name=each.parts.path.name[:_LONGEST_QUOTED]) for each in unnamed
        ]
        answer["free_mb"] = round(free_bytes(self._folder) / _MB)
        return answer

    def _summary(self, recording: Recording) -> dict[str, Any]:
        summary, path = summarise(recording), recording.parts.path
        beside = (path.with_suffix(each.suffix) for each in FORMATS.values())
        return {
            "file": path.name,
            "files": [file.path.name for file in recording.parts.files],
            "begun_utc_ns": summary.begun_utc_ns,
            "duration_s": round(summary.duration_s, 2),
            "bytes": summary.bytes,
            "modules": summary.n_modules,
            "loss_percent": summary.loss_percent,
            "poses": summary.messages.get(fmt.SKELETON, 0),
            "defect": summary.defect,
            "exports": sorted(each.name for each in beside if each.is_file()),
            "outline": outline_of(recording),
        }

    async def _export(self, request: ExportRecordingRequest) -> dict[str, Any]:
        if request.to not in FORMATS:
            raise GatewayError(f"there is no format '{request.to}'{nearest(request.to, FORMATS)}")
        path = self._kept(request.file)
        command = ["export", str(path), "--to", request.to, "--force", "--json"]
        async with self._exporting:
            written = json.loads(await _output_of(command))[0]
        return {"file": path.with_suffix(FORMATS[request.to].suffix).name} | {
            key: written[key] for key in ("bytes", "frames", "rate_hz", "seconds", "interpolated")
        }

    async def _read(self, request: ReadRecordingRequest) -> dict[str, Any]:
        path = self._kept(request.file)
        piece, size = await asyncio.to_thread(_piece, path, request.offset, request.length)
        return {"file": path.name, "bytes": size, "data": base64.b64encode(piece).decode()}

    def _kept(self, name: str) -> Path:
        """Return a file of the folder. Raises ``RecordingError`` for anything else."""
        path = self._folder / name
        is_within = path.is_file() and path.resolve().parent == self._folder.resolve()
        if path.suffix not in _ENDINGS or not is_within:
            raise RecordingError(f"there is no recording {name} in {self._folder}: recording/list has them")
        return path


def _can_be_asked_for(recording: Recording) -> bool:
    """Return whether requests can name all its files."""
    return all(re.fullmatch(KEPT_FILE, file.path.name) for file in recording.parts.files)


def outline_of(recording: Recording) -> list[list[float]]:
    """Return the body half-way through, from the front: x, y to x, y of each segment, m; empty where none is
    known.

    x to the body's right, as the reader sees it to the left; y up.
    """
    frame = _half_way(recording)
    if frame is None or not recording.meta.has_suit:
        return []
    skeleton = recording.meta.skeleton
    root = int(np.flatnonzero(skeleton.parents < 0)[0])
    right = quaternion.rotate(frame.q_wb[root], np.array([0.0, 0.0, 1.0]))
    # Level, however the root leans; a root on its side has no horizontal right, hence the bound.
    across = np.array([-right[0], -right[1], 0.0]) / max(float(np.hypot(right[0], right[1])), 1e-6)
    known = np.isfinite(frame.q_wb).all(axis=1) & np.isfinite(frame.p_w).all(axis=1)
    lines = []
    for s in np.flatnonzero(known):
        begin = frame.p_w[s] - frame.p_w[root]
        end = begin + quaternion.rotate(frame.q_wb[s], skeleton.tips[s])
        lines.append([round(float(v), 3) for v in (across @ begin, begin[2], across @ end, end[2])])
    return lines


def _half_way(recording: Recording) -> SkeletonFrame | None:
    """Return a pose from the middle of the first part; None where that has no index, or no poses."""
    with suppress(*DAMAGE, OSError, StopIteration), recording.parts.path.open("rb") as stream:
        reader = SeekingReader(stream, record_size_limit=LARGEST_RECORD)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            return None
        begun, ended = summary.statistics.message_start_time, summary.statistics.message_end_time
        found = reader.iter_messages(fmt.SKELETON, start_time=(begun + ended) // 2)
        return decode_skeleton_frame(next(iter(found))[2].data)
    return None


def _piece(path: Path, offset: int, length: int) -> tuple[bytes, int]:
    """Return bytes from there on, and how many there are in all."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(length), path.stat().st_size
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error


async def _output_of(arguments: list[str]) -> str:
    """Return what a command prints. Raises ``RecordingError`` with its error."""
    # In a process of its own and at low priority: exports must not delay poses.
    command = ["nice", "-n", "10", sys.executable, "-m", "gateway", *arguments]
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    try:
        output, errors = await process.communicate()
    except asyncio.CancelledError:
        process.terminate()
        raise
    if process.returncode:
        raise RecordingError(
            (errors.decode(errors="replace").strip() or "the export failed").splitlines()[-1]
        )
    return output.decode()
