"""Recordings that begin in mid-motion, or shake, or come at half the rate: ``joint`` beside VQF.

Cut from the two trials of ``ring_chain5``: what a filter makes of a start that shows it neither a rest nor
undisturbed inclinations, and how it bears vibration that its modules' data sheets do not tell of.
"""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from devices.emulators.data_sets import METAL_TABLE_S, read_ring_chain5
from gateway.body.rig import load_rig
from gateway.emulation.optical_reference import in_time
from gateway.emulation.recordings import SCORED_AFTER_S, Excerpt, imu_frames, totals

SHAKES = 1.5
"""m/s², of each axis and sample, white."""

PARTS = (
    *(Excerpt("mid-motion", begins) for begins in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)),
    *(Excerpt("shaken", begins, shakes=SHAKES) for begins in (0.0, 0.2, 0.4, 0.6)),
    *(Excerpt("half the rate", begins, every=2) for begins in (0.0, 0.3)),
)
FIGURES = (
    ("rigid", "mid-motion", "<=0.5"),
    ("nonrigid", "mid-motion", ""),
    ("rigid", "shaken", "<=1.0"),
    ("nonrigid", "shaken", ""),
    ("rigid", "half the rate", "<=0.5"),
    ("nonrigid", "half the rate", "<=1.0"),
)


def run() -> Report:
    """Both trials, cut in every way; nothing where they are absent."""
    report = Report("beginnings")
    folder = DATA / "ring_chain5" / "trial1"
    if not folder.is_dir():
        print(f"skipped beginnings: no {folder}")
        return report
    rows: list[list[str]] = []
    for kind in ("rigid", "nonrigid"):
        recording, _ = in_time(read_ring_chain5(folder, kind), METAL_TABLE_S)
        frames = imu_frames(recording, load_rig("chain_5"))
        found = [(part, *totals(recording, frames, part)) for part in PARTS]
        for part, peer, ours in found:
            begins = f"{100 * part.begins:.0f} %"
            rows.append([kind, part.kind, begins, f"{peer:.2f}", f"{ours:.2f}", f"{ours / peer:.2f}"])
        for trial, of, target in FIGURES:
            if trial == kind:
                ratio = float(np.mean([ours / peer for part, peer, ours in found if part.kind == of]))
                name = f"beginnings_{trial}_{of.replace(' ', '_').replace('-', '_')}_ratio_vqf"
                note = "`joint` over `independent` (VQF), mean total error, mean of the parts' ratios"
                report.figures.append(Figure(name, ratio, "", target, note))
    heads = ["trial", "part", "begins at", "VQF, °", "`joint`, °", "ratio"]
    report.tables.append(
        "## Parts of `ring_chain5`: RMSE, degrees, mean of five segments\n\nScored from "
        f"{SCORED_AFTER_S:g} s after a part's beginning on, so that most of it is how soon headings are "
        f"found. Shaken: white noise of {SHAKES:g} m/s² on every axis of every accelerometer. Half the rate: "
        "every other sample. Five heading and mounting angles are taken out as in the accuracy suite.\n\n"
        + table(heads, rows)
    )
    return report
