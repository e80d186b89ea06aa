"""Public recordings with optical truth, and what is made of them: parts, reversals, other rates and fields.

A motion seen backward is a motion: rates change sign, all else stays. To a filter it is another recording,
with biases of the other sign, by the same real sensors.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.foot_recording import FIRST_MARKER_COLUMNS, MARKER_RATE_HZ, RATE_HZ, read_foot
from benchmarks.never_worse.case import Case
from benchmarks.never_worse.simulated import RING_HINGES, added, iron, turned
from devices.emulators.data_sets import (
    METAL_TABLE_S,
    read_broad,
    read_repoimu_pendulum,
    read_repoimu_tstick,
    read_ring_chain5,
)
from devices.recorded_tracks import RecordedTracks, ReferenceTrack, track_of
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.optical_reference import in_time
from gateway.emulation.recordings import imu_frames, reference_at

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[3] / "shared" / "data"))
LONGEST_S = 45.0
CUT_S = 30.0
"""Of a recording whose name ends in ``cut`` and the second of the trial that it begins at."""


def backward(recording: RecordedTracks) -> RecordedTracks:
    """The recording from its end to its beginning."""
    end_s = recording.duration_s
    modules = tuple(
        replace(
            t,
            times=end_s - t.times[::-1],
            specific_force=t.specific_force[::-1],
            angular_rate=-t.angular_rate[::-1],
            magnetic_field=t.magnetic_field[::-1],
        )
        for t in recording.modules
    )
    references = tuple(
        replace(r, times=end_s - r.times[::-1], q_wb=r.q_wb[::-1]) for r in recording.references
    )
    local = tuple(
        replace(track, times=end_s - track.times[::-1], values=track.values[::-1])
        for track in recording.local
    )
    return replace(recording, modules=modules, references=references, local=local)


def part(recording: RecordedTracks, begin_s: float, end_s: float, every: int = 1) -> RecordedTracks:
    """What lies between two times, its first sample at time 0, and of that every so many-th sample."""

    def kept(times: np.ndarray) -> np.ndarray:
        return np.flatnonzero((times >= begin_s) & (times < end_s))

    modules = []
    for t in recording.modules:
        rows = kept(t.times)[::every]
        modules.append(
            replace(
                t,
                times=t.times[rows] - begin_s,
                specific_force=t.specific_force[rows],
                angular_rate=t.angular_rate[rows],
                magnetic_field=t.magnetic_field[rows],
            )
        )
    local = []
    for track in recording.local:
        rows = kept(track.times)
        local.append(replace(track, times=track.times[rows] - begin_s, values=track.values[rows]))
    references = tuple(replace(r, times=r.times - begin_s) for r in recording.references)
    return replace(
        recording,
        sampling_rate_hz=recording.sampling_rate_hz / every,
        modules=tuple(modules),
        references=references,
        local=tuple(local),
    )


def cut_from(name: str) -> float | None:
    """Return the second that a name says its recording is cut from; None: none."""
    _, found, second = name.rpartition("_cut")
    return float(second) if found else None


def case_of(name: str, kind: str, recording: RecordedTracks, suit: WornSuit) -> Case:
    """What the gateway's own stages make of the recording, with the reference at the same instants."""
    frames = imu_frames(recording, suit)
    interval_s = 1.0 / recording.sampling_rate_hz
    first_s = max(float(track.times[0]) for track in recording.modules)
    times = first_s + (np.array([f.time_ns for f in frames]) - frames[0].time_ns) * 1e-9
    truth, later = (
        np.stack([reference_at(times + shift, r) for r in recording.references], axis=1)
        for shift in (0.0, 0.5 * interval_s)
    )
    return Case(name, kind, suit, interval_s, frames, truth, later)


def _ring(name: str) -> Case:
    sort = "nonrigid" if "nonrigid" in name else "rigid"
    recording, _ = in_time(read_ring_chain5(DATA / "ring_chain5" / "trial1", sort), METAL_TABLE_S)
    end_s, begin_s = recording.duration_s, cut_from(name)
    if begin_s is not None:
        recording = part(recording, begin_s, min(begin_s + CUT_S, end_s - METAL_TABLE_S))
    elif "midway" in name:
        recording = part(recording, 25.0, end_s - METAL_TABLE_S)
    elif name in ("ring_rigid", "ring_nonrigid"):
        recording = part(recording, 0.0, end_s - METAL_TABLE_S)
    else:
        every = 2 if "20hz" in name else 1
        recording = part(backward(recording), 0.0, end_s - METAL_TABLE_S, every)
    case = replace(case_of(name, "ring", recording, load_rig("chain_5")), hinges=RING_HINGES)
    if "bent" not in name:
        return case
    return _in_another_field(case, recording)


def _in_another_field(case: Case, recording: RecordedTracks) -> Case:
    """Iron about a metre away from where the chain moves; its segments hang on one another as in the rig."""
    times, (track,) = case.times_s, recording.local
    known = np.isfinite(track.values).all(axis=1)
    place = np.stack([np.interp(times, track.times[known], v) for v in track.values[known].T], axis=1)
    centre, extra = place.mean(axis=0), []
    for s in range(case.truth.shape[1]):
        q = case.truth[:, s]
        extra.append(turned(q, iron(place, np.random.default_rng(41), centre)))
        sound = np.isfinite(q).all(axis=1)
        along = np.zeros_like(place)
        along[sound] = Rotation.from_quat(q[sound], scalar_first=True).apply(case.suit.skeleton.tips[s])
        place = place + along
    return replace(case, frames=added(case.frames, np.stack(extra, axis=1)))


def _pendulum(name: str) -> Case:
    recording, _ = in_time(read_repoimu_pendulum(DATA / "repoimu_pendulum"))
    if name == "pendulum_midway":
        recording = part(recording, 100.0, 112.0)
    elif name == "pendulum_reversed":
        recording = part(backward(recording), 5.0, 5.0 + LONGEST_S)
    else:
        recording = part(recording, 0.0, LONGEST_S)
    return replace(case_of(name, "pendulum", recording, load_rig("pendulum_3")), is_spatial=False)


def _broad(name: str) -> Case:
    """About a dozen seconds of rest and then motion, as far as it does not begin midway."""
    (path,) = (DATA / "broad").glob(f"{name.split('_')[1]}_*.mat")
    recording, _ = in_time(read_broad(path))
    begin_s = cut_from(name)
    if begin_s is not None:
        recording = part(recording, begin_s, begin_s + CUT_S)
    elif "midway" in name:
        recording = part(recording, 60.0, 60.0 + LONGEST_S)
    elif "reversed" in name:
        recording = part(backward(recording), 23.0, 23.0 + LONGEST_S)
    else:
        recording = part(recording, 27.0, 27.0 + LONGEST_S)
    return case_of(name, "broad", recording, load_rig("single_placed"))


def _tstick(name: str) -> Case:
    (path,) = (DATA / "repoimu_tstick").glob(f"TStick_Test{name.split('_')[1]}_*.csv")
    recording, _ = in_time(read_repoimu_tstick(path))
    if "reversed" in name:
        recording = backward(recording)
    suit = replace(load_rig("single_placed"), local_devices=())
    return case_of(name, "tstick", part(recording, 0.0, LONGEST_S), suit)


def _foot(name: str) -> Case:
    """A foot that walks; its three markers give the orientation of the shoe."""
    folder, side = DATA / "gaitmap_foot", name.removeprefix("foot_")
    foot = read_foot(folder, side)
    markers = np.genfromtxt(folder / "mocap_sample.csv", delimiter=",", skip_header=2)
    toe, heel, ball = (markers[:, c : c + 3] / 1000.0 for c in FIRST_MARKER_COLUMNS[side])
    known = np.isfinite(np.hstack([toe, heel, ball])).all(axis=1)
    q = np.full((len(markers), 4), np.nan)
    ahead, beside = toe[known] - heel[known], ball[known] - heel[known]
    up = np.cross(ahead, beside)
    axes = np.stack([ahead, np.cross(up, ahead), up], axis=2)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    q[known] = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    times = np.arange(len(foot.force)) / RATE_HZ
    module = track_of(1, "module", times, foot.force, foot.rate)
    reference = ReferenceTrack("module", np.arange(len(markers)) / MARKER_RATE_HZ, q)
    recording, _ = in_time(RecordedTracks(name, RATE_HZ, (module,), (reference,)))
    suit = replace(load_rig("single_placed"), local_devices=())
    return case_of(name, "foot", recording, suit)


FAMILIES: dict[str, Callable[[str], Case]] = {
    "ring": _ring,
    "pendulum": _pendulum,
    "broad": _broad,
    "tstick": _tstick,
    "foot": _foot,
}
"""First word of a recording's name in the split to what makes its case. Each raises ``FileNotFoundError``, or
``ValueError`` where its file is not there."""
