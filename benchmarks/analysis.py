"""Suite ``analysis``: torques against closed forms, a walking trial's own moments, and OpenSim beside it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.analysis_peer import Peer, opensim_beside
from benchmarks.analysis_pendulum import double_pendulum_error
from benchmarks.figures import Figure, Report, table
from devices.marker_files import MarkerTrial, read_c3d
from devices.marker_files.force_plates import read_force_plates
from gateway.analysis.analysing import Analysis, MeasuredForces, analyse
from gateway.analysis.floor import Source
from gateway.analysis.inertia import body_inertia
from gateway.analysis.muscles import MuscleResult, find_muscles
from gateway.body.markers import BodyMarkers
from gateway.body.rig import WorldSettings, worn_without_modules
from gateway.frames import FloatArray
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.recording import SkeletonArrays, open_recording
from gateway.recording.optical import write_solved_trial

DATA = Path(__file__).parents[2] / "shared" / "data" / "c3d_btk_pig"
STATIC, WALK = DATA / "PiG_Calibration-FlatFoot-Full.c3d", DATA / "PiG_Motion-FlatFoot-Full.c3d"
BODY_KG = 47.5
"""As the trial's file tells."""
CUTOFF_HZ = 6.0
MOMENTS = {
    ("ankle", "dorsiflexion"): ("Ankle", 0), ("knee", "flexion"): ("Knee", 0), ("hip", "flexion"): ("Hip", 0),
    ("knee", "adduction"): ("Knee", 1), ("hip", "adduction"): ("Hip", 1),
}  # fmt: skip
"""Ours by joint and movement, to the file's by joint and component; the file's have the opposite sign."""
GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Walk:
    """The trial analysed twice."""

    trial: MarkerTrial
    arrays: SkeletonArrays
    measured: Analysis
    estimated: Analysis
    muscles: MuscleResult
    ms: dict[str, float]
    """Processor time a frame, of torques and of muscles."""


def run() -> Report:
    """Closed forms, then the walking trial where it is there."""
    report = Report("analysis")
    report.figures.append(
        Figure("double_pendulum_error", double_pendulum_error(), "N m", "<1e-6", "largest, both joints")
    )
    if not WALK.is_file():
        return report
    walk = _walk()
    report.figures += _time_figures(walk)
    rows, figures = _moments(walk)
    report.figures += figures
    report.tables.append(
        "### Joint moments of a walking trial against the file's Plug-in-Gait, N m\n\n"
        "One step of each foot on a plate; the right heel lands beside its plate. Without: floor forces "
        "estimated from the motion alone. Plug-in-Gait took its own joint centres and masses from the same "
        "markers and plates: agreement, not truth.\n\n" + table(*rows)
    )
    report.tables.append(
        "### Floor forces estimated from the motion against the plates, N (weight 466 N)\n\n"
        + table(*_floor_rows(walk))
    )
    step = _on_plates(walk, "left")
    peer = opensim_beside(walk.measured, int(step[0]), int(step[-1]) + 1)
    if isinstance(peer, str):
        report.tables.append(f"### OpenSim beside it\n\nNot run: {peer}")
    else:
        figures, tables = _peer(walk, peer)
        report.figures += figures
        report.tables += tables
    return report


def _walk() -> Walk:
    marker_set = load_marker_set("plug_in_gait")
    trials = [read_c3d(STATIC), read_c3d(WALK)]
    fit = fit_body(marker_set, trials, FitOptions())
    suit = worn_without_modules(fit.skeleton, fit.markers, WorldSettings())
    with TemporaryDirectory() as folder:
        target = Path(folder) / "walk.mcap"
        write_solved_trial(trials[1], WALK, suit, "benchmark", target)
        arrays = open_recording(target).skeleton_arrays()
    inertia = body_inertia(fit.skeleton, BODY_KG)
    plates = MeasuredForces(read_force_plates(WALK), _up(fit.markers))
    estimated = analyse(arrays, "walk", inertia, GRAVITY, CUTOFF_HZ)  # compiles what is compiled
    begun = time.process_time()
    measured = analyse(arrays, "walk", inertia, GRAVITY, CUTOFF_HZ, plates)
    between = time.process_time()
    muscles = find_muscles(measured)
    done = time.process_time()
    frames = len(measured.time_s)
    spent = {"torques": 1e3 * (between - begun) / frames, "muscles": 1e3 * (done - between) / frames}
    return Walk(trials[1], arrays, measured, estimated, muscles, spent)


def _up(markers: BodyMarkers) -> str:
    return markers.vertical


def _time_figures(walk: Walk) -> list[Figure]:
    total = sum(walk.ms.values())
    return [
        Figure("analysis_ms_per_frame", total, "ms", "<5", "processor time, with muscles, no pictures"),
        Figure("torques_ms_per_frame", walk.ms["torques"], "ms", "", "filters, floor, inverse dynamics"),
        Figure("muscles_ms_per_frame", walk.ms["muscles"], "ms", "", "wires, moment arms and the programme"),
    ]


def _on_plates(walk: Walk, side: str) -> FloatArray:
    """(n,) frames in which a foot is on a plate."""
    names = walk.measured.skeleton.segment_names
    c = [names[s] for s in walk.measured.floor.segments].index(f"{side}_foot")
    return np.flatnonzero(walk.measured.floor.source[:, c] == Source.MEASURED)


def _moments(walk: Walk) -> tuple[tuple[list[str], list[list[str]]], list[Figure]]:
    rows, figures = [], []
    for side in ("left", "right"):
        frames = _on_plates(walk, side)
        for (joint, movement), (label, column) in MOMENTS.items():
            told = walk.trial.columns((f"{side[0].upper()}{label}Moment",))[frames, 0, column]
            told = -told / walk.trial.metres_per_unit * 1e-3 * BODY_KG  # N mm/kg, of the outer load
            known = np.isfinite(told)
            ours, without = (
                _torque(each, f"{side}_{joint}", movement)[frames][known]
                for each in (walk.measured, walk.estimated)
            )
            error, error_without = _rms(ours - told[known]), _rms(without - told[known])
            peak = float(np.abs(told[known]).max())
            rows.append(
                [f"{side} {joint}", movement, f"{peak:.1f}", f"{np.abs(ours).max():.1f}", f"{error:.1f}",
                 f"{np.corrcoef(ours, told[known])[0, 1]:.3f}", f"{np.abs(without).max():.1f}",
                 f"{error_without:.1f}", f"{np.corrcoef(without, told[known])[0, 1]:.3f}"]
            )  # fmt: skip
            if side == "left" and movement in ("dorsiflexion", "flexion"):
                note = f"left {joint} {movement} of peak {peak:.0f} N m, against Plug-in-Gait"
                figures.append(Figure(f"{joint}_moment_rmse", error, "N m", "", note))
    heads = ["joint", "movement", "file's peak", "peak", "RMSE", "r", "without: peak", "RMSE", "r"]
    return (heads, rows), figures


def _torque(found: Analysis, joint: str, movement: str) -> FloatArray:
    """(F,) N m."""
    j = [each.name for each in found.skeleton.joints].index(joint)
    k = [angle.name for angle in found.skeleton.joints[j].angles].index(movement)
    return found.torques[:, j, k]


def _floor_rows(walk: Walk) -> tuple[list[str], list[list[str]]]:
    rows = []
    for c, side in enumerate(("left", "right")):
        frames = _on_plates(walk, side)
        plate, guess = walk.measured.floor.force[frames, c], walk.estimated.floor.force[frames, c]
        errors = [_rms(guess[:, i] - plate[:, i]) for i in range(3)]
        rows.append(
            [side, *(f"{error:.0f}" for error in errors), f"{plate[:, 2].max():.0f}",
             f"{guess[:, 2].max():.0f}",
             f"{np.corrcoef(guess[:, 2], plate[:, 2])[0, 1]:.2f}"]
        )  # fmt: skip
    heads = ["foot", "RMSE forward", "sideways", "up", "peak up, plate", "estimated", "r up"]
    return heads, rows


def _peer(walk: Walk, peer: Peer) -> tuple[list[Figure], list[str]]:
    ours = sum(walk.ms.values())
    speedup = peer.static_optimisation_ms / ours
    figures = [
        Figure("opensim_inverse_dynamics_rmse", peer.torque_rmse, "N m", "", "same body, motion and forces"),
        Figure("opensim_static_optimisation_ms", peer.static_optimisation_ms, "ms", "", "a frame"),
        Figure("times_faster_than_opensim", speedup, "×", ">=30", "all of ours against its optimisation"),
    ]
    rows = [
        [name, f"{values[0]:.2f}", f"{values[1]:.3f}", f"{values[2]:.2f}", f"{values[3]:.2f}"]
        for name, values in peer.muscles.items()
    ]
    heads = ["muscle", "r", "RMSE of activity", "largest, OpenSim", "largest, ours"]
    return figures, [
        "### OpenSim's static optimisation beside ours\n\n" + peer.note + "\n\n" + table(heads, rows)
    ]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
