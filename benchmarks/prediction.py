"""How far predicted poses are off what then came, on real recordings; what a prediction costs.

Horizon by horizon each pose is extrapolated and compared with the one that the same method found for that
instant. Constants of the predictor were chosen on the recordings of the training part.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.joint_recordings import dressed, read_qmt
from benchmarks.never_worse import split
from benchmarks.never_worse.recordings import DATA, part
from benchmarks.synthetic_poses import frames_of, skeleton_of_size
from devices.deferred import Rotation
from devices.emulators.data_sets import read_hipose_mtw17
from devices.recorded_tracks import RecordedTracks
from gateway.body.skeleton import Skeleton
from gateway.emulation.recordings import solve, solved
from gateway.frames import FloatArray, SkeletonFrame
from gateway.outputs.prediction import PosePredictor

HORIZONS_S = (0.01, 0.02, 0.05)
METHOD = "joint"
SETTLED_AFTER_S = 6.0
QMT_S = 30.0
REPEATS = 300


class Motion(NamedTuple):
    """Poses of one recording, as the gateway gave them live."""

    skeleton: Skeleton
    frames: list[SkeletonFrame]
    rate_hz: float


class Errors(NamedTuple):
    """Of one recording and horizon, all segments together, degrees."""

    held: FloatArray
    """Of the pose as it is."""
    predicted: FloatArray
    sigma: FloatArray
    """By which predictions claim to be less certain than poses."""


def run() -> Report:
    """Every recording that is there, every horizon."""
    rows: list[list[str]] = []
    covered: list[tuple[float, int]] = []
    figures: list[Figure] = []
    for name, (part_of, get) in _motions().items():
        try:
            motion = get()
        except FileNotFoundError as error:
            print(f"skipped {name}: {error}")
            continue
        cells = []
        for ahead_s in HORIZONS_S:
            errors = errors_of(motion, ahead_s)
            within = float(np.mean(errors.predicted < 2 * errors.sigma))
            covered.append((within, len(errors.predicted)))
            cells.append(
                f"{_rms(errors.held):.2f} → {_rms(errors.predicted):.2f} / "
                f"{np.percentile(errors.predicted, 95):.2f} ({100 * within:.0f} %)"
            )
            if ahead_s == 0.02:
                note = f"{name}, {part_of}: RMS of predictions 20 ms ahead"
                key = name.partition(",")[0].replace(" ", "_")
                figures.append(Figure(f"predicted_{key}_deg", _rms(errors.predicted), "°", "", note))
        rows.append([name, part_of, f"{motion.rate_hz:.0f}", *cells])
    share = sum(within * n for within, n in covered) / sum(n for _, n in covered)
    figures.append(
        Figure("predicted_within_2_sigma", 100 * share, "%", ">=90", "errors below twice what sigma grew by")
    )
    figures.append(
        Figure(
            "prediction_17_us", cost_us(17), "µs", "<=150", "one prediction of 17 segments, least of 5 runs"
        )
    )
    heads = ["recording", "part", "Hz", *(f"{1000 * ahead_s:.0f} ms" for ahead_s in HORIZONS_S)]
    text = (
        "Degrees, all segments: RMS of the pose taken as it is → RMS / 95 % of predictions (share of errors "
        "below twice what sigma grew by). Live poses by `joint`. Written by `python -m benchmarks prediction "
        "--write-docs`.\n\n"
    )
    return Report("prediction", figures, [text + table(heads, rows)], also="guide/outputs.md")


def errors_of(motion: Motion, ahead_s: float) -> Errors:
    """Return the errors of predictions that far ahead."""
    frames = motion.frames
    predictor = PosePredictor(motion.skeleton, ahead_s)
    predictions = [predictor.predict(frame).frame for frame in frames]
    times = (np.array([frame.time_ns for frame in frames]) - frames[0].time_ns) * 1e-9
    q_wb, predicted = (np.stack([frame.q_wb for frame in each]) for each in (frames, predictions))
    grown = np.stack([frame.sigma for frame in predictions]) ** 2
    grown -= np.stack([frame.sigma for frame in frames]) ** 2
    scored = np.flatnonzero((times > SETTLED_AFTER_S) & (times + ahead_s < times[-1]))
    later = _between(times, q_wb, times[scored] + ahead_s)
    known = np.isfinite(predicted[scored] * q_wb[scored] * later).all(axis=2)
    truth = Rotation.from_quat(later[known], scalar_first=True).inv()
    held, found = (
        np.degrees((truth * Rotation.from_quat(each[scored][known], scalar_first=True)).magnitude())
        for each in (q_wb, predicted)
    )
    return Errors(held, found, np.degrees(np.sqrt(np.maximum(grown[scored][known], 0.0))))


def _between(times: FloatArray, q_wb: FloatArray, wanted: FloatArray) -> FloatArray:
    """(n, S, 4) orientations at times between those of the frames; NaN where a neighbour is not known."""
    before = np.clip(np.searchsorted(times, wanted) - 1, 0, len(times) - 2)
    share = ((wanted - times[before]) / (times[before + 1] - times[before]))[:, None, None]
    first, second = q_wb[before], q_wb[before + 1]
    known = np.isfinite(first * second).all(axis=2)
    found = np.full_like(first, np.nan)
    start, end = (Rotation.from_quat(each[known], scalar_first=True) for each in (first, second))
    weights = np.broadcast_to(share, (*known.shape, 1))[known]
    turn = Rotation.from_rotvec((start.inv() * end).as_rotvec() * weights)
    found[known] = (start * turn).as_quat(scalar_first=True)
    return found


def cost_us(n_segments: int) -> float:
    """Processor time of one prediction, µs."""
    skeleton = skeleton_of_size(n_segments)
    frames = [frames_of(skeleton)(k) for k in range(REPEATS)]
    found = []
    for _ in range(5):
        predictor = PosePredictor(skeleton, 0.02)
        begun = time.process_time()
        for frame in frames:
            predictor.predict(frame)
        found.append((time.process_time() - begun) / REPEATS * 1e6)
    return min(found)


def _motions() -> dict[str, tuple[str, Callable[[], Motion]]]:
    training, validation = "training", "validation"
    return {
        "hipose, 17 modules on a person": (
            training,
            lambda: _whole_body(read_hipose_mtw17(DATA / "hipose_mtw17")),
        ),
        "ring_rigid, chain of 5": (training, lambda: _case("ring_rigid")),
        "broad_02, slow rotation by hand": (training, lambda: _case("broad_02")),
        "broad_21, fast motion by hand": (training, lambda: _case("broad_21")),
        "tstick_11, a stick in the hand": (training, lambda: _case("tstick_11")),
        "qmt, 15 modules on a person": (
            validation,
            lambda: _whole_body(part(read_qmt(_qmt_file()), 0.0, QMT_S)),
        ),
        "pendulum_reversed, chain of 3": (validation, lambda: _case("pendulum_reversed")),
        "foot_left, a foot that walks": (validation, lambda: _case("foot_left")),
        "foot_right, a foot that walks": (validation, lambda: _case("foot_right")),
    }


def _qmt_file() -> Path:
    found = sorted((DATA / "qmt_fullbody16").glob("*.mat"))
    if not found:
        raise FileNotFoundError(DATA / "qmt_fullbody16")
    return found[0]


def _whole_body(recording: RecordedTracks) -> Motion:
    suit = dressed(recording)
    return Motion(suit.skeleton, solve(recording, suit, METHOD), recording.sampling_rate_hz)


def _case(name: str) -> Motion:
    case = split.case(name)
    frames = solved(METHOD, case.suit, case.interval_s, case.frames)
    return Motion(case.suit.skeleton, frames, 1.0 / case.interval_s)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))
