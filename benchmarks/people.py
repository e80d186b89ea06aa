"""Real people without an optical reference: knees and elbows are hinges, and tell what is right.

The bone beyond a hinge moves in one plane of the bone before it, whatever the person does. So the direction
of a shank in its thigh's module, over a whole recording, lies on a circle; how far it leaves that circle is
an error of the two orientations, and of the joint's own looseness, which is the same for all methods. A wrong
relative heading tears the circle apart. No reference is needed, and the makers' orientations can be judged
beside ours. Where the module sits on its segment does not matter, but for the bone's direction: it is that of
gravity while the person stands.

`joint` needs to know how modules sit on their segments. That is taken from the makers' orientations while the
person stands; lever arms are those of the rig for anybody, and nobody was measured.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from vqf import VQF

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from benchmarks.joint_recordings import HIPOSE_STILL_S, QMT_STILL_S, dressed, facing_of, read_qmt
from devices.emulators.data_sets import read_hipose_mtw17
from devices.recorded_tracks import RecordedTracks, ReferenceTrack
from gateway.body.skeleton import WornSuit
from gateway.emulation.recordings import imu_frames, orientations, reference_at, solved
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.whole_body import WholeBodyReconstructor

HINGES = (
    ("left_thigh", "left_shank"),
    ("right_thigh", "right_shank"),
    ("left_upper_arm", "left_forearm"),
    ("right_upper_arm", "right_forearm"),
)
SETTLED_S = 5.0
"""After the person has stood still: by then headings shall be known."""
SLOW = 1.5
"""m/s²: a specific force so near to gravity shows where down is, more or less."""
UP = (0.0, 0.0, 1.0)
MAKER, VQF_6, VQF_9, OURS = "maker's", "VQF 6", "VQF 9", "joint"


@dataclass(frozen=True)
class Trial:
    """A recording of a whole body with the orientations of the maker's own filter."""

    recording: RecordedTracks
    still_s: tuple[float, float]
    """From when to when the person stood in the neutral pose."""

    @property
    def has_field(self) -> bool:
        """Whether its modules measured the field."""
        return "magnetic_field" in self.recording.modules[0].sensors


@dataclass(frozen=True)
class Hinge:
    """How far the bone beyond a hinge leaves its plane, by one method."""

    off_deg: float
    """RMS, the two orientations as they are."""
    turned_off_deg: float
    """RMS, after the constant relative heading that is best for it."""


def run() -> Report:
    """Return how plane hinges are in every recording that is there."""
    report = Report("people")
    for name, trial in _trials():
        found = {method: hinges(trial, q_ws) for method, q_ws in solutions(trial).items()}
        report.tables.append(_table(name, found))
        report.figures += _figures(name, found)
    return report


def _figures(name: str, found: dict[str, dict[str, Hinge]]) -> list[Figure]:
    what = "knees and elbows leave their plane by, mean RMS, `joint`"
    vqf = [method for method in (VQF_6, VQF_9) if method in found]
    ours, maker = _mean(found[OURS]), _mean(found[MAKER])
    theirs = min(_mean(found[method]) for method in vqf)
    shape = _mean(found[OURS], turned=True) / min(_mean(found[method], turned=True) for method in vqf)
    return [
        Figure(f"{name}_hinge_deg", ours, "°", "", what),
        Figure(f"{name}_hinge_ratio_maker", ours / maker, "", "<=1", "over the maker's own filter"),
        Figure(f"{name}_hinge_ratio_vqf", ours / theirs, "", "<=1", "over the better VQF"),
        Figure(
            f"{name}_hinge_turned_ratio_vqf", shape, "", "<=1",
            "the same, each given the relative headings that are best for it",
        ),
    ]  # fmt: skip


def _mean(found: dict[str, Hinge], turned: bool = False) -> float:
    return float(np.mean([hinge.turned_off_deg if turned else hinge.off_deg for hinge in found.values()]))


def _trials() -> Iterator[tuple[str, Trial]]:
    sources = (
        ("hipose_mtw17", "hipose_mtw17", read_hipose_mtw17, HIPOSE_STILL_S),
        ("qmt_fullbody16", "qmt_fullbody16/full_body_example_data.mat", read_qmt, QMT_STILL_S),
    )
    for name, path, read, still_s in sources:
        if (DATA / path).exists():
            yield name, Trial(in_axes_of_readings(read(DATA / path)), still_s)
        else:
            print(f"skipped {path}: not there")


def in_axes_of_readings(recording: RecordedTracks) -> RecordedTracks:
    """Return a recording whose orientations are those of the axes of its readings.

    Makers may give them in other axes: the rotation between is that which brings the specific force of slow
    samples to the vertical of the orientations (Wahba's problem).
    """
    references = []
    for track, reference in zip(recording.modules, recording.references, strict=True):
        q = reference_at(track.times, reference)
        length = np.linalg.norm(track.specific_force, axis=1)
        is_slow = (np.abs(length - 9.81) < SLOW) & np.isfinite(q).all(axis=1)
        down = Rotation.from_quat(q[is_slow], scalar_first=True).inv().apply(UP)
        turn, _ = Rotation.align_vectors(down, track.specific_force[is_slow] / length[is_slow, None])
        known = np.isfinite(reference.q_wb).all(axis=1)
        turned = np.full_like(reference.q_wb, np.nan)
        turned[known] = _wxyz(Rotation.from_quat(reference.q_wb[known], scalar_first=True) * turn)
        references.append(replace(reference, q_wb=turned))
    return replace(recording, references=tuple(references))


def solutions(trial: Trial) -> dict[str, dict[str, ReferenceTrack]]:
    """Return the orientations of modules by method and segment."""
    recording, suit = trial.recording, worn(trial)
    interval_s = 1.0 / recording.sampling_rate_hz
    frames = imu_frames(recording, suit)
    found = {
        MAKER: {reference.name: reference for reference in recording.references},
        VQF_6: _vqf(trial, False),
    }
    if trial.has_field:
        found[VQF_9] = _vqf(trial, uses_field=True)
    ours = {method: solved(method, suit, interval_s, frames) for method in ("independent", OURS)}
    if trial.has_field:
        ours["joint, field not used"] = _without_field(suit, interval_s, frames)
    first_s = max(float(track.times[0]) for track in recording.modules)
    for method, poses in ours.items():
        times, q_wb = orientations(poses, first_s)
        found[method] = {track.name: _of_module(suit, track.name, times, q_wb) for track in recording.modules}
    return found


def worn(trial: Trial) -> WornSuit:
    """Return the suit of anybody, its modules sitting as the maker's filter saw them in the neutral pose."""
    recording, suit = trial.recording, dressed(trial.recording)
    skeleton = suit.skeleton
    times = recording.references[0].times
    is_still = (times >= trial.still_s[0]) & (times <= trial.still_s[1])
    q_ws = np.full((len(times), len(skeleton.segment_names), 4), np.nan)
    for reference in recording.references:
        q_ws[:, skeleton.index(reference.name)] = reference_at(times, reference)
    facing = Rotation.from_rotvec([0.0, 0.0, facing_of(q_ws, is_still, skeleton)])
    stood = facing * Rotation.from_quat(skeleton.neutral, scalar_first=True)
    sensor_to_segment = suit.sensor_to_segment.copy()
    for i in np.flatnonzero(suit.module_of_segment >= 0):
        known = is_still & np.isfinite(q_ws[:, i]).all(axis=1)
        module = Rotation.from_quat(q_ws[known, i], scalar_first=True).mean()
        sensor_to_segment[i] = _wxyz(stood.inv() * module)
    return replace(suit, sensor_to_segment=sensor_to_segment)


def _without_field(suit: WornSuit, interval_s: float, frames: list[ImuFrame]) -> list[SkeletonFrame]:
    finder = JointReconstructor(suit, interval_s, ChainSettings(uses_field=False))
    return WholeBodyReconstructor(suit, finder).update_many(frames)


def _of_module(suit: WornSuit, name: str, times: FloatArray, q_wb: FloatArray) -> ReferenceTrack:
    i = suit.skeleton.index(name)
    mounted = Rotation.from_quat(suit.sensor_to_segment[i], scalar_first=True)
    return ReferenceTrack(name, times, _wxyz(Rotation.from_quat(q_wb[:, i], scalar_first=True) * mounted))


def _vqf(trial: Trial, uses_field: bool) -> dict[str, ReferenceTrack]:
    """Return VQF's orientations of every module; lost samples hold the last reading."""
    found = {}
    for track in trial.recording.modules:
        rate, force, field = (
            np.ascontiguousarray(_held(each))
            for each in (track.angular_rate, track.specific_force, track.magnetic_field)
        )
        filter_ = VQF(1.0 / trial.recording.sampling_rate_hz)
        if uses_field:
            q = filter_.updateBatch(rate, force, field)["quat9D"]
        else:
            q = filter_.updateBatch(rate, force)["quat6D"]
        found[track.name] = ReferenceTrack(track.name, track.times, q)
    return found


def _held(readings: FloatArray) -> FloatArray:
    known = np.isfinite(readings).all(axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(readings)), 0))
    return readings[last]


def hinges(trial: Trial, q_ws: dict[str, ReferenceTrack]) -> dict[str, Hinge]:
    """Return how plane each hinge is by one method's orientations of modules."""
    return {beyond: _hinge(trial, q_ws, before, beyond) for before, beyond in HINGES}


def _hinge(trial: Trial, q_ws: dict[str, ReferenceTrack], before: str, beyond: str) -> Hinge:
    track = next(each for each in trial.recording.modules if each.name == beyond)
    is_still = (track.times >= trial.still_s[0]) & (track.times <= trial.still_s[1])
    bone = np.nanmean(track.specific_force[is_still], axis=0)
    times = track.times[track.times > trial.still_s[1] + SETTLED_S]
    q_before, q_beyond = reference_at(times, q_ws[before]), reference_at(times, q_ws[beyond])
    known = np.isfinite(q_before).all(axis=1) & np.isfinite(q_beyond).all(axis=1)
    return plane_of(q_before[known], q_beyond[known], bone / np.linalg.norm(bone))


def plane_of(q_before: FloatArray, q_beyond: FloatArray, bone: FloatArray) -> Hinge:
    """Return how far a bone leaves its plane.

    q_before, q_beyond: (T, 4) orientations of the modules on both sides. bone: (3,) its direction, in axes of
    the module on it.
    """
    before = Rotation.from_quat(q_before, scalar_first=True).inv()
    directions = Rotation.from_quat(q_beyond, scalar_first=True).apply(bone)

    def off_deg(turn: float) -> float:
        return _off_circle(before.apply(Rotation.from_rotvec([0.0, 0.0, turn]).apply(directions)))

    starts = np.radians(np.arange(-180.0, 180.0, 10.0))
    nearest = min(starts, key=off_deg)
    best = minimize_scalar(off_deg, bounds=(nearest - 0.2, nearest + 0.2), method="bounded")
    return Hinge(off_deg(0.0), float(best.fun))


def _off_circle(directions: FloatArray) -> float:
    """Return how far unit vectors (T, 3) are from the circle that fits them best, RMS, degrees."""
    middle = directions.mean(axis=0)
    axis = np.linalg.eigh(np.cov(directions.T))[1][:, 0]
    heights = np.arcsin(np.clip(directions @ axis, -1.0, 1.0))
    return float(np.degrees(np.std(heights - np.arcsin(middle @ axis))))


def _wxyz(rotation: Rotation) -> FloatArray:
    q: FloatArray = rotation.as_quat(scalar_first=True)
    return q


def _table(name: str, found: dict[str, dict[str, Hinge]]) -> str:
    heads = ["method", *(beyond.replace("_", " ") for _, beyond in HINGES), "mean", "best headings given"]
    rows = [
        [
            method,
            *(f"{hinge.off_deg:.1f}" for hinge in by_name.values()),
            f"{_mean(by_name):.1f}",
            f"{_mean(by_name, turned=True):.1f}",
        ]
        for method, by_name in found.items()
    ]
    return f"## {name}: how far bones leave their plane, RMS, degrees\n\n" + table(heads, rows)
