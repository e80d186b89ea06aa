"""Two real feet with modules and markers (gaitmap's example): stance detection and strides."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Skeleton, WornSuit, field_vector
from gateway.frames import FloatArray, ImuFrame
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.inertial.contacts import initial_stance, watch_stance
from gateway.reconstruction.inertial.observations import SegmentObservations

RATE_HZ = 204.8
MARKER_RATE_HZ = 100.0
SLOW = 0.2
"""m/s: all markers of a foot at rest are slower."""
SHORTEST_STANCE_S = 0.1
FIRST_MARKER_COLUMNS = {"left": (1, 7, 16), "right": (4, 10, 13)}  # toe, heel, ball; x of each


class FootRecording(NamedTuple):
    """One foot; the markers at the module's samples."""

    force: FloatArray  # (n, 3) m/s², sensor axes, z up in standing
    rate: FloatArray  # (n, 3) rad/s
    speed: FloatArray  # (n,) m/s of the fastest marker
    place: FloatArray  # (n, 3) m, mean of the markers


class FootResult(NamedTuple):
    """How well stances and strides are found."""

    precision: float
    recall: float
    begin_late_ms: float
    end_late_ms: float
    strides: float
    distance_m: float
    distance_error_percent: float
    stride_rmse_mm: float

    @staticmethod
    def heads() -> list[str]:
        """Columns of the table."""
        return [
            "precision", "recall", "begin late by ms (median)", "end late by ms (median)", "strides",
            "distance m", "distance error %", "stride RMSE mm",
        ]  # fmt: skip

    @staticmethod
    def digits() -> tuple[int, ...]:
        """Decimals of the columns."""
        return 3, 3, 0, 0, 0, 2, 2, 0


def read_foot(folder: Path, side: str) -> FootRecording:
    """side: left or right. Raises ``FileNotFoundError``."""
    imu = np.genfromtxt(folder / "imu_sample.csv", delimiter=",", skip_header=2)
    markers = np.genfromtxt(folder / "mocap_sample.csv", delimiter=",", skip_header=2)
    first = 1 if side == "left" else 2
    times, marker_times = np.arange(len(imu)) / RATE_HZ, np.arange(len(markers)) / MARKER_RATE_HZ
    places = np.stack([markers[:, c : c + 3] / 1000.0 for c in FIRST_MARKER_COLUMNS[side]])
    speeds = np.linalg.norm(np.gradient(places, 1.0 / MARKER_RATE_HZ, axis=1), axis=2)
    middle = places.mean(axis=0)
    return FootRecording(
        force=imu[:, first : first + 6 : 2],
        rate=np.radians(imu[:, first + 6 : first + 12 : 2]),
        speed=np.interp(times, marker_times, speeds.max(axis=0)),
        place=np.stack([np.interp(times, marker_times, middle[:, i]) for i in range(3)], axis=1),
    )


def stances(foot: FootRecording) -> FloatArray:
    """(n,) for how long the foot has been found at rest, s."""
    state, n = initial_stance(1), len(foot.force)
    carries, measured = np.ones(1), np.zeros(1, np.uint8)
    rested = np.zeros((n, 1))
    for k, stood_s in enumerate(rested):
        force, rate = foot.force[k : k + 1], foot.rate[k : k + 1]
        observed = SegmentObservations(force, rate, force, measured, measured)
        watch_stance(stood_s, state, carries, 9.81, observed, 1.0 / RATE_HZ)
    return rested[:, 0]


def measure_foot(foot: FootRecording, method: str) -> FootResult:
    """Detection against the markers' speed; strides, by a reconstructor, against their way."""
    found, true = stances(foot) > 0.0, foot.speed < SLOW
    begin, end = _delays_ms(found, true)
    walked = _walked(foot, method)
    middles = [int(np.mean(run)) for run in _runs(found)]
    strides, true_strides = (
        np.linalg.norm(np.diff(place[middles, :2], axis=0), axis=1) for place in (walked, foot.place)
    )
    distance = float(true_strides.sum())
    return FootResult(
        precision=float(np.mean(true[found])),
        recall=float(np.mean(found[true])),
        begin_late_ms=begin,
        end_late_ms=end,
        strides=float(np.sum(true_strides > 0.3)),
        distance_m=distance,
        distance_error_percent=100.0 * (float(strides.sum()) / distance - 1.0),
        stride_rmse_mm=1000.0 * float(np.sqrt(np.mean((strides - true_strides) ** 2))),
    )


def _walked(foot: FootRecording, method: str) -> FloatArray:
    """(n, 3) m: where the foot is by its module alone."""
    skeleton = Skeleton(
        "foot", ("foot",), np.array([-1]), np.zeros((1, 3)), np.zeros((1, 3)), contacts=((0, np.zeros(3)),)
    )
    suit = WornSuit(
        skeleton,
        module_ids=(0,),
        module_of_segment=np.zeros(1, np.int64),
        sensor_to_segment=np.array([[1.0, 0.0, 0.0, 0.0]]),
        lever_arms=np.array([[0.0, 0.0, 0.06]]),
        local_devices=(),
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field_vector(50.0, 65.0),
    )
    reconstructor = create_reconstructor(method, suit, 1.0 / RATE_HZ)
    none, measured, field = np.zeros(1, np.int64), np.zeros(1, np.uint8), np.full((1, 3), np.nan)
    frames = (
        ImuFrame(k, round(k * 1e9 / RATE_HZ), f[None], w[None], field, measured, none)
        for k, (f, w) in enumerate(zip(foot.force, foot.rate, strict=True))
    )
    return np.array([reconstructor.update(frame).p_w[0] for frame in frames])


def _runs(flags: FloatArray) -> list[FloatArray]:
    """Indices of each stretch of true flags that lasts."""
    edges = np.flatnonzero(np.diff(flags.astype(int))) + 1
    stretches = np.split(np.arange(len(flags)), edges)
    return [s for s in stretches if flags[s[0]] and len(s) > SHORTEST_STANCE_S * RATE_HZ]


def _delays_ms(found: FloatArray, true: FloatArray) -> tuple[float, float]:
    """By how much found stances begin and end after the true ones they lie in, medians."""
    begins, ends = [], []
    for run in _runs(true):
        inside = run[found[run]]
        if len(inside):
            begins.append(inside[0] - run[0])
            ends.append(inside[-1] - run[-1])
    return tuple(1000.0 * float(np.median(part)) / RATE_HZ for part in (begins, ends))  # type: ignore[return-value]
