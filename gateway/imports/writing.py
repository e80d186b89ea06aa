"""An imported recording through the pipeline, into a file that replays bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from devices import recording_format as fmt
from devices.emulators.playback import play
from devices.link import Chunk, Framing
from devices.recorded_tracks import RecordedTracks
from devices.recording_writer import DerivedRecordingWriter, RecordingWriter
from gateway.body.skeleton import WornSuit
from gateway.contract.ros_messages import BodyTransforms
from gateway.frames import SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction import FUSED
from gateway.recording.arrays import SkeletonArrays, arrays_of
from gateway.recording.imported import imported_session, origin_event
from gateway.recording.pose_encoding import encode_skeleton_frame
from gateway.recording.reading import Progress
from gateway.recording.snapshot import attachments_of
from gateway.settings import AssemblySettings, ClockSettings, GatewaySettings
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings

LINK = "imported"
_FIRST_NS = 10**9
"""Gateway time at the beginning of a recording whose date is not known."""
_STATISTICS_NS = 5 * 10**9
_CHUNKS_A_REPORT = 256
_LONGEST_WAIT_MS = 500.0


@dataclass(frozen=True)
class Imported:
    """What came of it."""

    path: Path
    modules: int
    chunks: int
    poses: int
    seconds: float


def settings_of(recording: RecordedTracks, rig: str, reconstructor: str | None = None) -> GatewaySettings:
    """Return a configuration for it: one clock, frames as often as samples.

    reconstructor: None for the modules' own orientations where there are no angular rates to fuse.
    """
    if reconstructor is None:
        raw = {track.module for track in recording.modules if "angular_rate" in track.sensors}
        reconstructor = "independent" if raw >= set(recording.module_ids) else "fused"
    return GatewaySettings(
        gateway="imported",
        links=[LinkSettings(name=LINK, url=f"recording:///{recording.name}")],
        rig=rig,
        reconstructor=reconstructor,
        clock=ClockSettings(mode=ClockMode.SHARED, sync_rate_hz=0),
        assembly=AssemblySettings(rate_hz=recording.sampling_rate_hz, max_wait_ms=_LONGEST_WAIT_MS),
    )


def chunks_of(recording: RecordedTracks) -> Iterator[Chunk]:
    """Yield what a link would have given: the packets of one instant together, at that instant."""
    begun_ns = recording.begun_utc_ns or _FIRST_NS
    for time_s, sent in groupby(play(recording), key=lambda each: each.time_s):
        yield Chunk(b"".join(each.data for each in sent), begun_ns + round(time_s * 1e9), LINK)


def solved(recording: RecordedTracks, suit: WornSuit, settings: GatewaySettings) -> SkeletonArrays | None:
    """Return its poses, without writing anything; None when there are none."""
    frames = _pipeline(settings, suit).replay(chunks_of(recording))
    return arrays_of(frames, suit.skeleton)


def write_imported(
    recording: RecordedTracks,
    suit: WornSuit,
    settings: GatewaySettings,
    sources: list[Path],
    target: Path,
    progress: Progress | None = None,
) -> Imported:
    """Write chunks, poses, statistics and where they came from, as ``target``.

    Raises ``RecordingError`` when that exists, OSError as ``open`` does.
    """
    begun_ns = recording.begun_utc_ns or _FIRST_NS
    end_ns = begun_ns + round(recording.duration_s * 1e9)
    session = imported_session(
        {LINK: Framing.BYTE_STREAM}, target, recording.name, begun_ns, recording.begun_utc_ns
    )
    more = {"modules": recording.names, "notes": recording.notes}
    pipeline = _pipeline(settings, suit)
    transforms = BodyTransforms(suit.skeleton)
    chunks = poses = 0
    counted_ns = begun_ns
    with DerivedRecordingWriter(target, session, attachments_of(settings, suit), begun_ns) as writer:
        writer.add(fmt.EVENTS, begun_ns, origin_event(recording.name, sources, begun_ns, **more))
        for chunk in chunks_of(recording):
            writer.add_chunk(chunk, Framing.BYTE_STREAM)
            frames = pipeline.feed(chunk)
            _add_poses(writer, transforms, frames, chunk.arrived_ns)
            chunks, poses = chunks + 1, poses + len(frames)
            if chunk.arrived_ns - counted_ns >= _STATISTICS_NS:
                counted_ns = chunk.arrived_ns
                _add_statistics(writer, pipeline, counted_ns)
            if progress is not None and chunks % _CHUNKS_A_REPORT == 0:
                writer.flush()
                progress(chunk.arrived_ns - begun_ns, end_ns - begun_ns)
        _add_statistics(writer, pipeline, end_ns)
    return Imported(target, len(recording.module_ids), chunks, poses, recording.duration_s)


def is_fused(settings: GatewaySettings) -> bool:
    """Return whether the poses rest on the modules' own orientations."""
    return settings.reconstructor in FUSED


def _pipeline(settings: GatewaySettings, suit: WornSuit) -> Pipeline:
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    return pipeline


def _add_poses(
    writer: RecordingWriter, transforms: BodyTransforms, frames: list[SkeletonFrame], time_ns: int
) -> None:
    """Write poses, and beside them what viewers show."""
    for frame in frames:
        writer.add(fmt.SKELETON, time_ns, encode_skeleton_frame(frame))
        writer.add(fmt.TRANSFORMS, time_ns, transforms.encode(frame.time_ns, frame.q_wb, frame.p_w))


def _add_statistics(writer: RecordingWriter, pipeline: Pipeline, time_ns: int) -> None:
    writer.add(fmt.STATISTICS, time_ns, json.dumps(pipeline.statistics()).encode())
