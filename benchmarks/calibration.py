"""How well a body calibration finds how modules sit: simulated wearers, and real recordings."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import DATA
from benchmarks.calibration_recordings import CalibratedTrial, hipose_trial
from benchmarks.calibration_simulation import errors, imu_frames, session_of, simulated_body
from benchmarks.figures import Figure, Report, table
from devices.emulators.bodies import EmulatedBody
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.calibration.body_session import BodySession
from gateway.calibration.evidence import EvenSamples, even_samples, field_heading, pose_of
from gateway.frames import FloatArray

HEADINGS_DEG = (0, 45, 90, 135, 180, 225, 270, 315)
PUBLISHED = "<=6"
"""OpenSense against optical capture: 3–6° median RMS (Al Borno et al. 2022, J. NeuroEng. Rehab. 19:22)."""


def run() -> Report:
    """Eight headings in simulation, then a recording of a whole body."""
    report = Report("calibration")
    _add_simulation(report)
    if (DATA / "hipose_mtw17").exists():
        _add_recording(report, hipose_trial(DATA / "hipose_mtw17"))
    else:
        print("skipped hipose_mtw17: not there")
    return report


def _add_simulation(report: Report) -> None:
    suit = load_rig("suit_17")
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for seed, heading in enumerate(HEADINGS_DEG, start=1):
        body = simulated_body(suit, seed)
        frames = imu_frames(suit, body, float(np.radians(heading)), seed)
        session = session_of(suit, frames)
        place = np.linalg.norm(suit.lever_arms - body.module_positions, axis=1)
        readings = even_samples(frames, suit)
        for name, facing in (("pose alone, facing east assumed", 0.0), ("pose alone, facing told", heading)):
            angles = _pose_only(session, readings, body, float(np.radians(facing)))
            found.setdefault(name, []).append((angles, place))
        found.setdefault("guided", []).append(errors(session.result(), body))
        without = session_of(suit, frames, uses_field=False)
        found.setdefault("guided, no magnetometer", []).append(errors(without.result(), body))
    _add_tables(report, suit, found)


def _add_tables(
    report: Report, suit: WornSuit, found: dict[str, list[tuple[FloatArray, FloatArray]]]
) -> None:
    names = list(found)
    rows = []
    for k, heading in enumerate(HEADINGS_DEG):
        cells = [f"{_rms(found[name][k][0]):.2f}" for name in names]
        rows.append([str(heading), *cells, f"{100 * found['guided'][k][1].max():.2f}"])
    heads = ["facing °", *(f"{name} ° RMS" for name in names), "guided, worst place cm"]
    report.tables.append(
        "## Simulated wearers: modules turned at random, 2 cm off their places, joints 1.5° off in poses\n\n"
        + table(heads, rows)
    )
    segments = [
        suit.skeleton.segment_names[int(np.flatnonzero(suit.module_of_segment == m)[0])] for m in range(17)
    ]
    by_module = {name: np.stack([angles for angles, _ in each]) for name, each in found.items()}
    places = np.stack([metres for _, metres in found["guided"]])
    rows = [
        [
            segment,
            *(f"{_rms(by_module[name][:, m]):.2f}" for name in names),
            f"{100 * _rms(places[:, m]):.2f}",
            f"{100 * places[:, m].max():.2f}",
        ]
        for m, segment in enumerate(segments)
    ]
    heads = ["segment", *(f"{name} ° RMS" for name in names), "guided, place cm RMS", "worst cm"]
    report.tables.append("## The same by segment, over eight headings\n\n" + table(heads, rows))
    what = "17 modules, eight headings, typical modules through the wire"
    for name, figure in (("guided", "guided"), ("guided, no magnetometer", "guided_no_field")):
        each = by_module[name]
        worst = max(_rms(each[:, m]) for m in range(each.shape[1]))
        far = np.stack([metres for _, metres in found[name]])
        report.figures += [
            Figure(f"{figure}_orientation_rms_deg", _rms(each), "°", "<=2", f"{what}, all modules"),
            Figure(f"{figure}_worst_module_rms_deg", worst, "°", "<=2", f"{what}, the worst module"),
            Figure(
                f"{figure}_place_worst_cm", 100 * float(far.max()), "cm", "<=1", f"{what}, the worst of all"
            ),
        ]
    for name in names[:2]:
        figure = "pose_alone_" + ("east" if "east" in name else "told") + "_rms_deg"
        report.figures.append(
            Figure(figure, _rms(by_module[name]), "°", "", f"{name}; lever arms stay 2 cm off")
        )


def _pose_only(session: BodySession, readings: EvenSamples, body: EmulatedBody, facing: float) -> FloatArray:
    """Error of ``q_bs`` by module, degrees, where the N-pose alone is taken for the neutral posture."""
    suit = session.suit
    neutral = Rotation.from_rotvec([0, 0, facing]) * Rotation.from_quat(
        suit.skeleton.neutral, scalar_first=True
    )
    found = []
    for module in range(len(suit.module_ids)):
        span = session.spans["n_pose", module]
        pose = pose_of(readings, module, span)
        heading = field_heading(readings, module, [span], suit.magnetic_field)
        assert pose is not None
        assert heading is not None
        sensor = Rotation.from_rotvec([0, 0, heading.heading]) * Rotation.from_matrix(pose.R_es)
        segment = int(np.flatnonzero(suit.module_of_segment == module)[0])
        true = Rotation.from_quat(body.sensor_to_segment[segment], scalar_first=True)
        found.append(np.degrees((neutral.inv() * sensor * true.inv()).magnitude()))
    return np.array(found)


def _add_recording(report: Report, trial: CalibratedTrial) -> None:
    rows, all_ours = [], []
    for joint, ours, pose in zip(trial.joints, trial.ours_deg, trial.pose_only_deg, strict=True):
        for i, angle in enumerate(joint.angles):
            if np.isfinite(ours[i]):
                rows.append([joint.name, angle.name, f"{ours[i]:.2f}", f"{pose[i]:.2f}"])
                all_ours.append(ours[i])
    heads = ["joint", "angle", "ours ° RMSE", "pose alone, facing east ° RMSE"]
    report.tables.append(f"## {trial.name}: {trial.what}\n\n" + table(heads, rows))
    scores = ", ".join(f"{segment} {verdict}" for segment, verdict in trial.verdicts.items())
    report.tables.append(f"Scores: {scores}.")
    report.figures.append(
        Figure(f"{trial.name}_joint_median_deg", float(np.median(all_ours)), "°", PUBLISHED, trial.what)
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
