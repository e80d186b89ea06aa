"""A recording through the whole pipeline, without links or broker."""

from __future__ import annotations

from typing import Any

import numpy as np

from devices.emulators.recordings import Recording, play
from devices.link import Chunk, Framing
from gateway.assembly import AssemblyParams
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction import create_reconstructor
from gateway.stream import ClockMode

LINK = "recording"


class _Recorder:
    """Stands in for a reconstructor and keeps what it is given."""

    def __init__(self) -> None:
        self.imu_frames: list[ImuFrame] = []

    def update(self, observation: ImuFrame) -> None:
        """Keep it."""
        self.imu_frames.append(observation)


def imu_frames(recording: Recording, suit: WornSuit) -> list[ImuFrame]:
    """Assembled frames, to be given to several reconstructors."""
    recorder = _Recorder()
    _play(recording, suit, recorder)
    return recorder.imu_frames


def solve(recording: Recording, suit: WornSuit, reconstructor: str) -> list[SkeletonFrame]:
    """Skeleton frames at the recording's sampling rate; its modules' clocks are taken as one."""
    return _play(recording, suit, create_reconstructor(reconstructor, suit, 1.0 / recording.sampling_rate_hz))


def _play(recording: Recording, suit: WornSuit, reconstructor: Any) -> list[SkeletonFrame]:
    params = AssemblyParams(1e9 / recording.sampling_rate_hz, 5 * 10**9, 10**8, 5 * 10**9)
    pipeline = Pipeline(suit, params, "independent", ClockMode.SHARED)
    pipeline.reconstructor = reconstructor
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    frames: list[SkeletonFrame] = []
    for sent in play(recording):
        frames += pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), LINK))
    return frames


def orientations(frames: list[SkeletonFrame], first_s: float) -> tuple[FloatArray, FloatArray]:
    """Times (T,) on the recording's clock, given that of the first frame, and ``q_wb`` (T, S, 4)."""
    times_ns = np.array([frame.time_ns for frame in frames])
    return first_s + (times_ns - times_ns[0]) * 1e-9, np.stack([frame.q_wb for frame in frames])
