"""The last seconds of two pose streams, to be compared again and again."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from gateway.agreement.agreement import Agreement
from gateway.agreement.tracks import OBSERVED, Tracks
from gateway.contract.messages import (
    STATUS_NAMES,
    BodyMessage,
    ComparedSegment,
    ComparisonMessage,
    PoseMessage,
)
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_MEASURED = frozenset(STATUS_NAMES[status] for status in OBSERVED)


class PoseWindow:
    """Poses of one gateway over the last ``window_s``; older ones are forgotten."""

    def __init__(self, window_s: float) -> None:
        self._window_ns = int(window_s * 1e9)
        self._poses: deque[PoseMessage] = deque()

    def add(self, pose: PoseMessage) -> None:
        """Add a pose; one that is not later than the last begins anew, as its gateway was restarted."""
        if self._poses and pose.t_ns <= self._poses[-1].t_ns:
            self._poses.clear()
        self._poses.append(pose)
        while pose.t_ns - self._poses[0].t_ns > self._window_ns:
            self._poses.popleft()

    @property
    def duration_s(self) -> float:
        """From the oldest to the newest."""
        return (self._poses[-1].t_ns - self._poses[0].t_ns) * 1e-9 if self._poses else 0.0

    @property
    def newest_ns(self) -> int:
        """Instant of the newest pose; 0: none."""
        return self._poses[-1].t_ns if self._poses else 0

    def tracks(self, body: BodyMessage, origin_ns: int) -> Tracks:
        """Return arrays, s since ``origin_ns``. Raises ``GatewayError`` for fewer than two poses."""
        poses = list(self._poses)
        if len(poses) < 2:
            raise GatewayError(f"body '{body.name}' has not moved yet: {len(poses)} poses have come")
        names = tuple(segment.name for segment in body.segments)
        time_s = np.array([(pose.t_ns - origin_ns) * 1e-9 for pose in poses])
        return Tracks(
            names=names,
            parents=tuple(names.index(each.parent) if each.parent else -1 for each in body.segments),
            time_s=time_s,
            q_wb=_array([[_orientation(pose, name) for name in names] for pose in poses], 4),
            p_w=_array([[(pose.position or {}).get(name) for name in names] for pose in poses], 3),
        )


def _orientation(pose: PoseMessage, segment: str) -> tuple[float, ...] | None:
    """Return the orientation where it was measured; None where it was only held or predicted."""
    return pose.segments.get(segment) if pose.status.get(segment) in _MEASURED else None


def _array(rows: list[list[tuple[float, ...] | None]], width: int) -> FloatArray:
    """Return (T, S, width); null is NaN."""
    unknown = (math.nan,) * width
    return np.array([[value or unknown for value in row] for row in rows], dtype=np.float64)


def comparison_message(found: Agreement, first_ns: int, second: str, window_s: float) -> ComparisonMessage:
    """Return what is published of it. first_ns: instant of the first's newest pose; second: name of that
    gateway."""
    return ComparisonMessage(
        t_ns=first_ns,
        second=second,
        window_s=window_s,
        lag_s=found.time.lag_s,
        correlation=found.time.correlation,
        heading_deg=found.heading_deg,
        segments={
            figures.segment: ComparedSegment(
                frames=figures.frames,
                rms_deg=_known(figures.rms_deg),
                inclination_rms_deg=_known(figures.inclination_rms_deg),
                heading_rms_deg=_known(figures.heading_rms_deg),
                axes_apart_deg=_known(figures.axes_apart_deg),
                position_rms_m=_known(figures.position_rms_m),
                own_heading_deg=figures.own_heading_deg,
            )
            for figures in found.segments
        },
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
