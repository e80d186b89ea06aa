"""Suite ``analysis``: torques against closed forms and two trials' own moments, live muscles, OpenSim."""

from __future__ import annotations

import numpy as np

from benchmarks.analysis_live import live_beside
from benchmarks.analysis_moments import MomentRow, agreement, given_table, moment_rows, torque
from benchmarks.analysis_peer import AT_WORK, Peer, opensim_beside
from benchmarks.analysis_pendulum import double_pendulum_error
from benchmarks.analysis_stages import stage_ms
from benchmarks.analysis_timing import timing_rows
from benchmarks.analysis_trials import (
    CUTOFF_HZ,
    GRAVITY,
    STAIR,
    WALK,
    AnalysedTrial,
    analysed,
    on_plates,
    rms,
)  # fmt: skip
from benchmarks.figures import Figure, Report, table
from gateway.analysis.analysing import Analysis, analyse
from gateway.analysis.muscles import MuscleResult, find_muscles

STRIDE = (158, 259)
"""Frames of the walk from the left heel's landing to its next."""
ON_PLATES_S = {WALK.name: (1.25, 2.04), STAIR.name: (0.7, 2.5)}
"""From when to when all feet that stand are on plates."""


def run() -> Report:
    """Closed forms, then the trials where they are there."""
    report = Report("analysis")
    report.figures.append(
        Figure("double_pendulum_error", double_pendulum_error(), "N m", "<1e-6", "largest, both joints")
    )
    if not WALK.is_there:
        return report
    walk = analysed(WALK)
    muscles = find_muscles(walk.measured)
    _add_times(report, walk, muscles)
    _add_moments(report, walk)
    timing = timing_rows(walk, *ON_PLATES_S[WALK.name])
    if STAIR.is_there:
        stair = analysed(STAIR)
        _add_stair(report, stair)
        timing += timing_rows(stair, *ON_PLATES_S[STAIR.name])
    _add_timing(report, timing)
    _add_live(report, walk)
    peer = opensim_beside(walk.measured, muscles, *STRIDE)
    if isinstance(peer, str):
        report.tables.append(f"## OpenSim beside it\n\nNot run: {peer}")
    else:
        _add_peer(report, peer)
    return report


def _add_times(report: Report, walk: AnalysedTrial, muscles: MuscleResult) -> None:
    spent = stage_ms(walk, muscles)
    total = sum(spent.values())
    report.figures.append(
        Figure("analysis_ms_per_frame", total, "ms", "<5", "processor time, with muscles, no pictures")
    )
    rows = [[name, f"{ms:.2f}", f"{100 * ms / total:.0f} %"] for name, ms in spent.items()]
    report.tables.append("## Processor time by stage, a frame\n\n" + table(["stage", "ms", "share"], rows))


def _add_moments(report: Report, walk: AnalysedTrial) -> None:
    without = analyse(walk.arrays, "walk", walk.inertia, GRAVITY, CUTOFF_HZ)
    rows = moment_rows(walk)
    for row in rows:
        if row.side == "left" and row.movement in ("dorsiflexion", "flexion"):
            note = f"left {row.joint} {row.movement} of peak {np.abs(row.recorded).max():.0f} N m, same axes"
            value = rms(row.distal - row.recorded)
            report.figures.append(Figure(f"{row.joint}_moment_rmse", value, "N m", "", note))
    report.tables.append(
        "## Joint moments of a walking trial against the file's Plug-in-Gait, N m\n\n"
        "One step of each foot on a plate; the right heel lands beside its plate. Plug-in-Gait took its own "
        "joint centres and masses from the same markers and plates: agreement, not truth. It writes moments "
        "along the distal segment's axes, we along those of the joint's angles: both are compared.\n\n"
        + table(*given_table(rows))
    )
    report.tables.append(
        "## The same without plates: floor forces estimated from the motion alone\n\n"
        + table(*_without_table(rows, without))
    )
    report.tables.append(
        "## Floor forces estimated from the motion against the plates, N (weight 466 N)\n\n"
        "The right heel lands beside its plate, which measures too little of it at first.\n\n"
        + table(*_floor_rows(walk.measured, without))
    )


def _without_table(rows: list[MomentRow], without: Analysis) -> tuple[list[str], list[list[str]]]:
    cells = []
    for row in rows:
        guess = torque(without, f"{row.side}_{row.joint}", row.movement)[row.frames]
        cells.append(
            [f"{row.side} {row.joint}", row.movement, f"{np.abs(row.ours).max():.1f}",
             *agreement(guess, row.ours)]
        )  # fmt: skip
    return ["joint", "movement", "with plates: peak", "without: peak", "RMSE", "r"], cells


def _floor_rows(measured: Analysis, estimated: Analysis) -> tuple[list[str], list[list[str]]]:
    rows = []
    for c, side in enumerate(("left", "right")):
        frames = on_plates(measured, side)
        plate, guess = measured.floor.force[frames, c], estimated.floor.force[frames, c]
        errors = [rms(guess[:, i] - plate[:, i]) for i in range(3)]
        rows.append(
            [side, *(f"{error:.0f}" for error in errors), f"{plate[:, 2].max():.0f}",
             f"{guess[:, 2].max():.0f}", f"{np.corrcoef(guess[:, 2], plate[:, 2])[0, 1]:.2f}"]
        )  # fmt: skip
    return ["foot", "RMSE forward", "sideways", "up", "peak up, plate", "estimated", "r up"], rows


def _add_stair(report: Report, stair: AnalysedTrial) -> None:
    report.tables.append(
        "## Joint moments of a second trial: down a stair of four plates, N m (weight 834 N)\n\n"
        "Only the steps whose plates the file itself took into account. In this file the shanks are twisted "
        "against the thighs by up to 30°, so that it matters much about which axis a moment is told.\n\n"
        + table(*given_table(moment_rows(stair)))
    )


def _add_timing(report: Report, rows: list[list[str]]) -> None:
    report.tables.append(
        "## Do plates and motion go in step?\n\n"
        "By how many milliseconds the plates' total force comes after the force that the centre of mass "
        "takes (in brackets what then is left between them, standard deviation in N, and what is left "
        "unshifted). Shifted clocks would shift all axes alike. They do not, in neither laboratory, and the "
        "centre of mass that Plug-in-Gait wrote into its file shows the same: it comes from the model of "
        "rigid segments, and the analysis shifts nothing.\n\n"
        + table(["centre of mass", "forward", "sideways", "up"], rows)
    )


def _add_live(report: Report, walk: AnalysedTrial) -> None:
    live = live_beside(walk)
    note = "activities of all muscles over the walk, live against the whole motion's"
    report.figures += [
        Figure("live_muscles_r", live.r, "", "", note),
        Figure("live_muscles_median_r", live.median_r, "", "", "of the muscles that reach 0.1"),
        Figure("live_muscles_rmse", live.rmse, "", "", "of activity, 0 to 1"),
        Figure("live_muscles_ms", live.ms, "ms", "", "processor time of one of ten answers a second"),
    ]


def _add_peer(report: Report, peer: Peer) -> None:
    ours = next(figure.value for figure in report.figures if figure.name == "analysis_ms_per_frame")
    solved = f"{peer.solved} of {peer.frames} frames that OpenSim's optimiser solved"
    speedup = peer.static_optimisation_ms / ours
    report.figures += [
        Figure("opensim_inverse_dynamics_rmse", peer.torque_rmse, "N m", "", "same body, motion and forces"),
        Figure("opensim_activity_r", peer.activity_r, "", "", f"all muscles, in the {solved}"),
        Figure("opensim_activity_rmse", peer.activity_rmse, "", "", f"of activity, in the {solved}"),
        Figure("opensim_activity_r_all", peer.all_r, "", "", f"in all {peer.frames} frames of a stride"),
        Figure("opensim_activity_rmse_all", peer.all_rmse, "", "", f"in all {peer.frames} frames"),
        Figure("opensim_static_optimisation_ms", peer.static_optimisation_ms, "ms", "", "a frame"),
        Figure("times_faster_than_opensim", speedup, "×", ">=30", "all of ours against its optimisation"),
    ]
    arms = [
        [angle, str(arm.count), f"{arm.rmse_mm:.2f}", f"{arm.worst_mm:.1f}", arm.worst]
        for angle, arm in peer.arms.items()
    ]
    report.tables.append(
        "## Moment arms beside OpenSim's, over a stride\n\n"
        "The same wires over the same cylinders and balls, slid by either program's own rules.\n\n"
        + table(["angle", "muscles", "RMSE, mm", "worst, mm", "muscle"], arms)
    )
    rows = [
        [name, f"{each.r:.2f}", f"{each.rmse:.3f}", f"{each.theirs:.2f}", f"{each.ours:.2f}"]
        for name, each in peer.muscles.items()
    ]
    report.tables.append(
        "## OpenSim's static optimisation beside ours\n\n"
        f"OpenSim {peer.version}, {peer.frames} frames of a whole left stride; the same body, motion, floor "
        "forces and wires as ideal pullers (no force-length curves in either), squared activity. Both "
        "minimise the same; in some frames OpenSim's optimiser stops above our value by more than 5 %, with "
        f"many muscles pulling against each other: compared are the {solved} as low. Shown are muscles that "
        f"reach an activity of {AT_WORK:g}.\n\n"
        + table(["muscle", "r", "RMSE of activity", "largest, OpenSim", "largest, ours"], rows)
    )
