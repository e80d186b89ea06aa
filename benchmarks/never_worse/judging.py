"""How far a solution is from the truth, how soon headings are right, whether claims are honest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.never_worse.case import Case, Variant
from benchmarks.never_worse.solving import Solution
from gateway.agreement.world_alignment import WorldAlignment, align_segments
from gateway.frames import FloatArray
from gateway.geometry.comparison import coverage_percent, orientation_error, rmse_deg

SCORED_INSTANTS = 1500
"""Of a recording, evenly spread: more do not change an error's mean, and alignment takes long."""
HEADING_WITHIN = float(np.radians(5.0))
HEADING_FOR_S = 1.0
"""A heading counts as found when it stays right for so long."""
PROVED_TILT = float(np.radians(0.5))
"""Of a truth's vertical against the mean specific force: a constant error of 0.05 m/s² and 1 m/s more at one
end of 40 s than at the other make 0.4° of it."""
PROVED_TIMES = 4.0
"""Of the standard error: fast motion shows less."""
MOSTLY = 0.98
"""Share of instants that must be there for a mean over them all."""
TIME_BINS = 10
CHI2_95 = {2: 5.991, 3: 7.815}
"""95 % of a chi-square variable of so many degrees of freedom are below."""


@dataclass(frozen=True)
class Errors:
    """Of one solution, degrees; RMSE of each segment, then the mean of the segments."""

    total: float
    """One heading and one misalignment a segment taken out."""
    tilt: float
    by_segment: tuple[float, ...]
    """The totals."""
    raw_total: float
    """Nothing taken out; NaN where truth and rig have different worlds."""
    raw_tilt: float
    relative: float
    """Of a segment against its parent, nothing taken out; NaN likewise, and for one segment."""
    heading_start_s: float
    """Until every heading is right, from when the motion begins; NaN where none can be shown."""


@dataclass(frozen=True)
class Claims:
    """How honest a solution is about its errors."""

    covered_percent: float
    """Of errors within twice the root of the covariance's trace."""
    in_ellipsoid_percent: float
    """Of errors within the ellipsoid that is to hold 95 % of them."""
    nees: float
    """Mean normalised estimation error squared over its degrees of freedom: 1 is honest, above claims too
    much."""
    nees_by_segment: tuple[float, ...] = field(default=())
    nees_by_time: tuple[float, ...] = field(default=())
    """In tenths of the scored time."""


def errors(case: Case, variant: Variant, q_wb: FloatArray, is_later: bool = False) -> Errors:
    """Return the errors of orientations (T, S, 4). is_later: taken as those of half a sample after."""
    truth = case.truth_later if is_later else case.truth
    scored = _scored(case)
    found = align_segments(q_wb[scored], truth[scored])
    wanted = _in_its_world(truth, found)
    error = orientation_error(q_wb[scored], wanted[scored])
    by_segment = rmse_deg(error.total)
    raw_total = raw_tilt = relative = float("nan")
    if case.is_world_known:
        raw = orientation_error(q_wb[scored], truth[scored])
        raw_tilt = float(rmse_deg(raw.inclination).mean())
        raw_total = float(rmse_deg(raw.total).mean()) if variant.has_field else raw_total
        relative = _relative(case, q_wb[scored], truth[scored])
    return Errors(
        float(by_segment.mean()), float(rmse_deg(error.inclination).mean()), tuple(by_segment.tolist()),
        raw_total, raw_tilt, relative, _heading_start(case, q_wb, wanted),
    )  # fmt: skip


def claims(case: Case, variant: Variant, solution: Solution) -> Claims:
    """Return how honest it is; in the truth's world where that is known, else as far as tilts tell.

    Where truth and rig have the same axes no misalignment is taken out of a tilt either: it would take the
    constant error of the accelerometer with it.
    """
    scored = _scored(case)
    q_wb, wanted = solution.q_wb[scored], case.truth[scored]
    is_known = case.is_world_known and variant.has_field
    if not case.is_world_known:
        wanted = levelled(case, _in_its_world(case.truth, align_segments(q_wb, wanted)))[scored]
    sound = np.isfinite(wanted).all(axis=2) & np.isfinite(q_wb).all(axis=2)
    off = (_vectors if is_known else _tilts)(q_wb[sound], wanted[sound])
    axes = off.shape[1]
    P = solution.covariance[scored][sound][:, :axes, :axes]
    expected = np.sqrt(np.trace(P, axis1=1, axis2=2))
    covered = coverage_percent(np.linalg.norm(off, axis=1), expected)
    square = np.full(sound.shape, np.nan)
    square[sound] = np.einsum("ni,ni->n", off, np.linalg.solve(P, off[..., None])[..., 0])
    within = float(100.0 * np.mean(square[sound] < CHI2_95[axes]))
    bins = [float(np.nanmean(each)) / axes for each in np.array_split(square, TIME_BINS)]
    by_segment = tuple((np.nanmean(square, axis=0) / axes).tolist())
    return Claims(covered, within, float(np.nanmean(square)) / axes, by_segment, tuple(bins))


def heading_errors(case: Case, q_wb: FloatArray) -> FloatArray:
    """Return (T, S) signed heading errors, rad, after the alignment of the scored part; NaN without truth."""
    scored = _scored(case)
    return _headings(q_wb, _in_its_world(case.truth, align_segments(q_wb[scored], case.truth[scored])))


def tilt_errors(case: Case, q_wb: FloatArray) -> FloatArray:
    """Return (T, S) tilt errors, rad, likewise."""
    scored = _scored(case)
    wanted = _in_its_world(case.truth, align_segments(q_wb[scored], case.truth[scored]))
    return orientation_error(q_wb, wanted).inclination


def levelled(case: Case, truth: FloatArray) -> FloatArray:
    """Return the truth (T, S, 4) in a world whose vertical is that of gravity, as far as that is proved.

    The mean acceleration of whatever does not fly away is next to nothing over a whole recording. So the mean
    specific force of all segments, turned into the world by the truth alone, points up. Where it does not, by
    more than ``PROVED_TILT`` and by ``PROVED_TIMES`` the standard error of the mean of its tenths, the
    truth's world is askew, and no claim of a filter speaks of that.
    """
    is_scored = case.times_s >= case.scored_after_s
    forces, known = case.forces[is_scored], truth[is_scored]
    sound = np.isfinite(forces).all(axis=(1, 2)) & np.isfinite(known).all(axis=(1, 2))
    if case.is_world_known or not sound.mean() > MOSTLY:
        return truth
    flat = Rotation.from_quat(known[sound].reshape(-1, 4), scalar_first=True).apply(
        forces[sound].reshape(-1, 3)
    )
    felt = flat.reshape(-1, truth.shape[1], 3).mean(axis=1)
    tenths = np.array([each.mean(axis=0) for each in np.array_split(felt, TIME_BINS)])
    error = float(np.hypot(*tenths[:, :2].std(axis=0, ddof=1))) / math.sqrt(TIME_BINS)
    up = felt.mean(axis=0)
    level, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    if level.magnitude() < PROVED_TILT or float(np.hypot(up[0], up[1])) < PROVED_TIMES * error:
        return truth
    found = np.full_like(truth, np.nan)
    is_there = np.isfinite(truth).all(axis=2)
    turned = level * Rotation.from_quat(truth[is_there], scalar_first=True)
    found[is_there] = turned.as_quat(scalar_first=True)
    return found


def _scored(case: Case) -> np.ndarray:
    """Return the rows that count."""
    rows = np.flatnonzero(case.times_s >= case.scored_after_s)
    return rows[:: max(1, len(rows) // SCORED_INSTANTS)]


def _in_its_world(truth: FloatArray, found: WorldAlignment) -> FloatArray:
    """Return the truth (T, S, 4) in the world and axes of the solution that was aligned to it."""
    result = np.full_like(truth, np.nan)
    for s in range(truth.shape[1]):
        known = np.isfinite(truth[:, s]).all(axis=1)
        heading = Rotation.from_rotvec([0.0, 0.0, found.heading_rad + found.own_heading[s]])
        mounting = Rotation.from_quat(found.mounting[s], scalar_first=True)
        own = Rotation.from_quat(truth[known, s], scalar_first=True)
        result[known, s] = (heading.inv() * own * mounting.inv()).as_quat(scalar_first=True)
    return result


def _relative(case: Case, q_wb: FloatArray, truth: FloatArray) -> float:
    """Return the mean error of segments against their parents, degrees."""
    parents = case.suit.skeleton.parents
    found = []
    for s in np.flatnonzero(parents >= 0):
        ours, true = (
            Rotation.from_quat(q[:, parents[s]], scalar_first=True).inv()
            * Rotation.from_quat(q[:, s], scalar_first=True)
            for q in (q_wb, truth)
        )
        found.append(float(np.degrees(np.sqrt(np.mean((ours * true.inv()).magnitude() ** 2)))))
    return float(np.mean(found)) if found else float("nan")


def _vectors(q: FloatArray, truth: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3), world axes, from estimates to truths."""
    turn = Rotation.from_quat(truth, scalar_first=True) * Rotation.from_quat(q, scalar_first=True).inv()
    return np.asarray(turn.as_rotvec())


def _tilts(q: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the horizontal rotation vectors (N, 2), world axes, from estimates to the tilts of truths."""
    up = Rotation.from_quat(truth, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    x, y, z = Rotation.from_quat(q, scalar_first=True).apply(up).T
    sine = np.hypot(x, y)
    turn = np.arctan2(sine, z) / np.maximum(sine, np.finfo(np.float64).tiny)
    return np.column_stack([turn * y, -turn * x])


def _headings(q_wb: FloatArray, wanted: FloatArray) -> FloatArray:
    result = np.full(q_wb.shape[:2], np.nan)
    known = np.isfinite(q_wb).all(axis=2) & np.isfinite(wanted).all(axis=2)
    ours, true = (Rotation.from_quat(q[known], scalar_first=True) for q in (q_wb, wanted))
    w, _, _, z = (ours * true.inv()).as_quat(scalar_first=True).T
    result[known] = 2.0 * np.arctan2(z * np.sign(w), np.abs(w))
    return result


def _heading_start(case: Case, q_wb: FloatArray, wanted: FloatArray) -> float:
    """Return seconds from when the motion begins until the last segment's heading is right; the whole length
    where one never is."""
    if not case.is_spatial or q_wb.shape[1] < 2:
        return float("nan")
    times = case.times_s
    begins_s = case.moves_from_s
    off = np.abs(_headings(q_wb, wanted))
    found = []
    for s in range(off.shape[1]):
        known = np.flatnonzero(np.isfinite(off[:, s]) & (times >= begins_s))
        wrong = times[known][off[known, s] > HEADING_WITHIN]
        starts = np.concatenate([[begins_s], wrong])
        ends = np.concatenate([wrong, [times[-1]]])
        right = np.flatnonzero(ends - starts >= HEADING_FOR_S)
        found.append(float(starts[right[0]] if len(right) else times[-1]) - begins_s)
    return max(found)
