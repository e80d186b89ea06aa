"""Walking and running through the world: emulated with known truth; two real feet beside their markers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from benchmarks.foot_recording import FootResult, measure_foot, read_foot
from devices.emulators.motion.gait import RUN, WALK
from devices.emulators.motion.motions import gait_motion
from gateway.body.rig import load_rig
from gateway.emulation.recordings import SMOOTHED, solved
from gateway.emulation.rig import dress
from gateway.emulation.simulation import SENSORS, WALK_FROM_S, WalkResult, assembled, measure_walk

SEED = 1
METHODS = ("independent", "outward", "joint", SMOOTHED)
FOOT_METHODS = ("independent", "joint")
GAITS = {
    "walk, straight": (WALK, 60.0),
    "walk, circle of 4 m": (replace(WALK, radius=4.0), 30.0),
    "run, straight": (RUN, 30.0),
}


def run() -> Report:
    """Emulated walks by every method, then the recording if it is there."""
    report = Report("walking")
    suit = replace(load_rig("suit_17"), local_devices=())
    rows, walked = [], {}
    for name, (gait, seconds) in GAITS.items():
        motion = gait_motion(dress(suit), SEED, gait=gait)
        observed = assembled(suit, motion, SENSORS, seconds, SEED)
        for method in METHODS:
            frames = solved(method, suit, 0.01, observed)
            result = walked[name, method] = measure_walk(frames, motion)
            rows.append(
                [
                    name,
                    method,
                    f"{result.total_deg:.2f} / {result.tilt_deg:.2f}",
                    f"{result.covered_percent:.0f}",
                    f"{result.distance_m:.1f}",
                    f"{100 * result.length_error:+.2f}",
                    f"{100 * result.end_error:.2f}",
                    f"{1000 * result.height_error_m:.0f}",
                    str(result.switches),
                    f"{result.largest_step_deg:.3f}",
                ]
            )
    _add_emulated(report, rows, walked)
    _add_feet(report)
    return report


def _add_emulated(report: Report, rows: list[list[str]], walked: dict[tuple[str, str], WalkResult]) -> None:
    heads = [
        "gait", "method", "total / tilt RMSE °", "% in 2σ", "path m",
        "path length error %", "end error % of path", "largest height error mm",
        "root switches", "largest orientation step at a switch °",
    ]  # fmt: skip
    report.tables.append(
        "## Emulated person, 17 consumer sensors, lever arms 1 cm off, no local device, 100 Hz\n\n"
        f"Counted from {WALK_FROM_S:g} s on. The end error holds the heading's error, the length error does "
        "not. Its feet stand still in the world; its bones are as long as the rig says."
        "\n\n" + table(heads, rows)
    )
    both = {m: np.mean([r.total_deg for (_, by), r in walked.items() if by == m]) for m in METHODS}
    for name, ours, peer, target in (
        ("walk_total_ratio_vqf", "joint", "independent", "<=1.0"),
        ("smoothed_walk_total_ratio", SMOOTHED, "joint", "<1.0"),
    ):
        note = f"`{ours}` over `{peer}`, mean total error of the orientations, all gaits"
        report.figures.append(Figure(name, float(both[ours] / both[peer]), "", target, note))
    for method in METHODS:
        straight = walked["walk, straight", method]
        note = f"`{method}`, straight walk of {straight.distance_m:.0f} m"
        name = method.replace(", ", "_")
        report.figures += [
            Figure(f"walk_length_error_{name}_percent", 100 * abs(straight.length_error), "%", "<2", note),
            Figure(f"walk_end_error_{name}_percent", 100 * straight.end_error, "%", "", note),
        ]
        steps = max(result.largest_step_deg for key, result in walked.items() if key[1] == method)
        report.figures.append(
            Figure(
                f"root_switch_step_{name}_deg", steps, "°", "<0.5", f"`{method}`, all gaits, worst segment"
            )
        )


def _add_feet(report: Report) -> None:
    folder = DATA / "gaitmap_foot"
    if not folder.exists():
        print(f"skipped feet: {folder} is not there")
        return
    results = {
        (side, method): measure_foot(read_foot(folder, side), method)
        for side in ("left", "right")
        for method in FOOT_METHODS
    }
    rows = [
        [*key, *(f"{value:.{digits}f}" for value, digits in zip(r, FootResult.digits(), strict=True))]
        for key, r in results.items()
    ]
    report.tables.append(
        "## Real feet (20 m there and back, optical markers on toe, ball and heel)\n\n"
        "A foot is truly at rest while all three markers move slower than 0.2 m/s. Strides from one stance "
        "to the next without magnetometer, by zero-velocity updates, against theirs."
        "\n\n" + table(["foot", "method", *FootResult.heads()], rows)
    )
    for name, target, note in (
        ("precision", ">=0.95", "stance frames detected that are"),
        ("recall", "", "stance frames that are detected"),
        ("distance_error_percent", "<2", "sum of strides against the markers'"),
    ):
        worst = (min if name in ("precision", "recall") else max)(
            abs(getattr(r, name)) for (_, method), r in results.items() if method == "joint"
        )
        unit = "%" if "percent" in name else ""
        whose = f"real feet, `joint`, the worse: {note}"
        report.figures.append(Figure(f"feet_{name}", worst, unit, target, whose))
