"""Both halves of a simulated capture: fit to one, solve the other with noise, gaps and swapped names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure
from benchmarks.optical_truth import SimulatedTrial, placed_markers, simulated
from gateway.body.anthropometry import Subject, scaled
from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.fitting import Fit, FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.worn_markers import worn_part

SEED = 3
SECONDS = 12.0
STANDING = (0.0, 0.9)
_NEAR_GIMBAL = np.radians(15.0)


def simulated_rows() -> tuple[list[Figure], tuple[list[str], list[list[str]]]]:
    """Figures, and a table of all joints."""
    whole = load_marker_set("plug_in_gait")
    marker_set = worn_part(whole, {*whole.labels} - {"SACR"})
    generator = np.random.default_rng(SEED)
    body = scaled(marker_set.body, Subject(height_m=1.68))
    places, segments = placed_markers(marker_set, body, generator)
    calibration = simulated(marker_set, body, places, segments, SECONDS, generator, faults=False)
    test = simulated(marker_set, body, places, segments, SECONDS, generator, faults=True)
    options = FitOptions(vertical="z", neutral=STANDING, centres="motion")
    fitted = fit_body(marker_set, [calibration.trial], options)
    q_wb, found = _solved(fitted, test)
    whole = _bridged(fitted, test)
    shown = _shown(fitted, test)
    live, offline = (_angle_errors(body, each, test.q_wb) for each in (q_wb, whole))
    rows = []
    for joint, early, late in zip(body.joints, live, offline, strict=True):
        seen = shown[:, joint.distal]
        for k, angle in enumerate(joint.angles):
            cells = [late[:, k], early[:, k], early[seen, k], early[~seen, k]]
            rows.append([joint.name, angle.name, *(f"{_rms(each):.2f}" for each in cells)])
    figures = [
        Figure(
            "truth_joint_angles_deg", _rms_of(offline), "°", "<=1",
            "1 mm noise, markers 3 cm off, 10 % gaps, swaps; all joints and angles; a whole trial, "
            "by `optical solve --method both_ways`",
        ),
        Figure(
            "truth_live_joint_angles_deg", _rms_of(live), "°",
            note="the same, frame by frame, without knowing what comes after a gap",
        ),
        Figure(
            "truth_live_seen_joint_angles_deg",
            _rms_of([e[shown[:, j.distal]] for j, e in zip(body.joints, live, strict=True)]), "°", "<=1",
            "the same, of all joints while every marker of the segment beyond them is seen",
        ),
        Figure("truth_swaps_found_percent", 100.0 * found, "%", ">=99", "points with a wrong name"),
        Figure(
            "truth_bone_length_spread_mm", _length_spread(fitted, q_wb), "mm", "<=0.001",
            "largest change of a bone's length over all frames",
        ),
    ]  # fmt: skip
    heads = ["joint", "angle", "both ways", "live", "live, all its markers seen", "live, in gaps"]
    return figures, (heads, rows)


def _bridged(fitted: Fit, test: SimulatedTrial) -> FloatArray:
    """(F, S, 4), with gaps bridged from both sides."""
    observed = test.trial.columns(fitted.markers.labels)
    frames = [MarkerFrame(f, round(f * 1e9 / test.trial.rate_hz), seen) for f, seen in enumerate(observed)]
    solved, _ = solve_both_ways(fitted.skeleton, fitted.markers, frames)
    return np.array([each.q_wb for each in solved])


def _shown(fitted: Fit, test: SimulatedTrial) -> NDArray[np.bool_]:
    """(F, S) whether all markers of a segment are seen."""
    seen: NDArray[np.bool_] = np.isfinite(test.trial.columns(fitted.markers.labels)[:, :, 0])
    n = fitted.skeleton.n_segments
    return np.stack([seen[:, fitted.markers.segments == s].all(axis=1) for s in range(n)], axis=1)


def _rms_of(errors: list[FloatArray]) -> float:
    return _rms(np.concatenate([error.ravel() for error in errors]))


def _solved(fitted: Fit, test: SimulatedTrial) -> tuple[FloatArray, float]:
    """Orientations (F, S, 4), and the share of swapped points that were found."""
    reconstructor = OpticalReconstructor(fitted.skeleton, fitted.markers)
    labels = fitted.markers.labels
    observed = test.trial.columns(labels)
    q_wb, renamed = [], set()
    for f, seen in enumerate(observed):
        q_wb.append(reconstructor.update(MarkerFrame(f, round(f * 1e9 / test.trial.rate_hz), seen)).q_wb)
        assert reconstructor.last is not None
        renamed |= {(f, labels[m], labels[s]) for m, s in reconstructor.last.renamed}
    wrong = {
        (f, right, given)
        for f, a, b in test.swaps
        for right, given in ((a, b), (b, a))
        if np.isfinite(observed[f, labels.index(given), 0])
    }
    return np.array(q_wb), len(wrong & renamed) / len(wrong)


def _angle_errors(body: Skeleton, q_wb: FloatArray, truth: FloatArray) -> list[FloatArray]:
    """A joint: (F, angles) degrees; NaN where the true joint is near the singularity of its angles."""
    ours, theirs = JointAngles(body), JointAngles(body)
    errors: list[list[FloatArray]] = [[] for _ in body.joints]
    for a, b in zip(q_wb, truth, strict=True):
        found, true = ours.update(a).angles, theirs.update(b).angles
        apart = np.degrees((found - true + np.pi) % (2 * np.pi) - np.pi)
        for j, joint in enumerate(body.joints):
            is_euler = len(set(joint.sequence)) == 2 and len(joint.angles) == 3
            is_near = is_euler and abs(np.sin(true[j, 1])) < np.sin(_NEAR_GIMBAL)
            row = np.full(len(joint.angles), np.nan) if is_near else apart[j, : len(joint.angles)]
            errors[j].append(row)
    return [np.array(each) for each in errors]


def _length_spread(fitted: Fit, q_wb: FloatArray) -> float:
    """mm: of bones put through every frame's orientations."""
    spreads = []
    for s, offset in enumerate(fitted.skeleton.offsets):
        parent = int(fitted.skeleton.parents[s])
        if parent >= 0:
            lengths = [np.linalg.norm(quaternion.rotate(q[parent], offset)) for q in q_wb[::20]]
            spreads.append(1e3 * float(np.ptp(lengths)))
    return max(spreads)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))
