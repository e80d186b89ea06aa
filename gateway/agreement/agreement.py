"""Figures of how well two sources agree on one motion, by segment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from devices.deferred import Rotation
from gateway.agreement.time_alignment import TimeAlignment, align_time
from gateway.agreement.tracks import Tracks, pairs_of, resampled, selected
from gateway.agreement.world_alignment import (
    WorldAlignment,
    align_segments,
    align_world,
    aligned,
    place_aligned,
)
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry.comparison import orientation_error


@dataclass(frozen=True)
class SegmentAgreement:
    """The first's orientations of one segment against the second's, degrees; NaN: no instant in common."""

    segment: str
    second_segment: str
    frames: int
    as_defined_rms_deg: float
    """After one heading for all: constant differences of the two's segment axes count."""
    axes_apart_deg: float
    """That constant difference; the figures below are without it."""
    rms_deg: float
    inclination_rms_deg: float
    heading_rms_deg: float
    p95_deg: float
    max_deg: float
    joint_rms_deg: float
    """Of the rotation against the parent segment; NaN for one that has none."""
    position_rms_m: float
    """Of the proximal joint, the whole body turned about the vertical and moved once."""
    own_heading_deg: float = 0.0
    """Of the segment beside the common heading, taken off too; 0 with one heading for all."""


@dataclass(frozen=True)
class Agreement:
    """Two sources side by side. Instants are the second's, on the first's clock."""

    time: TimeAlignment
    heading_deg: float
    """From the first's world to the second's, about the vertical."""
    time_s: FloatArray  # (T,)
    angle_deg: FloatArray  # (T, S) after the constant differences are taken off
    segments: tuple[SegmentAgreement, ...]
    only_in_first: tuple[str, ...]
    only_in_second: tuple[str, ...]

    @property
    def segment_names(self) -> tuple[str, ...]:
        """The first's names of what was compared."""
        return tuple(figures.segment for figures in self.segments)


def agreement(
    first: Tracks,
    second: Tracks,
    renamed: Mapping[str, str] | None = None,
    largest_lag_s: float | None = None,
    span_s: tuple[float, float] | None = None,
    *,
    own_headings: bool = False,
) -> Agreement:
    """Compare two sources of one motion, each on its own clock and in its own world (Z up).

    renamed: the first's segments that the second calls otherwise. largest_lag_s: see ``align_time``.
    span_s: only from then to then of the first counts, s from its beginning; clocks are aligned by all.
    own_headings: a heading for every segment, in the place of one for all.
    Raises ``GatewayError`` when they have no segment, no time or no motion in common.
    """
    pairs = pairs_of(first, second, renamed or {})
    one = selected(first, [name for name, _ in pairs])
    other = selected(second, [name for _, name in pairs])
    time = align_time(one, other, largest_lag_s)
    on_second = time.of_second(one.time_s)
    counts = (on_second >= other.time_s[0]) & (on_second <= other.time_s[-1])
    if span_s is not None:
        elapsed = one.time_s - one.time_s[0]
        counts &= (elapsed >= span_s[0]) & (elapsed <= span_s[1])
    instants = one.time_s[counts]
    if len(instants) < 2:
        where = "" if span_s is None else f" from {span_s[0]:g} to {span_s[1]:g} s"
        raise GatewayError(f"the two have too little time in common{where} to be compared")
    one, other = resampled(one, instants), resampled(other, time.of_second(instants))
    align = align_segments if own_headings else align_world
    as_defined = align(one.q_wb, other.q_wb, with_mounting=False)
    mounted = align(one.q_wb, other.q_wb)
    q = aligned(one.q_wb, mounted)
    p = place_aligned(one.p_w, other.p_w)
    raw = orientation_error(aligned(one.q_wb, as_defined), other.q_wb).total
    errors = np.degrees(np.stack(orientation_error(q, other.q_wb)))
    joints = np.degrees(_joint_errors(q, other.q_wb, one.parents))
    apart = np.linalg.norm(p - other.p_w, axis=2)
    return Agreement(
        time=time,
        heading_deg=float(np.degrees(mounted.heading_rad)),
        time_s=instants,
        angle_deg=errors[0],
        segments=tuple(
            _figures(pair, np.degrees(raw[:, s]), mounted, s, errors[:, :, s], joints[:, s], apart[:, s])
            for s, pair in enumerate(pairs)
        ),
        only_in_first=tuple(name for name in first.names if name not in one.names),
        only_in_second=tuple(name for name in second.names if name not in other.names),
    )


def _joint_errors(q: FloatArray, q_reference: FloatArray, parents: tuple[int, ...]) -> FloatArray:
    """Return (T, S) rad between the rotations against the parent; NaN without one."""
    result = np.full(q.shape[:2], np.nan)
    for s, parent in enumerate(parents):
        if parent >= 0:
            relative = [_relative(array[:, parent], array[:, s]) for array in (q, q_reference)]
            result[:, s] = orientation_error(relative[0], relative[1]).total
    return result


def _relative(q_parent: FloatArray, q_child: FloatArray) -> FloatArray:
    known = np.isfinite(q_parent).all(axis=1) & np.isfinite(q_child).all(axis=1)
    result = np.full(q_child.shape, np.nan)
    if known.any():
        parent, child = (Rotation.from_quat(q[known], scalar_first=True) for q in (q_parent, q_child))
        result[known] = (parent.inv() * child).as_quat(scalar_first=True)
    return result


def _figures(
    pair: tuple[str, str],
    raw_deg: FloatArray,
    mounted: WorldAlignment,
    s: int,
    errors_deg: FloatArray,
    joint_deg: FloatArray,
    apart_m: FloatArray,
) -> SegmentAgreement:
    """Return the figures of one segment from errors (3, T): total, inclination, heading, °."""
    known = np.isfinite(errors_deg[0])
    if not known.any():
        return SegmentAgreement(*pair, 0, *(float("nan"),) * 9)
    total, inclination, heading = errors_deg[:, known]
    return SegmentAgreement(
        *pair,
        frames=int(known.sum()),
        as_defined_rms_deg=_rms(raw_deg),
        axes_apart_deg=float(
            np.degrees(Rotation.from_quat(mounted.mounting[s], scalar_first=True).magnitude())
        ),
        rms_deg=_rms(total),
        inclination_rms_deg=_rms(inclination),
        heading_rms_deg=_rms(heading),
        p95_deg=float(np.percentile(total, 95)),
        max_deg=float(total.max()),
        joint_rms_deg=_rms(joint_deg),
        position_rms_m=_rms(apart_m),
        own_heading_deg=float(np.degrees(mounted.own_heading[s])),
    )


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else float("nan")
