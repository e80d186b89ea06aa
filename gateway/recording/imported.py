"""Recordings made from what another system wrote, by files or by cameras."""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gateway
from devices.link import Chunk
from devices.recording_writer import RecordingWriter, session_record
from gateway.frames import SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction import OPTICAL
from gateway.recording.pose_encoding import frame_messages
from gateway.recording.reading import Progress
from gateway.settings import AssemblySettings, GatewaySettings
from gateway.sources.link_settings import LinkSettings

_CHUNKS_A_REPORT = 16


def imported_session(
    links: Mapping[str, str],
    target: Path,
    imported_from: str,
    begun_ns: int,
    begun_utc_ns: int = 0,
    solved_by: str = "",
) -> dict[str, str]:
    """Return the metadata record of ``target``.

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


def solved_settings(subject: str, rate_hz: float, link: LinkSettings, name: str) -> GatewaySettings:
    """Return a configuration that solves what the markers or cameras of one link show of a subject."""
    return GatewaySettings(
        gateway=name,
        links=[link],
        rig=subject,
        reconstructor=OPTICAL,
        assembly=AssemblySettings(rate_hz=rate_hz),
    )


def add_solved(writer: RecordingWriter, chunk: Chunk, content: str, frames: Iterable[SkeletonFrame]) -> None:
    """Write a chunk of a link that carries ``content``, and the poses made of it."""
    writer.add_chunk(chunk, content)
    for frame in frames:
        for topic, message in frame_messages(frame):
            writer.add(topic, chunk.arrived_ns, message)


def solve_into(
    writer: RecordingWriter,
    pipeline: Pipeline,
    chunks: Sequence[Chunk],
    content: str,
    solved: Callable[[int], None],
    progress: Progress | None = None,
) -> tuple[int, float]:
    """Write chunks and the poses that a pipeline makes of them, and its statistics at the end.

    solved: called with the number of every chunk after it. Returns how many poses, and processor time in s.
    """
    frames, spent = 0, 0.0
    for index, chunk in enumerate(chunks):
        # Processor time, not wall time: what the disk takes is not the method's.
        began = time.process_time()
        made = pipeline.feed(chunk)
        spent += time.process_time() - began
        add_solved(writer, chunk, content, made)
        frames += len(made)
        solved(index)
        if progress is not None and index % _CHUNKS_A_REPORT == 0:
            progress(index, len(chunks))
    return frames, spent


def origin_event(kind: str, sources: Iterable[Path], time_ns: int, **more: Any) -> bytes:
    """Return the event that names the files, with their checksums, that it all came from. Raises OSError."""
    files = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sources
    }
    data = {"format": kind, "files": files, **more}
    return json.dumps({"time_ns": time_ns, "name": "imported", "data": data}).encode()
