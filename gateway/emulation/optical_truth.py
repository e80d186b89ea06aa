"""A simulated capture: a moving body with markers whose true pose is known, all that goes wrong with them,
and how far a fitted body is from it; which real trials are measured beside it, and what their files hold."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from devices.deferred import Rotation, RotationSpline
from devices.marker_files import MarkerTrial
from gateway.body.anthropometry import Subject, scaled
from gateway.body.joint_angles import JointAngles, posture
from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.fitted_body import Fit
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import MarkerSet, load_marker_set
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.worn_markers import worn_part

NOISE = 0.001
MISPLACED = 0.03
GAPS = 0.10
RATE_HZ = 100.0
_STANDING_S = 1.0
SEED = 3
SECONDS = 12.0
STANDING = (0.0, 0.9)
_NEAR_GIMBAL = np.radians(15.0)
UNTOLD = {"btk": {"marker_diameter": 0.016}}
"""Of a subject, m, what the files do not hold: with 16 mm markers the rules give their centres exactly."""
TRIALS = {
    "pycgm": ("plug_in_gait", "c3d_pycgm/Static_trial.c3d", "c3d_pycgm/Movement_trial.c3d"),
    "btk": (
        "plug_in_gait",
        "c3d_btk_pig/PiG_Calibration-FlatFoot-Full.c3d",
        "c3d_btk_pig/PiG_Motion-FlatFoot-Full.c3d",
    ),
    "opensim": ("opensim_41", "trc_opensim/subject01_static.trc", "trc_opensim/marker_trajectories.trc"),
}
CENTRES = {
    "hips": ("pelvis", "PELO"), "left knee": ("left_shank", "LFEO"), "right knee": ("right_shank", "RFEO"),
    "left ankle": ("left_foot", "LTIO"), "right ankle": ("right_foot", "RTIO"),
    "left shoulder": ("left_upper_arm", "LCLO"), "right shoulder": ("right_upper_arm", "RCLO"),
    "left elbow": ("left_forearm", "LHUO"), "right elbow": ("right_forearm", "RHUO"),
    "left wrist": ("left_hand", "LRAO"), "right wrist": ("right_hand", "RRAO"),
}  # fmt: skip
"""Joint centres that Plug-in-Gait writes into files: the segment that begins there, and their label."""

# Where Plug-in-Gait markers sit, from the segment's proximal joint, segment axes, fractions of its length.
_NOMINAL = {
    "LASI": (0.9, 0.9, -1.2), "RASI": (0.9, 0.9, 1.2), "LPSI": (-1.1, 1.0, -0.5), "RPSI": (-1.1, 1.0, 0.5),
    "C7": (-0.15, 0.95, 0), "T10": (-0.28, 0.5, 0), "CLAV": (0.15, 0.82, 0), "STRN": (0.3, 0.5, 0),
    "RBAK": (-0.25, 0.7, 0.2), "LFHD": (0.35, 0.7, -0.28), "RFHD": (0.35, 0.7, 0.28),
    "LBHD": (-0.35, 0.7, -0.25),
    "RBHD": (-0.35, 0.7, 0.25), "SHO": (0, 0.25, 0.9), "UPA": (0.05, -0.5, 0.15), "ELB": (0, -1.0, 0.14),
    "FRM": (0.08, -0.5, 0.12), "WRA": (0.14, -0.98, 0.04), "WRB": (-0.14, -0.98, 0.04),
    "FIN": (0.05, -0.45, 0.1),
    "THI": (0.05, -0.5, 0.22), "KNE": (0, -1.0, 0.13), "TIB": (0.05, -0.5, 0.16), "ANK": (0, -1.0, 0.1),
    "HEE": (-0.28, -0.2, 0.02), "TOE": (0.85, -0.2, 0.05),
}  # fmt: skip


@dataclass(frozen=True)
class SimulatedTrial:
    """A trial and its truth."""

    trial: MarkerTrial
    q_wb: FloatArray  # (F, S, 4)
    p_w: FloatArray  # (F, S, 3) m
    swaps: list[tuple[int, str, str]]
    """(frame, marker, marker) whose points changed places."""


def simulated_labels(marker_set: MarkerSet) -> set[str]:
    """Return the markers of Plug-in-Gait whose places are known: none of CGM2, no sacral one."""
    return {label for label in marker_set.labels if label in _NOMINAL or label[1:] in _NOMINAL}


def placed_markers(
    marker_set: MarkerSet, body: Skeleton, generator: np.random.Generator
) -> tuple[FloatArray, list[int]]:
    """Return where the markers of one subject sit, (M, 3) m, and on which segments: each ``MISPLACED`` from
    its nominal place, in a direction of its own."""
    places, segments = [], []
    for label in marker_set.labels:
        segment = body.index(marker_set.carriers[label])
        side = -1.0 if label.startswith("L") and label not in _NOMINAL else 1.0
        # Places are listed for one side, and mirrored for the other.
        nominal = np.array(_NOMINAL.get(label) or _NOMINAL[label[1:]], dtype=np.float64)
        if label not in _NOMINAL:
            nominal = nominal * (1.0, 1.0, side)
        direction = generator.normal(size=3)
        length = float(np.linalg.norm(body.tips[segment]))
        places.append(nominal * length + MISPLACED * direction / np.linalg.norm(direction))
        segments.append(segment)
    return np.array(places), segments


def simulated(
    marker_set: MarkerSet,
    body: Skeleton,
    places: FloatArray,
    segments: list[int],
    seconds: float,
    generator: np.random.Generator,
    *,
    faults: bool,
    gaps: float = GAPS,
) -> SimulatedTrial:
    """Return a second of neutral standing, then every joint's free angles in motion; with gaps (a share of
    all points) and swaps if wanted."""
    q_wb, p_w = _motion(body, seconds, generator)
    R = np.array([[quaternion.to_matrix(q) for q in pose] for pose in q_wb])
    markers = p_w[:, segments] + np.einsum("fmij,mj->fmi", R[:, segments], places)
    markers = markers + generator.normal(0.0, NOISE, markers.shape)
    swaps = _swap(markers, marker_set.labels, generator) if faults else []
    if faults:
        cut_gaps(markers, gaps, RATE_HZ, generator, first=150)
    trial = MarkerTrial("simulated", marker_set.labels, RATE_HZ, markers)
    return SimulatedTrial(trial, q_wb, p_w, swaps)


def _motion(body: Skeleton, seconds: float, generator: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    # Motion sets in gently after the neutral standing that a fit needs.
    ease = np.clip((times - _STANDING_S) / 0.5, 0.0, 1.0) ** 2
    waves = {}
    for joint in body.joints:
        if joint.distal < 0 or joint.proximal != body.parents[joint.distal]:
            continue
        angles = np.zeros((len(times), len(joint.angles)))
        for k, angle in enumerate(joint.angles):
            if angle.name in joint.free:
                # Well within the limits, and no wider than people commonly move.
                low, high = np.clip(angle.limits, -1.2, 1.2) * 0.7
                wave = np.sin(2 * np.pi * generator.uniform(0.2, 0.6) * times + generator.uniform(0, 6.28))
                angles[:, k] = ease * (0.5 * (low + high) + 0.5 * (high - low) * wave)
        waves[joint.name] = angles
    shoulders = {
        joint.name: _raised(times, ease, generator)
        for joint in body.joints
        if joint.name.endswith("_shoulder")
    }
    waves.update(shoulders)
    turn = ease * 0.6 * np.sin(2 * np.pi * 0.15 * times)
    q_wb, p_w = [], []
    for f in range(len(times)):
        root = quaternion.multiply(
            quaternion.from_rotation_vector(np.array([0.0, 0.0, turn[f]])), body.neutral
        )
        pose = posture(body, {name: angles[f] for name, angles in waves.items()}, root)
        place = np.array([ease[f] * 0.4 * np.sin(0.8 * times[f]), 0.2 * ease[f] * times[f] / seconds, 0.95])
        q_wb.append(pose)
        p_w.append(joint_positions(body.parents, body.offsets, pose, place))
    return np.array(q_wb), np.array(p_w)


def _raised(times: FloatArray, ease: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return the plane of elevation, elevation, rotation of an arm."""
    swing = [
        np.sin(2 * np.pi * generator.uniform(0.2, 0.5) * times + generator.uniform(0, 6.28)) for _ in range(3)
    ]
    return np.stack([ease * 0.7 * swing[0], ease * (0.8 + 0.5 * swing[1]), ease * 0.4 * swing[2]], axis=1)


def _swap(
    markers: FloatArray, labels: tuple[str, ...], generator: np.random.Generator
) -> list[tuple[int, str, str]]:
    """Exchange two markers' names for a fifth of a second, again and again; change ``markers``."""
    pairs = [("LKNE", "LTHI"), ("RWRA", "RWRB"), ("LASI", "RASI"), ("RANK", "RHEE"), ("LFHD", "RFHD")]
    swaps = []
    for begin in range(200, len(markers) - 40, 60):
        a, b = pairs[int(generator.integers(len(pairs)))]
        i, j = labels.index(a), labels.index(b)
        for frame in range(begin, begin + 20):
            markers[frame, [i, j]] = markers[frame, [j, i]]
            swaps.append((frame, a, b))
    return swaps


def cut_gaps(
    markers: FloatArray, share: float, rate_hz: float, generator: np.random.Generator, first: int = 0
) -> None:
    """Take out a share of the points of every marker, in gaps of 0.05 to 0.5 s from a frame on; changes
    ``markers``."""
    n_frames, n_markers, _ = markers.shape
    shortest, longest = round(0.05 * rate_hz), round(0.5 * rate_hz)
    for m in range(n_markers):
        missing = 0
        while missing < share * n_frames:
            length = int(generator.integers(shortest, longest))
            begin = int(generator.integers(first, n_frames - length))
            markers[begin : begin + length, m] = np.nan
            missing = int(np.isnan(markers[:, m, 0]).sum())


def shortened(trial: SimulatedTrial, first: int, last: int) -> SimulatedTrial:
    """Return frames of a trial."""
    cut = slice(first, last)
    short = replace(trial.trial, positions=trial.trial.positions[cut])
    return SimulatedTrial(short, trial.q_wb[cut], trial.p_w[cut], [])


class SimulatedErrors(NamedTuple):
    """How far a fitted body's poses are from the truth of a simulated trial of F frames."""

    body: Skeleton
    offline: list[FloatArray]
    """By joint (F, angles) degrees, a whole trial; NaN where the true joint is near a singularity."""
    live: list[FloatArray]
    """The same, frame by frame, without knowing what comes after a gap."""
    foreseen: list[FloatArray]
    """The same of the truth itself, as its own spline through the instants at which each segment shows how it
    lies: what cannot be bettered without what is seen of its neighbours."""
    shown: NDArray[np.bool_]  # (F, S)
    """Whether all markers of a segment are seen."""
    swaps_found: float
    """Share of the points with a wrong name."""
    length_spread_mm: float
    """Largest change of a bone's length over all frames."""

    @property
    def live_seen(self) -> list[FloatArray]:
        """``live`` while every marker of the segment beyond the joint is seen."""
        return [e[self.shown[:, j.distal]] for j, e in zip(self.body.joints, self.live, strict=True)]


def solved_simulation(seconds: float = SECONDS, gaps: float = GAPS) -> SimulatedErrors:
    """Fit a body to one half of a simulated capture, and solve the other, which has all faults.

    gaps: share of all points.
    """
    whole = load_marker_set("plug_in_gait")
    marker_set = worn_part(whole, simulated_labels(whole))
    generator = np.random.default_rng(SEED)
    body = scaled(marker_set.body, Subject(height_m=1.68))
    places, segments = placed_markers(marker_set, body, generator)
    calibration = simulated(marker_set, body, places, segments, seconds, generator, faults=False)
    test = simulated(marker_set, body, places, segments, seconds, generator, faults=True, gaps=gaps)
    options = FitOptions(vertical="z", neutral=STANDING, centres="motion")
    fitted = fit_body(marker_set, [calibration.trial], options)
    q_wb, found = _solved(fitted, test)
    seen = np.isfinite(test.trial.columns(fitted.markers.labels)[:, :, 0])
    splined = foreseen(body.parents, fitted.markers.segments, seen, test.trial.rate_hz, test.q_wb)
    live, offline, known = (
        _angle_errors(body, each, test.q_wb) for each in (q_wb, _bridged(fitted, test), splined)
    )
    shown = _shown(fitted, test)
    return SimulatedErrors(body, offline, live, known, shown, found, _length_spread(fitted, q_wb))


def _bridged(fitted: Fit, test: SimulatedTrial) -> FloatArray:
    """Return (F, S, 4), with gaps bridged from both sides."""
    observed = test.trial.columns(fitted.markers.labels)
    frames = [MarkerFrame(f, round(f * 1e9 / test.trial.rate_hz), seen) for f, seen in enumerate(observed)]
    solved, _ = solve_both_ways(fitted.skeleton, fitted.markers, frames)
    return np.array([each.q_wb for each in solved])


def foreseen(
    parents: IntArray, segments: IntArray, seen: NDArray[np.bool_], rate_hz: float, q_wb: FloatArray
) -> FloatArray:
    """Return a motion (F, S, 4) as it may be known of each segment by itself: every joint turned as it is
    where two of the markers beyond it are seen, or its only one, and by a cubic spline of rotations between.

    parents: (S,); segments: (M,), which carry the markers; seen: (F, M).
    """
    times = np.arange(len(seen)) / rate_hz
    found = np.empty_like(q_wb)
    for s, parent in enumerate(parents.tolist()):
        own = seen[:, segments == s]
        shows = np.flatnonzero(own.sum(axis=1) >= min(2, own.shape[1]))
        true = Rotation.from_quat(q_wb[:, s], scalar_first=True)
        if parent >= 0:
            true = Rotation.from_quat(q_wb[:, parent], scalar_first=True).inv() * true
        turn = RotationSpline(times[shows], true[shows])(times.clip(times[shows[0]], times[shows[-1]]))
        if parent >= 0:
            turn = Rotation.from_quat(found[:, parent], scalar_first=True) * turn
        found[:, s] = turn.as_quat(scalar_first=True)
    return found


def _shown(fitted: Fit, test: SimulatedTrial) -> NDArray[np.bool_]:
    """Return (F, S) whether all markers of a segment are seen."""
    seen: NDArray[np.bool_] = np.isfinite(test.trial.columns(fitted.markers.labels)[:, :, 0])
    n = fitted.skeleton.n_segments
    return np.stack([seen[:, fitted.markers.segments == s].all(axis=1) for s in range(n)], axis=1)


def _solved(fitted: Fit, test: SimulatedTrial) -> tuple[FloatArray, float]:
    """Return orientations (F, S, 4), and the share of swapped points that were found."""
    reconstructor = OpticalReconstructor(fitted.skeleton, fitted.markers)
    labels = fitted.markers.labels
    observed = test.trial.columns(labels)
    q_wb, renamed = [], set()
    for f, seen in enumerate(observed):
        q_wb.append(reconstructor.update(MarkerFrame(f, round(f * 1e9 / test.trial.rate_hz), seen)).q_wb)
        assert reconstructor.last is not None
        renamed |= {(f, labels[m], labels[s]) for m, s in reconstructor.last.renamed}
    wrong = {
        (f, right, given)
        for f, a, b in test.swaps
        for right, given in ((a, b), (b, a))
        # A swap of which one marker is in a gap cannot be found by its name.
        if np.isfinite(observed[f, labels.index(given), 0])
    }
    return np.array(q_wb), len(wrong & renamed) / len(wrong)


def _angle_errors(body: Skeleton, q_wb: FloatArray, truth: FloatArray) -> list[FloatArray]:
    """Return a joint: (F, angles) degrees; NaN where the true joint is near the singularity of its angles."""
    ours, theirs = JointAngles(body), JointAngles(body)
    errors: list[list[FloatArray]] = [[] for _ in body.joints]
    for a, b in zip(q_wb, truth, strict=True):
        found, true = ours.update(a).angles, theirs.update(b).angles
        apart = np.degrees((found - true + np.pi) % (2 * np.pi) - np.pi)
        for j, joint in enumerate(body.joints):
            is_euler = len(set(joint.sequence)) == 2 and len(joint.angles) == 3
            is_near = is_euler and abs(np.sin(true[j, 1])) < np.sin(_NEAR_GIMBAL)
            row = np.full(len(joint.angles), np.nan) if is_near else apart[j, : len(joint.angles)]
            errors[j].append(row)
    return [np.array(each) for each in errors]


def _length_spread(fitted: Fit, q_wb: FloatArray) -> float:
    """Return the largest spread of a bone's length over the orientations of every 20th frame, mm."""
    spreads = []
    for s, offset in enumerate(fitted.skeleton.offsets):
        parent = int(fitted.skeleton.parents[s])
        if parent >= 0:
            lengths = [np.linalg.norm(quaternion.rotate(q[parent], offset)) for q in q_wb[::20]]
            spreads.append(1e3 * float(np.ptp(lengths)))
    return max(spreads)


def rms_of(errors: list[FloatArray]) -> float:
    """Return the root mean square of all, NaN left out."""
    return rms(np.concatenate([error.ravel() for error in errors]))


def rms(errors: FloatArray) -> float:
    """Return the root mean square, NaN left out."""
    return float(np.sqrt(np.nanmean(errors**2)))
