"""Strides: from one strike of a foot to its next, joint angles and torques by percent of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from devices.normal_gait import normal_gait
from gateway.analysis.floor import FloorForces
from gateway.analysis.gait import gait_events
from gateway.body.inertia import part_name
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray

PERCENT = np.linspace(0.0, 100.0, 101)
"""Of a stride, from heel strike on."""
_SHORTEST_S, _LONGEST_S = 0.4, 3.0
"""What lasts less or longer is no stride of somebody who walks or runs."""


class Stride(NamedTuple):
    """A foot's strike, when it lifts off, and its next strike."""

    foot: str
    start_s: float
    off_s: float
    end_s: float
    length_m: float
    """Over ground, of the foot's way."""
    source: str
    """Where the force came from that tells the strike: ``measured`` or ``estimated``."""

    @property
    def duration_s(self) -> float:
        """From one foot contact to the next of the same foot, s."""
        return self.end_s - self.start_s

    @property
    def stance_percent(self) -> float:
        """Share of the stride in which the foot is on the ground, %."""
        return 100.0 * (self.off_s - self.start_s) / self.duration_s

    @property
    def speed_m_per_s(self) -> float:
        """Mean walking speed over the stride, m/s."""
        return self.length_m / self.duration_s

    def percent_at(self, time_s: float) -> float:
        """Return where in the stride an instant lies."""
        return 100.0 * (time_s - self.start_s) / self.duration_s


@dataclass(frozen=True)
class Cycles:
    """Curves of one quantity over N strides of one side."""

    curves: FloatArray  # (N, 101)

    @property
    def mean(self) -> FloatArray:
        """(101,), NaN where fewer than one stride knows it."""
        known = np.isfinite(self.curves)
        total: FloatArray = np.where(known, self.curves, 0.0).sum(axis=0)
        return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)

    @property
    def deviation(self) -> FloatArray:
        """(101,) standard deviation between strides, NaN where fewer than two know it."""
        known = np.isfinite(self.curves)
        count = known.sum(axis=0)
        squares = np.where(known, (self.curves - self.mean) ** 2, 0.0).sum(axis=0)
        deviation: FloatArray = np.sqrt(squares / np.maximum(count - 1, 1))
        return np.where(count > 1, deviation, np.nan)


def strides(
    skeleton: Skeleton, floor: FloorForces, time_s: FloatArray, p_w: FloatArray
) -> tuple[Stride, ...]:
    """Return all strides in the order of time. p_w: (F, S, 3) m, proximal joints in the world."""
    events = gait_events(skeleton, floor, time_s)
    found = []
    for foot in dict.fromkeys(event.foot for event in events):
        own = [event for event in events if event.foot == foot]
        for strike, off, following in zip(own, own[1:], own[2:], strict=False):
            if (strike.event, off.event, following.event) != ("strike", "off", "strike"):
                continue
            if _SHORTEST_S <= following.time_s - strike.time_s <= _LONGEST_S:
                frames = np.searchsorted(time_s, [strike.time_s, following.time_s])
                way = np.diff(p_w[frames, skeleton.index(foot), :2], axis=0)
                length_m = float(np.linalg.norm(way))
                found.append(
                    Stride(foot, strike.time_s, off.time_s, following.time_s, length_m, strike.source)
                )
    return tuple(sorted(found, key=lambda stride: stride.start_s))


def stance_spans(
    skeleton: Skeleton, floor: FloorForces, time_s: FloatArray
) -> dict[str, list[tuple[float, float]]]:
    """Return from when until when each foot stands, s, by its name; as far as strikes and offs are known."""
    spans: dict[str, list[tuple[float, float]]] = {}
    for event in gait_events(skeleton, floor, time_s):
        own = spans.setdefault(event.foot, [])
        if event.event == "strike":
            own.append((event.time_s, float(time_s[-1])))
        elif own:
            own[-1] = (own[-1][0], event.time_s)
        else:
            own.append((float(time_s[0]), event.time_s))
    return spans


def cycles(values: FloatArray, time_s: FloatArray, own: Sequence[Stride]) -> Cycles:
    """Return values (F,) over the strides of one foot; NaN stays where it is."""
    curves = [
        np.interp(stride.start_s + 0.01 * PERCENT * stride.duration_s, time_s, values) for stride in own
    ]
    return Cycles(np.array(curves).reshape(-1, len(PERCENT)))


def foot_of(skeleton: Skeleton, joint: int) -> str | None:
    """Return the foot whose strides a joint's curves are told by: that at the end of its limb; None for
    others."""
    names = skeleton.segment_names
    segment = skeleton.joints[joint].distal
    for s, name in enumerate(names):
        if part_name(name) == "foot" and segment in _way_to_root(skeleton, s):
            return name if _side(names[segment]) else None
    return None


def _way_to_root(skeleton: Skeleton, segment: int) -> Iterator[int]:
    while segment >= 0:
        yield segment
        segment = int(skeleton.parents[segment])


def _side(name: str) -> str:
    return next((side for side in ("left", "right") if name.startswith(f"{side}_")), "")


def normal_band(joint: str, angle: str) -> FloatArray | None:
    """Return (51, 3) percent, mean and standard deviation of published gait, degrees; None where there is
    none."""
    published: Mapping[str, FloatArray] = normal_gait()
    return published.get(f"{joint.removeprefix('left_').removeprefix('right_')}_{angle}")
