"""Suite ``optical``: markers to skeleton, on simulated truth and on real trials, both methods."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.optical_opensim import OpenSimBeside
from benchmarks.optical_simulation import simulated_rows
from devices.marker_files import MarkerTrial, read_markers
from gateway.body.joint_angles import joint_angles
from gateway.body.markers import BodyMarkers
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.reconstruction.optical.fitting import FitOptions, fit_body, sighted
from gateway.reconstruction.optical.landmarks import measurements, to_world, vertical_axis
from gateway.reconstruction.optical.marker_set import MarkerSet, load_marker_set
from gateway.reconstruction.optical.pose_solver import body_model
from gateway.reconstruction.optical.published import first_frame_markers, solve_published
from gateway.reconstruction.optical.published_trial import published_trial
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.rule_body import from_rules

DATA = Path(__file__).parents[2] / "shared" / "data"
TRIALS = {
    "pycgm": ("plug_in_gait", "c3d_pycgm/Static_trial.c3d", "c3d_pycgm/Movement_trial.c3d"),
    "btk": (
        "plug_in_gait",
        "c3d_btk_pig/PiG_Calibration-FlatFoot-Full.c3d",
        "c3d_btk_pig/PiG_Motion-FlatFoot-Full.c3d",
    ),
    "opensim": ("opensim_41", "trc_opensim/subject01_static.trc", "trc_opensim/marker_trajectories.trc"),
}
CENTRES = {
    "hips": ("pelvis", "PELO"), "left knee": ("left_shank", "LFEO"), "right knee": ("right_shank", "RFEO"),
    "left ankle": ("left_foot", "LTIO"), "right ankle": ("right_foot", "RTIO"),
    "left shoulder": ("left_upper_arm", "LCLO"), "right shoulder": ("right_upper_arm", "RCLO"),
    "left elbow": ("left_forearm", "LHUO"), "right elbow": ("right_forearm", "RHUO"),
    "left wrist": ("left_hand", "LRAO"), "right wrist": ("right_hand", "RRAO"),
}  # fmt: skip
ANGLES = {
    (f"{side}_{joint}", name): (f"{side[0].upper()}{label}Angles", column)
    for side in ("left", "right")
    for joint, label, names in (
        ("hip", "Hip", ("flexion", "adduction", "internal_rotation")),
        ("knee", "Knee", ("flexion", "adduction")),
        ("ankle", "Ankle", ("dorsiflexion",)),
        ("elbow", "Elbow", ("flexion",)),
    )
    for column, name in enumerate(names)
}
PUBLISHED_FRAMES = 40
LEFT_OUT_FRAMES = 25


@dataclass(frozen=True)
class Outcome:
    """Poses of held-out frames, and what they explain."""

    q_wb: FloatArray  # (F, S, 4)
    p_w: FloatArray  # (F, S, 3) m
    residuals: FloatArray  # (F, M) m
    left_out: float
    """m RMSE, of markers that the pose was not told."""
    ms: float


def run() -> Report:
    """Known truth first, then three subjects."""
    report = Report("optical")
    figures, rows = simulated_rows()
    report.figures += figures
    report.tables.append("### Simulated truth: RMSE of joint angles, degrees\n\n" + table(*rows))
    compared: list[list[str]] = []
    centre_rows: list[list[str]] = []
    angle_rows: list[list[str]] = []
    beside = OpenSimBeside()
    for name, (set_name, static, motion) in TRIALS.items():
        if not (DATA / motion).is_file():
            continue
        marker_set = load_marker_set(set_name)
        trials = [read_markers(DATA / static), read_markers(DATA / motion)]
        half = trials[1].n_frames // 2
        training = [trials[0], replace(trials[1], positions=trials[1].positions[:half])]
        held = replace(trials[1], positions=trials[1].positions[half:])
        for method, solve in _methods(marker_set, training).items():
            skeleton, markers, outcome = solve(held)
            rmse = float(np.sqrt(np.nanmean(outcome.residuals**2)))
            compared.append(
                [name, method, f"{1e3 * rmse:.2f}", f"{1e3 * outcome.left_out:.1f}", f"{outcome.ms:.2f}"]
            )
            if method == "default":
                report.figures += [
                    Figure(f"{name}_held_out_rmse_mm", 1e3 * rmse, "mm", "<=6", "second half of the trial"),
                    Figure(f"{name}_ms_per_frame", outcome.ms, "ms", "<=5", "processor time, streaming"),
                ]
                beside.add(name, skeleton, markers, held, outcome)
            if set_name == "plug_in_gait":
                centre_rows.append([name, method, *_centres(skeleton, markers, outcome, held)])
                angle_rows += _angles(name, method, skeleton, outcome, held)
    report.tables += [
        "### Held-out frames: distance of markers and body, RMSE\n\n"
        + table(["trial", "method", "held-out frames mm", "left-out markers mm", "ms a frame"], compared),
        beside.text(),
        "### Joint centres against the file's Plug-in-Gait, RMSE in mm\n\n"
        + table(["trial", "method", *CENTRES], centre_rows),
        "### Joint angles against the file's Plug-in-Gait, degrees: RMSE, and without its mean\n\n"
        + table(["trial", "method", "joint", "angle", "RMSE", "without offset"], angle_rows),
    ]
    return report


Solved = tuple[Skeleton, BodyMarkers, Outcome]


def _methods(
    marker_set: MarkerSet, training: list[MarkerTrial]
) -> dict[str, Callable[[MarkerTrial], Solved]]:
    def streamed(centres: str) -> Callable[[MarkerTrial], Solved]:
        def solve(held: MarkerTrial) -> Solved:
            fitted = fit_body(marker_set, training, FitOptions(centres=centres))  # type: ignore[arg-type]
            return fitted.skeleton, fitted.markers, _streamed(fitted.skeleton, fitted.markers, held)

        return solve

    return {
        "default": streamed("both"),
        "default, rules only": streamed("rules"),
        "published": lambda held: _published(marker_set, training, held),
    }


def _streamed(skeleton: Skeleton, markers: BodyMarkers, held: MarkerTrial) -> Outcome:
    observed = to_world(held.columns(markers.labels), markers.vertical)
    seen = _frames(observed, held.rate_hz)
    reconstructor = OpticalReconstructor(skeleton, markers)
    reconstructor.update(seen[0])
    reconstructor.reset()
    residuals, q_wb, p_w = [], [], []
    begun = time.process_time()
    for frame in seen:
        pose = reconstructor.update(frame)
        assert reconstructor.last is not None
        residuals.append(reconstructor.last.residuals)
        q_wb.append(pose.q_wb)
        p_w.append(pose.p_w)
    ms = 1e3 * (time.process_time() - begun) / len(seen)
    return Outcome(
        np.array(q_wb),
        np.array(p_w),
        np.array(residuals),
        _left_out(reconstructor, observed, held.rate_hz),
        ms,
    )


def _left_out(reconstructor: OpticalReconstructor, observed: FloatArray, rate_hz: float) -> float:
    """Each marker in turn is not shown, and looked for where the body has it; m RMSE."""
    squares = []
    part = _left_out_stretch(observed)
    for m in range(observed.shape[1]):
        hidden = part.copy()
        hidden[:, m] = np.nan
        reconstructor.reset()
        for frame, true in zip(_frames(hidden, rate_hz), part[:, m], strict=True):
            reconstructor.update(frame)
            assert reconstructor.last is not None
            squares.append(((reconstructor.last.virtual[m] - true) ** 2).sum())
    return float(np.sqrt(np.nanmean(squares)))


def _left_out_stretch(observed: FloatArray) -> FloatArray:
    return observed[: max(20, len(observed) // 4)]


def _frames(observed: FloatArray, rate_hz: float) -> list[MarkerFrame]:
    return [MarkerFrame(f, round(f * 1e9 / rate_hz), seen) for f, seen in enumerate(observed)]


def _published(marker_set: MarkerSet, training: list[MarkerTrial], held: MarkerTrial) -> Solved:
    """Body and virtual markers from a stretch of the first half, then the held-out frames with them."""
    lengths = measurements(marker_set, training, {}).lengths
    vertical = vertical_axis(marker_set, training[0])
    sightings = [sighted(marker_set, trial, vertical, lengths) for trial in training]
    skeleton, markers = from_rules(marker_set, sightings, vertical)
    columns = [marker_set.labels.index(label) for label in markers.labels]
    learnt = sightings[1] if np.isfinite(sightings[1].places.axes).all(axis=(1, 2, 3)).any() else sightings[0]
    good = np.flatnonzero(np.isfinite(learnt.places.axes).all(axis=(1, 2, 3)))[:PUBLISHED_FRAMES]
    seen = learnt.markers[good][:, columns]
    axes, root = learnt.places.axes[good], learnt.places.origins[good, 0]
    model = body_model(skeleton, markers)
    markers = replace(markers, positions=first_frame_markers(model, seen[0], axes[0], root[0]))
    taught = solve_published(skeleton, markers, seen, axes, root, held.rate_hz)
    observed = to_world(held.columns(markers.labels), vertical)
    before = time.process_time()
    solved = published_trial(skeleton, taught.markers, observed, held.rate_hz, refine=False)
    ms = 1e3 * (time.process_time() - before) / len(observed)
    q_wb = np.array([[quaternion.from_matrix(each) for each in pose] for pose in solved.motion.R])
    left_out = _published_left_out(skeleton, taught.markers, observed, held.rate_hz)
    return skeleton, taught.markers, Outcome(q_wb, solved.p_w, solved.residuals, left_out, ms)


def _published_left_out(
    skeleton: Skeleton, markers: BodyMarkers, observed: FloatArray, rate_hz: float
) -> float:
    """As ``_left_out``, over the same stretch, at ``LEFT_OUT_FRAMES`` instants of it: the method is slow."""
    stretch = _left_out_stretch(observed)
    step = -(-len(stretch) // LEFT_OUT_FRAMES)
    part = stretch[::step]
    squares = []
    for m in range(observed.shape[1]):
        hidden = part.copy()
        hidden[:, m] = np.nan
        solved = published_trial(skeleton, markers, hidden, rate_hz / step, refine=False)
        squares.append(((solved.virtual[:, m] - part[:, m]) ** 2).sum(axis=1))
    return float(np.sqrt(np.nanmean(squares)))


def _centres(skeleton: Skeleton, markers: BodyMarkers, outcome: Outcome, held: MarkerTrial) -> list[str]:
    cells = []
    for segment, label in CENTRES.values():
        truth = to_world(held.columns((label,)), markers.vertical)[:, 0]
        apart = np.linalg.norm(outcome.p_w[:, skeleton.index(segment)] - truth, axis=1)
        cells.append(f"{1e3 * float(np.sqrt(np.nanmean(apart**2))):.1f}")
    return cells


def _angles(
    name: str, method: str, skeleton: Skeleton, outcome: Outcome, held: MarkerTrial
) -> list[list[str]]:
    ours = np.degrees(joint_angles(skeleton, outcome.q_wb))
    joints = {joint.name: j for j, joint in enumerate(skeleton.joints)}
    rows = []
    for (joint, angle), (label, column) in ANGLES.items():
        names = [each.name for each in skeleton.joints[joints[joint]].angles]
        theirs = held.columns((label,))[:, 0, column] / held.metres_per_unit
        apart = (ours[:, joints[joint], names.index(angle)] - theirs + 180.0) % 360.0 - 180.0
        spread = apart - np.nanmean(apart)
        rows.append(
            [
                name,
                method,
                joint,
                angle,
                f"{np.sqrt(np.nanmean(apart**2)):.1f}",
                f"{np.sqrt(np.nanmean(spread**2)):.1f}",
            ]
        )
    return rows
