"""Recordings that begin in mid-motion, or shake, or come at half the rate: ``joint`` beside VQF.

Cut from the two trials of ``ring_chain5``: what a filter makes of a start that shows it neither a rest nor
undisturbed inclinations, and how it bears vibration that its modules' data sheets do not tell of.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy import DATA, METAL_TABLE_S
from benchmarks.figures import Figure, Report, table
from benchmarks.offline import imu_frames, orientations
from benchmarks.optical_reference import in_time
from benchmarks.peers import solved
from benchmarks.scoring import score
from devices.emulators.recording_formats import read_ring_chain5
from devices.emulators.recordings import Recording
from gateway.body.rig import load_rig
from gateway.frames import ImuFrame

PEER, OURS = "independent", "joint"
SCORED_AFTER_S = 2.0
"""Of a part that begins in motion; a whole recording is scored from where it leaves the metal table."""
SHAKES = 1.5
"""m/s², of each axis and sample, white."""


class Part(NamedTuple):
    """What is cut from a recording."""

    kind: str
    begins: float  # share of the recording left out
    every: int = 1  # sample taken
    shakes: float = 0.0  # m/s²


PARTS = (
    *(Part("mid-motion", begins) for begins in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)),
    *(Part("shaken", begins, shakes=SHAKES) for begins in (0.0, 0.2, 0.4, 0.6)),
    *(Part("half the rate", begins, every=2) for begins in (0.0, 0.3)),
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
        "### Parts of `ring_chain5`: RMSE, degrees, mean of five segments\n\nScored from "
        f"{SCORED_AFTER_S:g} s after a part's beginning on, so that most of it is how soon headings are "
        f"found. Shaken: white noise of {SHAKES:g} m/s² on every axis of every accelerometer. Half the rate: "
        "every other sample. Five heading and mounting angles are taken out as in the accuracy suite.\n\n"
        + table(heads, rows)
    )
    return report


def totals(recording: Recording, frames: list[ImuFrame], part: Part) -> tuple[float, float]:
    """Degrees, mean of the segments: VQF's and ours. frames: of the whole recording."""
    begun_s = max(float(track.times[0]) for track in recording.modules)
    taken = _cut(frames, part)
    begins_s = begun_s + (taken[0].time_ns - frames[0].time_ns) * 1e-9
    from_s = max(METAL_TABLE_S, begins_s + SCORED_AFTER_S) if part.begins else METAL_TABLE_S
    peer, ours = (_total(method, taken, begins_s, from_s, recording) for method in (PEER, OURS))
    return peer, ours


def _cut(frames: list[ImuFrame], part: Part) -> list[ImuFrame]:
    rng = np.random.default_rng(1)
    taken = frames[int(part.begins * len(frames)) :: part.every]
    return [
        replace(
            frame,
            sequence=k,
            specific_force=frame.specific_force
            + part.shakes * rng.standard_normal(frame.specific_force.shape),
        )
        for k, frame in enumerate(taken)
    ]


def _total(
    method: str, frames: list[ImuFrame], begins_s: float, from_s: float, recording: Recording
) -> float:
    interval_s = (frames[1].time_ns - frames[0].time_ns) * 1e-9
    times_s, q_wb = orientations(solved(method, load_rig("chain_5"), interval_s, frames), begins_s)
    return float(score(times_s, q_wb, recording, from_s).total.mean())
