"""Recordings of whole bodies whose modules also gave orientations: both ways to the same joint angles.

The vendor's orientations and our own reconstruction of the same raw readings are calibrated alike (the module
sits on its segment as it did while the person stood still), so that what differs is the reconstruction.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from devices.emulators.data_sets import read_hipose_mtw17
from devices.recorded_tracks import ModuleTrack, RecordedTracks, ReferenceTrack
from gateway.body.body_file import load_body
from gateway.body.joint_angles import joint_angles
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton, WornSuit
from gateway.emulation.recordings import align, orientations, reference_at, solve
from gateway.frames import FloatArray

QMT_SEGMENTS = {
    "hip": "pelvis",
    "upper_back": "thorax",
    "head": "head",
    "upper_arm_left": "left_upper_arm",
    "forearm_left": "left_forearm",
    "hand_left": "left_hand",
    "upper_arm_right": "right_upper_arm",
    "forearm_right": "right_forearm",
    "hand_right": "right_hand",
    "upper_leg_left": "left_thigh",
    "lower_leg_left": "left_shank",
    "foot_left": "left_foot",
    "upper_leg_right": "right_thigh",
    "lower_leg_right": "right_shank",
    "foot_right": "right_foot",
}
"""Names of the recording to segments; ``lower_back`` has none in the body of 17."""
HIPOSE_STILL_S, QMT_STILL_S = (1.0, 4.0), (0.5, 3.5)
"""From when to when the person stood in the neutral pose."""


class JointTrial(NamedTuple):
    """Joint angles of one recording by both ways."""

    name: str
    skeleton: Skeleton
    reference: FloatArray
    """(T, n_joints, 3) rad, from the vendor's orientations."""
    found: FloatArray
    """(T, n_joints, 3) rad, from our own."""
    still_s: float


def read_qmt(path: Path) -> RecordedTracks:
    """Sixteen modules at 100 Hz, without magnetometers, with the orientations that came with them."""
    data = loadmat(path, squeeze_me=True, struct_as_record=False)
    times = np.asarray(data["t"], dtype=np.float64)
    times = times - times[0]
    modules, references = [], []
    for module, (source, segment) in enumerate(QMT_SEGMENTS.items()):
        track = data[source]
        none = np.full((len(times), 3), np.nan)
        modules.append(ModuleTrack(module, segment, times, track.acc, track.gyr, none))
        references.append(ReferenceTrack(segment, times, track.quat))
    return RecordedTracks("qmt_fullbody16", 100.0, tuple(modules), tuple(references))


def joint_trial(recording: RecordedTracks, still: tuple[float, float], reconstructor: str) -> JointTrial:
    """Joint angles over a recording.

    still: from when to when the person stood in the neutral pose, s.
    """
    suit = dressed(recording)
    frames = solve(recording, suit, reconstructor)
    times, q_ws = orientations(frames, max(float(track.times[0]) for track in recording.modules))
    index = [suit.skeleton.index(reference.name) for reference in recording.references]
    q_ref = np.full_like(q_ws, np.nan)
    for i, reference in zip(index, recording.references, strict=True):
        q_ref[:, i] = reference_at(times, reference)
    is_still = (times >= still[0]) & (times <= still[1])
    facing = facing_of(q_ref, is_still, suit.skeleton)
    turned = _common_heading(q_ws, q_ref, is_still, index, has_field=bool(recording.modules[0].sensors[2:]))
    reference = joint_angles(suit.skeleton, as_segments(q_ref, is_still, facing, suit.skeleton))
    found = joint_angles(suit.skeleton, as_segments(turned, is_still, facing, suit.skeleton))
    return JointTrial(
        recording.name, suit.skeleton, reference[times > still[1]], found[times > still[1]], still[1]
    )


def hipose(folder: Path) -> JointTrial:
    """17 modules with magnetometers, 60 Hz."""
    return joint_trial(read_hipose_mtw17(folder), HIPOSE_STILL_S, "independent")


def dressed(recording: RecordedTracks) -> WornSuit:
    """The 17-segment person with the recording's modules, their axes taken as the segments'.

    Shoulders by swing and twist: with arms that hang, single angles of the YXY sequence mean nothing.
    """
    suit = load_rig("suit_17")
    shoulders = dict.fromkeys(("left_shoulder", "right_shoulder"), "swing_twist")
    suit = replace(suit, skeleton=load_body("human_17", joint_definitions=shoulders))
    names = [track.name for track in recording.modules]
    rows = [names.index(segment) if segment in names else -1 for segment in suit.skeleton.segment_names]
    return replace(
        suit,
        module_ids=recording.module_ids,
        module_of_segment=np.array(rows),
        sensor_to_segment=np.tile([1.0, 0, 0, 0], (len(rows), 1)),
        local_devices=(),
    )


def _common_heading(
    q_ws: FloatArray, q_ref: FloatArray, is_still: FloatArray, index: list[int], has_field: bool
) -> FloatArray:
    """Ours in the reference's world: one heading for the whole body.

    Without a field every module has its own (and here the reference its own sensor axes): both constants
    are taken out of each.
    """
    turned = q_ws.copy()
    if not has_field:
        for i in index:
            known = np.isfinite(q_ws[:, i]).all(axis=1) & np.isfinite(q_ref[:, i]).all(axis=1)
            turned[:, i] = np.nan
            turned[known, i] = align(q_ws[known, i], q_ref[known, i])
        return turned
    ours = {i: _mean(q_ws[is_still, i]) for i in index}
    theirs = {i: _mean(q_ref[is_still, i]) for i in index}
    headings = {i: _heading(theirs[i] * ours[i].inv()) for i in index}
    common = float(np.angle(np.mean([np.exp(1j * h) for h in headings.values()])))
    for i in index:
        turned[:, i] = _quaternions(Rotation.from_rotvec([0, 0, common]), q_ws[:, i])
    return turned


def as_segments(q_ws: FloatArray, is_still: FloatArray, facing: float, skeleton: Skeleton) -> FloatArray:
    """Segment orientations, given that all segments were neutral, facing so, while the person stood still."""
    neutral = Rotation.from_rotvec([0, 0, facing]) * Rotation.from_quat(skeleton.neutral, scalar_first=True)
    q_wb = np.full_like(q_ws, np.nan)
    for i in range(q_ws.shape[1]):
        known = np.isfinite(q_ws[:, i]).all(axis=1)
        if not known.any():
            continue
        sensor_to_segment = neutral.inv() * _mean(q_ws[is_still & known, i])
        rotation = Rotation.from_quat(q_ws[known, i], scalar_first=True) * sensor_to_segment.inv()
        q_wb[known, i] = rotation.as_quat(scalar_first=True)
    return q_wb


def facing_of(q_ref: FloatArray, is_still: FloatArray, skeleton: Skeleton) -> float:
    """Heading of the person, rad from east: the legs turn mostly about the axis to the right, z.

    Of the two ways to face, the one in which the knees bend backwards.
    """
    legs = [skeleton.index(f"{side}_{name}") for side in ("left", "right") for name in ("thigh", "shank")]
    known = np.isfinite(q_ref[:, legs]).all(axis=(1, 2))
    is_still = is_still[known]
    turns = []
    for side in ("left", "right"):
        thigh, shank = (
            Rotation.from_quat(q, scalar_first=True) * _mean(q[is_still]).inv()
            for q in (q_ref[known, skeleton.index(f"{side}_{name}")] for name in ("thigh", "shank"))
        )
        turns.append((thigh.inv() * shank).as_rotvec())
    level = np.concatenate(turns)[:, :2]
    right = np.linalg.eigh(level.T @ level)[1][:, -1]
    if np.mean(level @ right) > 0:  # knees flex about -z
        right = -right
    return float(np.arctan2(right[0], -right[1]))  # facing is 90° to the left of what is right


def _mean(q: FloatArray) -> Rotation:
    return Rotation.from_quat(q[np.isfinite(q).all(axis=1)], scalar_first=True).mean()


def _heading(rotation: Rotation) -> float:
    w, _, _, z = rotation.as_quat(scalar_first=True)
    return float(2.0 * np.arctan2(z, w))


def _quaternions(turn: Rotation, q: FloatArray) -> FloatArray:
    known = np.isfinite(q).all(axis=1)
    turned = np.full_like(q, np.nan)
    turned[known] = (turn * Rotation.from_quat(q[known], scalar_first=True)).as_quat(scalar_first=True)
    return turned
