"""The golden set: short recordings of every kind of source, and the poses that each method made of them.

    captures/NAME.mcap            bytes of the links, suit and configuration; kept as they are for ever
    poses/NAME.METHOD.mcap        what a method made of them, on which kind of machine

A ``Case`` is a recording with a method.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from devices.link import Chunk, SentChunk
from gateway.frames import MarkerFrame, SkeletonFrame
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.published_trial import published_trial
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.weights import weights_of
from gateway.reconstruction.video.offline import reconstruct_recorded
from gateway.reconstruction.video.tracker import VideoOptions
from gateway.recording import Recording, open_recording
from gateway.recording.solving import recorded_setup, recording_pipeline, solve
from gateway.sources.heat_maps import heat_map_frame
from gateway.sources.markers import MarkerFrames
from tests.golden.poses import PoseMessages, messages_of

FOLDER = Path(__file__).parent
SMOOTHED = "_smoothed"
"""Added to the name of a method that goes forward and backward."""
DELAY = re.compile(r"_(\d+)ms$")
"""Added to the name of one whose poses come so much later."""

METHODS = {
    "serial": (
        "independent", "articulated", "joint", "outward", "joint_smoothed", "outward_smoothed", "gyro_free",
        "gyro_free_100ms", "gyro_free_200ms", "gyro_free_500ms",
    ),
    "can": ("independent", "joint"),
    "relay": ("joint",),
    "trigger": ("independent", "joint"),
    "devices": ("joint", "outward"),
    "walking": ("independent", "joint"),
    "fused": ("fused", "fused_neutral"),
    "gnss_nmea": ("articulated", "joint"),
    "gnss_ubx": ("joint",),
    "light": ("independent", "joint"),
    "light_and_field": ("joint_smoothed",),
    "hips": ("joint",),
    "ximu3": ("independent", "joint"),
    "synchronised": ("joint",),
    "makers": ("joint",),
    "unstamped": ("joint",),
    "fused_elsewhere": ("fused",),
    "slimevr": ("joint",),
    "markers": ("optical", "both_ways"),
    "few_markers": ("optical", "published"),
    "heat_maps": ("video", "video_offline"),
}  # fmt: skip
"""By recording, what its poses are made with."""


@dataclass(frozen=True)
class Case:
    """A recording and a method."""

    recording: str
    method: str
    folder: Path = FOLDER

    def __str__(self) -> str:
        return f"{self.recording}.{self.method}"

    @property
    def recording_path(self) -> Path:
        return self.folder / "captures" / f"{self.recording}.mcap"

    @property
    def poses_path(self) -> Path:
        return self.folder / "poses" / f"{self}.mcap"

    def solved(self) -> list[PoseMessages]:
        """The poses, made now."""
        make = OTHERS.get(self.method, partial(_solved, method=self.method))
        return messages_of(make(open_recording(self.recording_path)))


def cases(folder: Path = FOLDER) -> list[Case]:
    """All of them."""
    return [Case(recording, method, folder) for recording, methods in METHODS.items() for method in methods]


def fed_live(recording: Recording) -> Iterator[SkeletonFrame]:
    """The poses as a running gateway makes them, chunk by chunk, with the method of the recording."""
    pipeline = recording_pipeline(recording, recorded_setup(recording))
    for item in recording.inputs():
        if isinstance(item, Chunk):
            yield from pipeline.feed(item)
        elif isinstance(item, SentChunk):
            pipeline.sent(item)
        else:
            pipeline.event(item.name, item.data)


def _solved(recording: Recording, method: str) -> Iterator[SkeletonFrame]:
    """By a method that a configuration can name."""
    setup = recorded_setup(recording)
    delay = DELAY.search(method)
    name = DELAY.sub("", method.removesuffix(SMOOTHED))
    delay_ms = 0.0 if delay is None else float(delay[1])
    settings = setup.settings.model_copy(update={"reconstructor": name, "reconstructor_delay_ms": delay_ms})
    return solve(recording, replace(setup, settings=settings, smoothed=method.endswith(SMOOTHED)))


def _marker_frames(recording: Recording) -> list[MarkerFrame]:
    assert recording.meta.suit.markers is not None
    receiver = MarkerFrames(recording.meta.suit.markers)
    return [frame for chunk in recording.chunks() for frame in receiver.receive(chunk)]


def _both_ways(recording: Recording) -> list[SkeletonFrame]:
    suit = recording.meta.suit
    assert suit.markers is not None
    return solve_both_ways(suit.skeleton, suit.markers, _marker_frames(recording))[0]


def _published(recording: Recording) -> Iterator[SkeletonFrame]:
    suit, seen = recording.meta.suit, _marker_frames(recording)
    assert suit.markers is not None
    positions = np.stack([frame.positions for frame in seen])
    rate_hz = recording.meta.settings.assembly.rate_hz
    trial = published_trial(suit.skeleton, suit.markers, positions, rate_hz)
    return trial.frames([frame.time_ns for frame in seen])


def _video_offline(recording: Recording) -> list[SkeletonFrame]:
    suit = recording.meta.suit
    assert suit.video is not None
    assert suit.markers is not None
    keypoints = load_keypoint_set(weights_of(suit.video.network).keypoint_set)
    keypoints = replace(keypoints, skeleton=suit.skeleton, markers=suit.markers)
    messages = [chunk.data for chunk in recording.chunks()]
    n = len(suit.video.cameras)
    observed = [heat_map_frame(k // n, messages[k : k + n]) for k in range(0, len(messages), n)]
    return reconstruct_recorded(suit.video.cameras, keypoints, observed, VideoOptions(is_measured=True))


OTHERS: dict[str, Callable[[Recording], Iterator[SkeletonFrame] | list[SkeletonFrame]]] = {
    "both_ways": _both_ways,
    "published": _published,
    "video": solve,
    "video_offline": _video_offline,
}
"""Methods that no configuration names."""
