"""How two results of one session differ, in degrees by segment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray
from gateway.geometry.comparison import orientation_error
from gateway.recording.arrays import SkeletonArrays


@dataclass(frozen=True)
class SegmentDifference:
    """Angles between two orientations of one segment, degrees; NaN without a common frame."""

    segment: str
    frames: int
    """In which both results know the segment."""
    mean_deg: float
    rms_deg: float
    p95_deg: float
    max_deg: float
    inclination_rms_deg: float
    heading_rms_deg: float


@dataclass(frozen=True)
class Difference:
    """Two results side by side, over the frames and segments that both have."""

    time_s: FloatArray  # (F,) since the first common frame
    angle_deg: FloatArray  # (F, S)
    segments: tuple[SegmentDifference, ...]
    only_in_first: tuple[str, ...]
    only_in_second: tuple[str, ...]

    @property
    def segment_names(self) -> tuple[str, ...]:
        """Names of the segments that were compared."""
        return tuple(figures.segment for figures in self.segments)


def difference(first: SkeletonArrays, second: SkeletonArrays) -> Difference:
    """Compare ``first`` against ``second``. Frames belong together by time, within half a frame interval.

    Raises ``GatewayError`` when the two have no segment or no instant in common, or know no segment there.
    """
    names = tuple(name for name in first.segment_names if name in second.segment_names)
    if not names:
        raise GatewayError(
            f"the two have no segment in common: '{first.skeleton.name}' and '{second.skeleton.name}'"
        )
    rows_a, rows_b = _together(first, second)
    if len(rows_a) == 0:
        raise GatewayError("the two have no instant in common: are they results of one session?")
    q_a = first.q_wb[rows_a][:, [first.skeleton.index(name) for name in names]]
    q_b = second.q_wb[rows_b][:, [second.skeleton.index(name) for name in names]]
    errors = np.degrees(np.stack(orientation_error(q_a, q_b)))  # (3, F, S)
    if np.isnan(errors[0]).all():
        raise GatewayError("no segment is known in both at any common instant: nothing to compare")
    time_ns = first.time_ns[rows_a]
    return Difference(
        time_s=(time_ns - time_ns[0]) * 1e-9,
        angle_deg=errors[0],
        segments=tuple(_figures(name, errors[:, :, i]) for i, name in enumerate(names)),
        only_in_first=tuple(name for name in first.segment_names if name not in names),
        only_in_second=tuple(name for name in second.segment_names if name not in names),
    )


def _together(first: SkeletonArrays, second: SkeletonArrays) -> tuple[IntArray, IntArray]:
    """Return rows of frames that belong together, each used once."""
    rates = [arrays.rate_hz for arrays in (first, second) if arrays.rate_hz]
    # Frames farther apart than half an interval are of different instants.
    tolerance_ns = 0.5e9 / max(rates) if rates else 0.0
    order = np.argsort(second.time_ns, kind="stable")
    times = second.time_ns[order]
    after = np.clip(np.searchsorted(times, first.time_ns), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    is_nearer = np.abs(times[after] - first.time_ns) < np.abs(times[before] - first.time_ns)
    nearest = np.where(is_nearer, after, before)
    distance = np.abs(times[nearest] - first.time_ns)
    rows_a = np.flatnonzero(distance <= tolerance_ns)
    # Of frames with the same neighbour, the first takes it.
    _, kept = np.unique(nearest[rows_a], return_index=True)
    rows_a = rows_a[np.sort(kept)]
    return rows_a, order[nearest[rows_a]]


def _figures(name: str, errors_deg: FloatArray) -> SegmentDifference:
    """Return the figures of one segment from errors (3, F): total, inclination, heading, degrees."""
    known = errors_deg[:, ~np.isnan(errors_deg[0])]
    if known.shape[1] == 0:
        return SegmentDifference(name, 0, *(float("nan"),) * 6)
    total = known[0]
    rms = np.sqrt(np.mean(np.square(known), axis=1))
    return SegmentDifference(
        segment=name,
        frames=known.shape[1],
        mean_deg=float(total.mean()),
        rms_deg=float(rms[0]),
        p95_deg=float(np.percentile(total, 95)),
        max_deg=float(total.max()),
        inclination_rms_deg=float(rms[1]),
        heading_rms_deg=float(rms[2]),
    )
