"""Figures of long gaps: two fifths of all points taken out, in simulated and real trials."""

from __future__ import annotations

import numpy as np

from benchmarks.figures import Figure
from devices.deferred import Rotation
from devices.marker_files import MarkerTrial
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.emulation.optical_truth import cut_gaps, foreseen, rms_of, solved_simulation
from gateway.frames import FloatArray, MarkerFrame
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.landmarks import to_world

SEED = 1
HEADS = [
    "trial", "joints °, RMSE", "its own spline", "joints °, 95 %", "its own spline", "root mm, RMSE",
    "root mm, most",
]  # fmt: skip
MANY_GAPS = 0.4
"""Of all points, in gaps of 0.05 to 0.5 s."""


def long_gaps() -> list[Figure]:
    """Return what is left of the angles where two fifths of all points are missing, beside what no method
    betters that looks at one segment at a time."""
    errors = solved_simulation(gaps=MANY_GAPS)
    what = "as `truth_joint_angles_deg`, with 40 % of every marker missing, in gaps of 0.05 to 0.5 s"
    return [
        Figure("truth_long_gaps_deg", rms_of(errors.offline), "°", "<=4", what),
        Figure(
            "truth_long_gaps_foreseen_deg", rms_of(errors.foreseen), "°",
            note="the same frames: the truth's own spline through the instants at which a segment is shown",
        ),
        Figure(
            "truth_long_gaps_live_deg", rms_of(errors.live), "°", note="the same, frame by frame",
        ),
    ]  # fmt: skip


def real_row(name: str, skeleton: Skeleton, markers: BodyMarkers, held: MarkerTrial) -> list[str]:
    """Return how far the frames of a real trial with gaps are from the same without, and how far these
    themselves are where each segment's joint is only known while its markers show it."""
    whole = to_world(held.columns(markers.labels), markers.vertical)
    cut = whole.copy()
    cut_gaps(cut, MANY_GAPS, held.rate_hz, np.random.default_rng(SEED))
    true, root = _solved(skeleton, markers, whole, held.rate_hz)
    found, place = _solved(skeleton, markers, cut, held.rate_hz)
    known = foreseen(skeleton.parents, markers.segments, np.isfinite(cut[:, :, 0]), held.rate_hz, true)
    ours, splined = (_apart_deg(skeleton, each, true) for each in (found, known))
    away = 1e3 * np.linalg.norm(place - root, axis=1)
    figures = [
        *(each for measure in (_root_mean, _most) for each in (measure(ours), measure(splined))),
        _root_mean(away), float(away.max()),
    ]  # fmt: skip
    return [name, *(f"{each:.1f}" for each in figures)]


def _solved(
    skeleton: Skeleton, markers: BodyMarkers, seen: FloatArray, rate_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Return orientations (F, S, 4) and the root's places (F, 3) m."""
    frames = [MarkerFrame(f, round(f * 1e9 / rate_hz), each) for f, each in enumerate(seen)]
    solved, _ = solve_both_ways(skeleton, markers, frames)
    return np.array([each.q_wb for each in solved]), np.array([each.p_w[0] for each in solved])


def _apart_deg(skeleton: Skeleton, found: FloatArray, true: FloatArray) -> FloatArray:
    """Return (F, S) between two motions (F, S, 4): each joint's turn against its parent, the root's in the
    world."""
    apart = np.empty(found.shape[:2])
    for s, parent in enumerate(skeleton.parents.tolist()):
        ours, theirs = (Rotation.from_quat(q[:, s], scalar_first=True) for q in (found, true))
        if parent >= 0:
            ours, theirs = (
                Rotation.from_quat(q[:, parent], scalar_first=True).inv() * turn
                for q, turn in ((found, ours), (true, theirs))
            )
        apart[:, s] = np.degrees((ours.inv() * theirs).magnitude())
    return apart


def _root_mean(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _most(values: FloatArray) -> float:
    return float(np.percentile(values, 95.0))
