"""Skeleton frames as arrays over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import compress, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray, MarkerFit, SkeletonFrame, StatusArray

_AT_ONCE = 1024
_MADE_UP_AT_MOST, _MADE_UP_AT_LEAST = 10, 100_000
"""Frames that may be interpolated: so many for each that was recorded, and so many anyway."""
_STACKED = ("q_wb", "p_w", "angular_rate", "joint_acceleration", "sigma", "status")


@dataclass(frozen=True)
class MarkerArrays:
    """What became of M markers in F frames, those of the skeleton: world axes, m."""

    labels: tuple[str, ...]
    positions: FloatArray  # (F, M, 3) after names were put right; NaN: not seen, or not recorded
    virtual: FloatArray  # (F, M, 3) where the body has them
    used: NDArray[np.bool_]  # (F, M) had a say in the pose
    unlabelled: tuple[FloatArray, ...]  # F times (n, 3)

    @property
    def residuals(self) -> FloatArray:
        """(F, M) m; NaN where not seen."""
        apart: FloatArray = np.linalg.norm(self.positions - self.virtual, axis=2)
        return apart


@dataclass(frozen=True)
class SkeletonArrays:
    """F frames of S segments. NaN where a value is not defined; SI units, world ENU."""

    time_ns: IntArray  # (F,) gateway time of the measurement
    sequence: IntArray  # (F,) frame number; a gap means frames that were not recorded
    q_wb: FloatArray  # (F, S, 4) segment to world, w x y z
    p_w: FloatArray  # (F, S, 3) m, proximal joint
    angular_rate: FloatArray  # (F, S, 3) rad/s, segment axes
    joint_acceleration: FloatArray  # (F, S, 3) m/s², proximal joint, world axes, without gravity
    sigma: FloatArray  # (F, S) rad, standard deviation of the orientation
    status: StatusArray  # (F, S) Status
    skeleton: Skeleton
    markers: MarkerArrays | None = None
    """Of poses made from markers, where that was recorded."""
    origin_ns: int | None = None
    """Gateway time of 0 s of the files that the poses were made from; None: they came live."""

    @property
    def segment_names(self) -> tuple[str, ...]:
        """Names of the segments, in the order of the second axis."""
        return self.skeleton.segment_names

    @property
    def time_s(self) -> FloatArray:
        """(F,) since the first frame, s."""
        elapsed: FloatArray = (self.time_ns - self.time_ns[0]) * 1e-9
        return elapsed

    @property
    def rate_hz(self) -> float:
        """Frames a second, by the median interval; 0 with fewer than two instants."""
        intervals = np.diff(self.time_ns)
        onward = intervals[intervals > 0]
        return _exact(1e9 / float(np.median(onward))) if len(onward) else 0.0

    def only(self, kept: NDArray[np.bool_]) -> SkeletonArrays:
        """Return some of the frames. kept: (F,)."""
        fields: dict[str, Any] = {
            name: getattr(self, name)[kept] for name in ("time_ns", "sequence", *_STACKED)
        }
        if self.markers is not None:
            markers = self.markers
            fields["markers"] = MarkerArrays(
                markers.labels,
                markers.positions[kept],
                markers.virtual[kept],
                markers.used[kept],
                tuple(compress(markers.unlabelled, kept)),
            )
        return replace(self, **fields)

    @property
    def begins_s(self) -> float:
        """Of the first frame, by the time of the files that it was made from; 0 where it came live."""
        return 0.0 if self.origin_ns is None else float(self.time_ns[0] - self.origin_ns) * 1e-9


def refuse_pauses(time_ns: IntArray, name: str) -> None:
    """Raise ``GatewayError`` for instants (F,) that go on, but next to nothing of whose time was recorded.

    At a regular rate that would take memory without end. name: what errors call it.
    """
    intervals = np.diff(time_ns)
    n_regular = round((time_ns[-1] - time_ns[0]) / float(np.median(intervals))) + 1
    if n_regular > max(_MADE_UP_AT_MOST * len(time_ns), _MADE_UP_AT_LEAST):
        longest = int(np.argmax(intervals))
        begins_s, lasts_s = (time_ns[longest] - time_ns[0]) * 1e-9, intervals[longest] * 1e-9
        raise GatewayError(
            f"{name}: {len(time_ns)} of {n_regular} frames were recorded, nothing from {begins_s:.0f} s on "
            f"for {lasts_s:.0f} s: so much cannot be interpolated; end the recording before a pause"
        )


def _exact(rate_hz: float) -> float:
    """Return the shortest decimal number whose interval is within 1 ns of that of a rate."""
    for decimals in range(9):
        rounded = round(rate_hz, decimals)
        if abs(rounded - rate_hz) <= 1e-9 * rate_hz * rate_hz:
            return rounded
    return rate_hz


def arrays_of(frames: Iterable[SkeletonFrame], skeleton: Skeleton) -> SkeletonArrays | None:
    """Return frames of one skeleton stacked; None when there are none.

    Raises ``ValueError`` for a frame of another number of segments.
    """
    remaining = iter(frames)
    # Frames take several times the memory of their numbers: some at a time are stacked.
    pieces = [_stacked(some, skeleton) for some in iter(lambda: list(islice(remaining, _AT_ONCE)), [])]
    if not pieces:
        return None
    joined: dict[str, Any] = {
        name: np.concatenate([piece.pop(name) for piece in pieces]) for name in list(pieces[0])
    }
    return SkeletonArrays(skeleton=skeleton, **joined)


def _stacked(frames: list[SkeletonFrame], skeleton: Skeleton) -> dict[str, Any]:
    """Return the fields of ``SkeletonArrays`` for some frames."""
    # A recording may hold poses of two suits, as after a reload; they cannot be stacked.
    odd = next((frame for frame in frames if len(frame.status) != skeleton.n_segments), None)
    if odd is not None:
        raise ValueError(
            f"frame {odd.sequence} has {len(odd.status)} segments, skeleton '{skeleton.name}' "
            f"{skeleton.n_segments}"
        )
    return {
        "time_ns": np.array([frame.time_ns for frame in frames], dtype=np.int64),
        "sequence": np.array([frame.sequence for frame in frames], dtype=np.int64),
    } | {name: np.stack([getattr(frame, name) for frame in frames]) for name in _STACKED}


def marker_arrays(
    labels: tuple[str, ...], time_ns: IntArray, fits: Mapping[int, MarkerFit]
) -> MarkerArrays | None:
    """Return the fits by instant stacked for the frames at ``time_ns`` (F,); None when there is none.

    One of another number of markers is left out.
    """
    n_frames, n = len(time_ns), len(labels)
    positions, virtual = np.full((n_frames, n, 3), np.nan), np.full((n_frames, n, 3), np.nan)
    used = np.zeros((n_frames, n), dtype=bool)
    nameless = [np.zeros((0, 3))] * n_frames
    found = [(row, fits[instant]) for row, instant in enumerate(time_ns.tolist()) if instant in fits]
    for row, fit in found:
        if len(fit.used) == n:
            positions[row], virtual[row], used[row] = fit.positions, fit.virtual, fit.used
            nameless[row] = fit.unlabelled
    return MarkerArrays(labels, positions, virtual, used, tuple(nameless)) if found else None
