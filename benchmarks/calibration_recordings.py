"""Joint angles of real recordings with our calibration of how modules sit, against the orientations there.

The vendor's orientations are made segments by the N-pose and the direction in which the knees bend, as in
the suite ``joints``; ours by the body calibration: the same pose, and the rest as free movement.
What differs is the reconstruction and the calibration together.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import joint_recordings as vendor
from devices.emulators.data_sets import read_hipose_mtw17
from devices.recorded_tracks import RecordedTracks
from gateway.body.joint_angles import joint_angles
from gateway.body.joints import Joint
from gateway.body.skeleton import WornSuit
from gateway.calibration.body_result import ModuleResult
from gateway.calibration.body_session import BodySession
from gateway.emulation.recordings import imu_frames, orientations, reference_at, solve
from gateway.frames import FloatArray


class CalibratedTrial(NamedTuple):
    """Differences of joint angles from the vendor's."""

    name: str
    what: str
    joints: tuple[Joint, ...]
    ours_deg: FloatArray
    """(n_joints, 3) RMSE."""
    pose_only_deg: FloatArray
    """The same with the N-pose alone, facing east assumed."""
    verdicts: dict[str, str]


def hipose_trial(folder: Path) -> CalibratedTrial:
    """17 modules with magnetometers; N-pose in the first five seconds."""
    what = "17 modules, N-pose and free movement; against the vendor's orientations (not a truth)"
    return _trial(read_hipose_mtw17(folder), (1.0, 4.0), what)


def _trial(recording: RecordedTracks, still: tuple[float, float], what: str) -> CalibratedTrial:
    suit = vendor.dressed(recording)
    frames = imu_frames(recording, suit)
    begin_s = max(float(track.times[0]) for track in recording.modules)
    at_ns = frames[0].time_ns - round(begin_s * 1e9)
    session = BodySession(suit)
    for frame in frames:
        session.add(frame)
    session.mark("n_pose", at_ns + round(still[0] * 1e9), at_ns + round(still[1] * 1e9))
    session.mark("free", at_ns + round(still[1] * 1e9), frames[-1].time_ns)
    result = session.result()
    reference, is_after = _reference(recording, suit, still)
    ours = _angles(recording, _worn_as(suit, result.accepted(with_poor=True)))
    session.spans = {key: span for key, span in session.spans.items() if key[0] == "n_pose"}
    pose_only = _worn_as(suit, session.result().accepted(with_poor=True))
    return CalibratedTrial(
        recording.name,
        what,
        suit.skeleton.joints,
        _rmse_deg(ours[is_after], reference[is_after]),
        _rmse_deg(_angles(recording, pose_only)[is_after], reference[is_after]),
        {module.segment: module.quality.verdict for module in result.modules},
    )


def _angles(recording: RecordedTracks, suit: WornSuit) -> FloatArray:
    frames = solve(recording, suit, "independent")
    return joint_angles(suit.skeleton, np.stack([frame.q_wb for frame in frames]))


def _reference(
    recording: RecordedTracks, suit: WornSuit, still: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """The vendor's joint angles (T, n_joints, 3), and which instants come after the pose."""
    frames = solve(recording, suit, "independent")
    times, _ = orientations(frames, max(float(track.times[0]) for track in recording.modules))
    q_ref = np.full((len(times), suit.skeleton.n_segments, 4), np.nan)
    for reference in recording.references:
        q_ref[:, suit.skeleton.index(reference.name)] = reference_at(times, reference)
    is_still = (times >= still[0]) & (times <= still[1])
    facing = vendor.facing_of(q_ref, is_still, suit.skeleton)
    segments = vendor.as_segments(q_ref, is_still, facing, suit.skeleton)
    return joint_angles(suit.skeleton, segments), times > still[1]


def _rmse_deg(found: FloatArray, reference: FloatArray) -> FloatArray:
    difference = (np.degrees(found - reference) + 180.0) % 360.0 - 180.0
    seen = np.isfinite(difference)
    square = np.where(seen, difference, 0.0) ** 2
    with np.errstate(invalid="ignore"):
        rmse: FloatArray = np.sqrt(square.sum(axis=0) / seen.sum(axis=0))
    return rmse


def _worn_as(suit: WornSuit, modules: Collection[ModuleResult]) -> WornSuit:
    """Return the suit with its modules where the calibration found them."""
    rotations, places = suit.sensor_to_segment.copy(), suit.lever_arms.copy()
    for module in modules:
        if module.sensor_to_segment is not None:
            segment = suit.skeleton.index(module.segment)
            rotations[segment], places[segment] = module.sensor_to_segment, module.position
    return replace(suit, sensor_to_segment=rotations, lever_arms=places)
