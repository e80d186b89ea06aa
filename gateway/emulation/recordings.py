"""Recordings with a reference through the whole pipeline, without links or broker, and their errors.

One rule for every method and recording: each segment's estimate is given one constant heading and one
constant sensor-to-segment rotation (the reference's world has its own heading, and markers sit askew on
modules), so that only the varying error counts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from devices.deferred import Rotation
from devices.emulators.data_sets import METAL_TABLE_S
from devices.emulators.playback import play
from devices.link import Chunk, Framing
from devices.recorded_tracks import RecordedTracks, ReferenceTrack
from gateway.agreement.world_alignment import align_world, aligned
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.geometry.comparison import coverage_percent, orientation_error, rmse_deg
from gateway.pipeline import Pipeline
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.reconstructor import update_many
from gateway.reconstruction.smoothing import Smoother
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

LINK = "recording"
SMOOTHED = "joint, smoothed"
LONGEST_GAP_S = 0.05
_PEER, _OURS = "independent", "joint"
SCORED_AFTER_S = 2.0
"""Of a part that begins in motion; a whole recording is scored from where it leaves the metal table."""


class _Recorder:
    """Stands in for a reconstructor and keeps what it is given."""

    def __init__(self) -> None:
        self.imu_frames: list[ImuFrame] = []

    def update(self, observation: ImuFrame) -> None:
        """Keep it."""
        self.imu_frames.append(observation)


def imu_frames(recording: RecordedTracks, suit: WornSuit) -> list[ImuFrame]:
    """Return assembled frames, to be given to several reconstructors."""
    recorder = _Recorder()
    _play(recording, suit, recorder)
    return recorder.imu_frames


def solve(recording: RecordedTracks, suit: WornSuit, reconstructor: str) -> list[SkeletonFrame]:
    """Return skeleton frames at the recording's sampling rate; its modules' clocks are taken as one."""
    return _play(recording, suit, create_reconstructor(reconstructor, suit, 1.0 / recording.sampling_rate_hz))


def _play(recording: RecordedTracks, suit: WornSuit, reconstructor: Any) -> list[SkeletonFrame]:
    params = AssemblyParams(1e9 / recording.sampling_rate_hz, 5 * 10**9, 10**8, 5 * 10**9)
    pipeline = Pipeline(suit, params, "independent", ClockMode.SHARED)
    pipeline.module_stage.reconstructor = reconstructor
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    frames: list[SkeletonFrame] = []
    for sent in play(recording):
        frames += pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), LINK))
    return frames


def solved(
    method: str, suit: WornSuit, nominal_interval_s: float, frames: Sequence[ImuFrame]
) -> list[SkeletonFrame]:
    """Return all frames by a reconstructor of that name, or by ``joint, smoothed``: forward and backward."""
    if method != SMOOTHED:
        return update_many(create_reconstructor(method, suit, nominal_interval_s), frames)
    with tempfile.TemporaryDirectory() as folder:
        smoother = Smoother(create_reconstructor("joint", suit, nominal_interval_s), Path(folder))
        smoother.add(frames)
        return list(smoother.smoothed())


def orientations(frames: list[SkeletonFrame], first_s: float) -> tuple[FloatArray, FloatArray]:
    """Return times (T,) on the recording's clock, given that of the first frame, and ``q_wb`` (T, S, 4)."""
    times_ns = np.array([frame.time_ns for frame in frames])
    return first_s + (times_ns - times_ns[0]) * 1e-9, np.stack([frame.q_wb for frame in frames])


class Score(NamedTuple):
    """RMSE by segment, degrees."""

    total: FloatArray
    tilt: FloatArray
    covered: FloatArray
    """Percent of the errors that lie within twice the ``sigma`` that came with them; NaN without."""

    def __str__(self) -> str:
        rows = zip(self.total, self.tilt, strict=True)
        cells = "  ".join(f"{total:.6f}/{tilt:.6f}" for total, tilt in rows)
        return f"total/tilt RMSE in degrees by segment: {cells}"


def score(
    times_s: FloatArray,
    q_wb: FloatArray,
    recording: RecordedTracks,
    from_s: float = 0.0,
    sigma: FloatArray | None = None,
) -> Score:
    """Return errors of orientations (T, S, 4) at times (T,), in the order of the recording's references.

    sigma: (T, S) rad, what the estimator says of itself.
    """
    claimed = np.full(q_wb.shape[:2], np.nan) if sigma is None else sigma
    errors = [
        _segment_errors(times_s, q_wb[:, i], claimed[:, i], reference, from_s)
        for i, reference in enumerate(recording.references)
    ]
    return Score(*(np.array(column) for column in zip(*errors, strict=True)))


def _segment_errors(
    times_s: FloatArray, q_wb: FloatArray, sigma: FloatArray, reference: ReferenceTrack, from_s: float
) -> tuple[float, float, float]:
    q_ref = reference_at(times_s, reference)
    usable = np.isfinite(q_ref).all(axis=1) & np.isfinite(q_wb).all(axis=1) & (times_s >= from_s)
    errors = orientation_error(align(q_wb[usable], q_ref[usable]), q_ref[usable])
    covered = coverage_percent(errors.total, sigma[usable])
    return float(rmse_deg(errors.total)), float(rmse_deg(errors.inclination)), covered


def reference_at(times_s: FloatArray, reference: ReferenceTrack) -> FloatArray:
    """Return (T, 4): spherical interpolation of the reference; NaN where its neighbours are too far."""
    known = np.isfinite(reference.q_wb).all(axis=1)
    times, q = reference.times[known], reference.q_wb[known]
    after = np.clip(np.searchsorted(times, times_s), 1, len(times) - 1)
    t0, t1 = times[after - 1], times[after]
    first, second = (Rotation.from_quat(q[i], scalar_first=True) for i in (after - 1, after))
    weight = np.clip((times_s - t0) / (t1 - t0), 0.0, 1.0)
    step = (first.inv() * second).as_rotvec() * weight[:, None]
    result: FloatArray = (first * Rotation.from_rotvec(step)).as_quat(scalar_first=True)
    outside = (times_s < times[0]) | (times_s > times[-1]) | (t1 - t0 > LONGEST_GAP_S)
    result[outside] = np.nan
    return result


def align(q: FloatArray, q_ref: FloatArray) -> FloatArray:
    """Return ``q`` (T, 4) after the constant heading and misalignment that bring it closest to ``q_ref``."""
    found = align_world(q[:, None], q_ref[:, None])
    return aligned(q[:, None], found)[:, 0]


class Excerpt(NamedTuple):
    """What is cut from a recording."""

    kind: str
    begins: float  # share of the recording left out
    every: int = 1  # sample taken
    shakes: float = 0.0  # m/s²


def totals(recording: RecordedTracks, frames: list[ImuFrame], part: Excerpt) -> tuple[float, float]:
    """Return the mean error of the segments, °: VQF's and ours; ``frames`` are of the whole recording."""
    begun_s = max(float(track.times[0]) for track in recording.modules)
    taken = _cut(frames, part)
    begins_s = begun_s + (taken[0].time_ns - frames[0].time_ns) * 1e-9
    from_s = max(METAL_TABLE_S, begins_s + SCORED_AFTER_S) if part.begins else METAL_TABLE_S
    peer, ours = (_total(method, taken, begins_s, from_s, recording) for method in (_PEER, _OURS))
    return peer, ours


def _cut(frames: list[ImuFrame], part: Excerpt) -> list[ImuFrame]:
    rng = np.random.default_rng(1)
    taken = frames[int(part.begins * len(frames)) :: part.every]
    return [
        replace(
            frame,
            sequence=k,
            specific_force=frame.specific_force
            + part.shakes * rng.standard_normal(frame.specific_force.shape),
        )
        for k, frame in enumerate(taken)
    ]


def _total(
    method: str, frames: list[ImuFrame], begins_s: float, from_s: float, recording: RecordedTracks
) -> float:
    interval_s = (frames[1].time_ns - frames[0].time_ns) * 1e-9
    times_s, q_wb = orientations(solved(method, load_rig("chain_5"), interval_s, frames), begins_s)
    return float(score(times_s, q_wb, recording, from_s).total.mean())
