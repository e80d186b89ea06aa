"""Orientations and positions by segment over time, on any clock; resampled to common instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from devices.deferred import Rotation
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray, Status
from gateway.recording.arrays import SkeletonArrays, refuse_pauses

OBSERVED = (Status.MEASURED, Status.INTERPOLATED, Status.UNAIDED)
"""Of an orientation that was seen: others say nothing against or for another source."""
LONGEST_GAP_S = 0.1
"""What is not known for longer is not interpolated."""


@dataclass(frozen=True)
class Tracks:
    """T instants of S segments, world Z up. NaN where not known."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Of every segment among these, -1 for one that has none."""
    time_s: FloatArray  # (T,) increasing
    q_wb: FloatArray  # (T, S, 4) segment to world, wxyz
    p_w: FloatArray  # (T, S, 3) m, proximal joint

    @property
    def duration_s(self) -> float:
        """From the first instant to the last."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def rate_hz(self) -> float:
        """Instants a second, by the median interval."""
        return 1.0 / float(np.median(np.diff(self.time_s)))


def tracks_of(arrays: SkeletonArrays, origin_ns: int, source: str) -> Tracks:
    """Return recorded poses, seconds since ``origin_ns``; repeated instants once. Orientations that were only
    held or predicted (hidden markers, a silent module) are not known.

    source: what errors call it. Raises ``GatewayError`` for fewer than two instants, and where next to
    nothing of the time was recorded.
    """
    time_ns, kept = np.unique(arrays.time_ns, return_index=True)
    if len(time_ns) < 2:
        raise GatewayError(f"{source} has {len(time_ns)} poses: nothing to compare")
    refuse_pauses(time_ns, source)
    time_s = np.asarray((time_ns - origin_ns) * 1e-9, dtype=np.float64)
    return Tracks(
        names=arrays.segment_names,
        parents=tuple(arrays.skeleton.parents.tolist()),
        time_s=time_s,
        q_wb=np.where(np.isin(arrays.status[kept], OBSERVED)[..., None], arrays.q_wb[kept], np.nan),
        p_w=arrays.p_w[kept],
    )


def selected(tracks: Tracks, names: Sequence[str]) -> Tracks:
    """Return these segments only, in this order; a parent that is left out is replaced by its own."""
    columns = [tracks.names.index(name) for name in names]

    def kept_parent(segment: int) -> int:
        parent = tracks.parents[segment]
        while parent >= 0 and parent not in columns:
            parent = tracks.parents[parent]
        return columns.index(parent) if parent >= 0 else -1

    return Tracks(
        names=tuple(names),
        parents=tuple(kept_parent(column) for column in columns),
        time_s=tracks.time_s,
        q_wb=tracks.q_wb[:, columns],
        p_w=tracks.p_w[:, columns],
    )


def pairs_of(first: Tracks, second: Tracks, renamed: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return segments that belong together: by ``renamed`` (first's name → second's), else by equal names.

    Raises ``GatewayError`` when a name is not there, or nothing belongs together.
    """
    for name, other in renamed.items():
        for tracks, wanted in ((first, name), (second, other)):
            if wanted not in tracks.names:
                raise GatewayError(
                    f"--pair {name}={other}: no segment '{wanted}'; there are {', '.join(tracks.names)}"
                )
    wished = {name: renamed.get(name, name) for name in first.names}
    pairs = [(name, other) for name, other in wished.items() if other in second.names]
    if not pairs:
        raise GatewayError(
            f"no segment has the same name in both: {', '.join(first.names)}; and {', '.join(second.names)}. "
            "Name those that belong together, such as --pair thigh=left_thigh"
        )
    return pairs


def resampled(tracks: Tracks, time_s: FloatArray) -> Tracks:
    """Return tracks at other instants: shortest rotations between orientations, lines between positions."""
    q = np.stack([_q_at(tracks.time_s, tracks.q_wb[:, s], time_s) for s in range(len(tracks.names))], axis=1)
    p = np.stack([_p_at(tracks.time_s, tracks.p_w[:, s], time_s) for s in range(len(tracks.names))], axis=1)
    return Tracks(tracks.names, tracks.parents, time_s, q, p)


def _neighbours(times: FloatArray, time_s: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return index of the instants before and after, and the weight of the latter; NaN weight across gaps."""
    after: IntArray = np.clip(np.searchsorted(times, time_s), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    weight = (time_s - times[after - 1]) / gap
    outside = (weight < -1e-9) | (weight > 1.0 + 1e-9) | (gap > LONGEST_GAP_S)
    return after - 1, after, np.where(outside, np.nan, np.clip(weight, 0.0, 1.0))


def _q_at(times: FloatArray, q: FloatArray, time_s: FloatArray) -> FloatArray:
    result = np.full((len(time_s), 4), np.nan)
    known = np.isfinite(q).all(axis=1)
    if known.sum() < 2:
        return result
    before, after, weight = _neighbours(times[known], time_s)
    usable = np.isfinite(weight)
    if not usable.any():
        return result
    first = Rotation.from_quat(q[known][before[usable]], scalar_first=True)
    second = Rotation.from_quat(q[known][after[usable]], scalar_first=True)
    step = Rotation.from_rotvec((first.inv() * second).as_rotvec() * weight[usable, None])
    result[usable] = (first * step).as_quat(scalar_first=True)
    return result


def _p_at(times: FloatArray, p: FloatArray, time_s: FloatArray) -> FloatArray:
    known = np.isfinite(p).all(axis=1)
    if known.sum() < 2:
        return np.full((len(time_s), 3), np.nan)
    before, after, weight = _neighbours(times[known], time_s)
    found: FloatArray = p[known][before] * (1.0 - weight[:, None]) + p[known][after] * weight[:, None]
    return found
