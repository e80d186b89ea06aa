"""A recording through the whole pipeline, without links or broker."""

from __future__ import annotations

import numpy as np

from devices.emulators.recordings import Recording, play
from devices.link import Chunk, Framing
from gateway.assembly import AssemblyParams
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.stream import ClockMode

LINK = "recording"


def solve(recording: Recording, suit: WornSuit, reconstructor: str) -> list[SkeletonFrame]:
    """Skeleton frames at the recording's sampling rate; its modules' clocks are taken as one."""
    params = AssemblyParams(1e9 / recording.sampling_rate_hz, 5 * 10**9, 10**8, 5 * 10**9)
    pipeline = Pipeline(suit, params, reconstructor, ClockMode.SHARED)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    frames: list[SkeletonFrame] = []
    for sent in play(recording):
        frames += pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), LINK))
    return frames


def orientations(frames: list[SkeletonFrame], first_s: float) -> tuple[FloatArray, FloatArray]:
    """Times (T,) on the recording's clock, given that of the first frame, and ``q_wb`` (T, S, 4)."""
    times_ns = np.array([frame.time_ns for frame in frames])
    return first_s + (times_ns - times_ns[0]) * 1e-9, np.stack([frame.q_wb for frame in frames])
