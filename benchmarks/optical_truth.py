"""A simulated capture: a moving body with markers whose true pose is known, and all that goes wrong with
them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.marker_files import MarkerTrial
from gateway.body.joint_angles import posture
from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.marker_set import MarkerSet

NOISE = 0.001
MISPLACED = 0.03
GAPS = 0.10
RATE_HZ = 100.0
_STANDING_S = 1.0

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


def placed_markers(
    marker_set: MarkerSet, body: Skeleton, generator: np.random.Generator
) -> tuple[FloatArray, list[int]]:
    """Where the markers of one subject sit, (M, 3) m, and on which segments: each ``MISPLACED`` from its
    nominal place, in a direction of its own."""
    places, segments = [], []
    for label in marker_set.labels:
        segment = body.index(marker_set.carriers[label])
        side = -1.0 if label.startswith("L") and label not in _NOMINAL else 1.0
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
) -> SimulatedTrial:
    """A second of neutral standing, then every joint's free angles in motion; with gaps and swaps if
    wanted."""
    q_wb, p_w = _motion(body, seconds, generator)
    R = np.array([[quaternion.to_matrix(q) for q in pose] for pose in q_wb])
    markers = p_w[:, segments] + np.einsum("fmij,mj->fmi", R[:, segments], places)
    markers = markers + generator.normal(0.0, NOISE, markers.shape)
    swaps = _swap(markers, marker_set.labels, generator) if faults else []
    if faults:
        _cut_gaps(markers, generator)
    trial = MarkerTrial("simulated", marker_set.labels, RATE_HZ, markers)
    return SimulatedTrial(trial, q_wb, p_w, swaps)


def _motion(body: Skeleton, seconds: float, generator: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    ease = np.clip((times - _STANDING_S) / 0.5, 0.0, 1.0) ** 2
    waves = {}
    for joint in body.joints:
        if joint.distal < 0 or joint.proximal != body.parents[joint.distal]:
            continue
        angles = np.zeros((len(times), len(joint.angles)))
        for k, angle in enumerate(joint.angles):
            if angle.name in joint.free:
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
    """Plane of elevation, elevation, rotation of an arm."""
    swing = [
        np.sin(2 * np.pi * generator.uniform(0.2, 0.5) * times + generator.uniform(0, 6.28)) for _ in range(3)
    ]
    return np.stack([ease * 0.7 * swing[0], ease * (0.8 + 0.5 * swing[1]), ease * 0.4 * swing[2]], axis=1)


def _swap(
    markers: FloatArray, labels: tuple[str, ...], generator: np.random.Generator
) -> list[tuple[int, str, str]]:
    """Two markers change names for a fifth of a second, again and again; changes ``markers``."""
    pairs = [("LKNE", "LTHI"), ("RWRA", "RWRB"), ("LASI", "RASI"), ("RANK", "RHEE"), ("LFHD", "RFHD")]
    swaps = []
    for begin in range(200, len(markers) - 40, 60):
        a, b = pairs[int(generator.integers(len(pairs)))]
        i, j = labels.index(a), labels.index(b)
        for frame in range(begin, begin + 20):
            markers[frame, [i, j]] = markers[frame, [j, i]]
            swaps.append((frame, a, b))
    return swaps


def _cut_gaps(markers: FloatArray, generator: np.random.Generator) -> None:
    """Take out a tenth of all points, in gaps of 0.05 to 0.5 s; changes ``markers``."""
    n_frames, n_markers, _ = markers.shape
    wanted = GAPS * n_frames
    for m in range(n_markers):
        missing = 0
        while missing < wanted:
            length = int(generator.integers(5, 50))
            begin = int(generator.integers(150, n_frames - length))
            markers[begin : begin + length, m] = np.nan
            missing = int(np.isnan(markers[:, m, 0]).sum())


def shortened(trial: SimulatedTrial, first: int, last: int) -> SimulatedTrial:
    """Frames of a trial."""
    cut = slice(first, last)
    short = replace(trial.trial, positions=trial.trial.positions[cut])
    return SimulatedTrial(short, trial.q_wb[cut], trial.p_w[cut], [])
