"""Heat maps of synchronised cameras solved into a recording, which replays and exports like any other."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from devices import recording_format as fmt
from devices.cameras.heat_map_messages import retimed
from devices.link import Chunk
from devices.recording_writer import DerivedRecordingWriter
from gateway.body.camera import Camera, entry_of
from gateway.body.skeleton import VideoSetUp, WornSuit
from gateway.body.subject_file import subject_content
from gateway.errors import GatewayError
from gateway.frames import HeatMapFrame, Status
from gateway.pipeline import Pipeline
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.low_pass import DELAY
from gateway.reconstruction.video.networks.weights import keypoint_set_of
from gateway.reconstruction.video.offline import reconstruct_recorded
from gateway.reconstruction.video.reconstructor import VideoPose, VideoReconstructor, worn_person
from gateway.reconstruction.video.tracker import VideoOptions
from gateway.recording.imported import add_solved, imported_session, solve_into, solved_settings
from gateway.recording.reading import Progress
from gateway.recording.snapshot import attachments_of, body_of
from gateway.settings import GatewaySettings
from gateway.sources.heat_maps import heat_map_frame
from gateway.sources.link_settings import LinkSettings
from gateway.stages.cameras import CameraStage

LINK = "cameras"
CARRIES = "heat_maps"
OFFLINE = "offline"
"""The method that goes through all instants forwards and backwards."""
_BEGUN_NS = 10**9
"""Gateway time that a capture begins at."""
_SIZING_FRAMES = 40


@dataclass(frozen=True)
class SolvedVideo:
    """What came of it."""

    path: Path
    frames: int
    keypoints: tuple[str, ...]
    poses: tuple[VideoPose, ...]
    """Of every instant, before smoothing."""
    counts: dict[str, object]
    ms_per_frame: float
    """Processor time of all that follows the heat maps."""


def video_settings(subject: str, rate_hz: float, name: str = "video") -> GatewaySettings:
    """Return a configuration that solves the heat maps of one link."""
    link = LinkSettings(name=LINK, url="tcp://localhost:9765", carries=CARRIES)
    return solved_settings(subject, rate_hz, link, name)


def video_suit(
    cameras: Sequence[Camera],
    network: str,
    messages: Sequence[Sequence[bytes]],
    known: WornSuit | None = None,
) -> WornSuit:
    """Return the person that the first instants show, with the cameras. Raises ``GatewayError``.

    It is raised when nobody is found, or ``known`` has other keypoints.

    messages: of every instant, one per camera; known: a person whose lengths are known already.
    """
    video = VideoSetUp(tuple(cameras), network)
    if known is not None:
        wanted = load_keypoint_set(keypoint_set_of(network)).names
        if known.markers is None or known.markers.labels != wanted:
            raise GatewayError(
                f"--subject has no keypoints of the network '{network}': fit one with --fit-subject"
            )
        return replace(known, video=video)
    keypoints = load_keypoint_set(keypoint_set_of(network))
    reconstructor = VideoReconstructor(cameras, keypoints)
    # A few instants suffice for the lengths of bones, which do not change.
    found = 0
    for sequence, instant in enumerate(messages):
        pose = reconstructor.update(heat_map_frame(sequence, instant))
        found += bool(np.isfinite(pose.keypoints).all())
        if found >= _SIZING_FRAMES:
            break
    if not found:
        raise GatewayError(
            f"in {len(messages)} pictures of {len(cameras)} cameras nobody is seen by rays that meet: does "
            "the calibration belong to these cameras, in this order, and are they synchronised?"
        )
    return worn_person(reconstructor.person, video)


def video_subject(name: str, suit: WornSuit) -> dict[str, Any]:
    """Return the content of a subject file: person, keypoints, network and cameras."""
    assert suit.markers is not None
    assert suit.video is not None
    content = subject_content(
        name, keypoint_set_of(suit.video.network), body_of(suit.skeleton), suit.skeleton,
        suit.markers, {}, {},
    )  # fmt: skip
    cameras = suit.video.cameras
    video: dict[str, Any] = {"network": suit.video.network, "cameras": [entry_of(each) for each in cameras]}
    if suit.video.pairs:
        video["joined"] = [[cameras[a].name, cameras[b].name] for a, b in suit.video.pairs]
    return {**content, "video": video}


def write_solved_video(
    messages: Sequence[Sequence[bytes]],
    rate_hz: float,
    suit: WornSuit,
    subject: str,
    target: Path,
    progress: Progress | None = None,
) -> SolvedVideo:
    """Solve every instant, and write poses and input to ``target``.

    Raises ``RecordingError`` when that exists, ``OSError`` as ``open`` does.
    """
    assert suit.video is not None
    assert suit.markers is not None
    settings = video_settings(subject, rate_hz)
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link(LINK, CARRIES)
    stage = pipeline.stage_of(HeatMapFrame)
    assert isinstance(stage, CameraStage)
    poses: list[VideoPose] = []

    def note(index: int) -> None:
        if stage.last is not None and index < len(messages):
            poses.append(stage.last)

    chunks = video_chunks(messages, rate_hz)
    with DerivedRecordingWriter(
        target, _session(target), attachments_of(settings, suit), _BEGUN_NS
    ) as writer:
        frames, spent = solve_into(writer, pipeline, chunks, CARRIES, note, progress)
        writer.add(fmt.STATISTICS, chunks[-1].arrived_ns, json.dumps(pipeline.statistics()).encode())
    return SolvedVideo(
        target, frames, suit.markers.labels, tuple(poses), pipeline.statistics()["video"],
        1e3 * spent / max(len(chunks), 1),
    )  # fmt: skip


def write_offline_video(
    messages: Sequence[Sequence[bytes]],
    rate_hz: float,
    suit: WornSuit,
    subject: str,
    target: Path,
    progress: Progress | None = None,
) -> SolvedVideo:
    """Write a recording with poses from tracking forwards and backwards; raises as ``write_solved_video``.

    What was hidden for a while is recovered from later instants.
    """
    assert suit.video is not None
    assert suit.markers is not None
    keypoints = load_keypoint_set(keypoint_set_of(suit.video.network))
    # The network's keypoints on the body that was fitted to this person.
    keypoints = replace(keypoints, skeleton=suit.skeleton, markers=suit.markers)
    done = itertools.count(1)

    def advanced() -> None:
        if progress is not None:
            progress(next(done), 2 * len(messages))

    observed = [heat_map_frame(index, instant) for index, instant in enumerate(messages)]
    began = time.process_time()
    frames = reconstruct_recorded(
        suit.video.cameras, keypoints, observed, VideoOptions(is_measured=True), advanced
    )
    spent = time.process_time() - began
    shown = [index for index, each in enumerate(observed) if any(maps is not None for maps in each.cameras)]
    there = range(shown[0], shown[-1] + 1) if shown else range(0)
    chunks = video_chunks(messages, rate_hz)[: len(messages)]
    attachments = attachments_of(video_settings(subject, rate_hz), suit)
    with DerivedRecordingWriter(target, _session(target, OFFLINE), attachments, _BEGUN_NS) as writer:
        for index, (chunk, frame) in enumerate(zip(chunks, frames, strict=True)):
            # Tracking backwards would hold the first pose of somebody who was not there yet.
            is_known = index in there and bool((frame.status != Status.MISSING).any())
            add_solved(writer, chunk, CARRIES, [replace(frame, time_ns=chunk.arrived_ns)] if is_known else [])
    return SolvedVideo(target, len(frames), suit.markers.labels, (), {}, 1e3 * spent / max(len(frames), 1))


def _session(target: Path, solved_by: str = "") -> dict[str, str]:
    return imported_session({LINK: CARRIES}, target, "video", _BEGUN_NS, solved_by=solved_by)


def video_chunks(messages: Sequence[Sequence[bytes]], rate_hz: float) -> list[Chunk]:
    """Return a chunk for every instant.

    The last instant is repeated: smoothing is late by ``DELAY`` frames, and so still gives the last pose.
    """
    instants = [b"".join(instant) for instant in messages]
    chunks = [
        Chunk(data, _BEGUN_NS + round(index * 1e9 / rate_hz), LINK) for index, data in enumerate(instants)
    ]
    for late in range(DELAY):
        index = len(messages) + late
        time_ns = round(index * 1e9 / rate_hz)
        repeated = b"".join(retimed(message, index, time_ns) for message in messages[-1])
        chunks.append(Chunk(repeated, _BEGUN_NS + time_ns, LINK))
    return chunks
