"""How soon a module's orientation is right again after a gap in its samples, with ``independent``.

Gaps are cut into all modules at once, again and again, of an emulated walk and of real recordings; what
counts is the angle to the same run without gaps. (Against an optical reference both have the filter's own
error besides.)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, Report, table
from devices.emulators.data_sets import read_broad, read_ring_chain5
from devices.link import Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.recordings import imu_frames
from gateway.emulation.simulation import LINK, relay_chunks, suit_17
from gateway.frames import FloatArray, ImuFrame, Status
from gateway.pipeline import Pipeline
from gateway.reconstruction import create_reconstructor
from gateway.settings import AssemblySettings

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[2] / "shared" / "data"))
METHOD = "independent"
GAPS_S = (0.05, 0.3, 1.0, 5.0)
AFTER_S = (0.3, 1.0, 3.0, 10.0, 20.0)
FIRST_S, EVERY_S = 25.0, 26.0
"""When gaps begin: filters have settled, and settle again."""
WALK_S = 105.0

Frames = list[ImuFrame]


def run() -> Report:
    """Every source that is there, every length of gap."""
    report = Report("gaps")
    rows: list[list[str]] = []
    for name, get in _sources().items():
        try:
            trials = get()
        except FileNotFoundError as error:
            print(f"skipped {name}: {error}")
            continue
        whole = [_solved(suit, frames) for suit, frames in trials]
        for gap_s in GAPS_S:
            cut = (_errors_deg(*trial, q, gap_s) for trial, q in zip(trials, whole, strict=True))
            errors = np.concatenate(list(cut))
            typical = np.sqrt(np.mean(errors**2, axis=0))
            worse = np.percentile(errors, 95.0, axis=0)
            cells = [f"{a:.2f} / {b:.1f}" for a, b in zip(typical, worse, strict=True)]
            rows.append([name, f"{gap_s:g}", str(len(errors)), *cells])
            if gap_s == 1.0:
                note = f"{name}: RMS 3 s after a gap of 1 s, from the run without gaps"
                report.figures.append(Figure(f"gap_{name.partition(',')[0]}_deg", typical[2], "°", "", note))
    heads = ["source", "gap, s", "gaps × modules", *(f"after {after:g} s" for after in AFTER_S)]
    report.tables = [
        "## From the run without gaps, degrees: RMS / 95 %\n\nUp to 0.1 s a gap is bridged, beyond that the "
        "module settles for 3 s: see `gateway/reconstruction/inertial/module_filter.py`. Its constants were "
        "chosen on these sources.\n\n" + table(heads, rows)
    ]
    return report


def _sources() -> dict[str, Callable[[], list[tuple[WornSuit, Frames]]]]:
    broad, ring = DATA / "broad", DATA / "ring_chain5" / "trial1"
    single, chain = load_rig("single_placed"), load_rig("chain_5")
    return {
        "walk, 17 emulated modules": lambda: [_walk()],
        "broad, 4 trials": lambda: [
            (single, imu_frames(read_broad(path), single)) for path in sorted(broad.glob("*.mat"))
        ],
        "ring, 5 modules, 2 trials": lambda: [
            (chain, imu_frames(read_ring_chain5(ring, kind), chain)) for kind in ("rigid", "nonrigid")
        ],
    }


def _walk() -> tuple[WornSuit, Frames]:
    suit, motion = suit_17()
    pipeline = Pipeline(suit, AssemblySettings().params(), METHOD)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    return suit, [frame for chunk in relay_chunks(motion, WALK_S) for frame in pipeline.imu_frames(chunk)]


def _errors_deg(suit: WornSuit, frames: Frames, whole: FloatArray, gap_s: float) -> FloatArray:
    """(gaps × modules, instants): angle to the run without gaps, ``whole``, so long after each of them."""
    times_s = (np.array([frame.time_ns for frame in frames]) - frames[0].time_ns) * 1e-9
    begins = np.arange(FIRST_S, times_s[-1] - gap_s - AFTER_S[-1] - 0.1, EVERY_S)
    is_gap = np.any([(times_s >= begin) & (times_s < begin + gap_s) for begin in begins], axis=0)
    cut = _solved(suit, [_silent(frame) if gap else frame for frame, gap in zip(frames, is_gap, strict=True)])
    cosine = np.abs(np.sum(whole * cut, axis=2))
    angle = np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))
    looks = np.searchsorted(times_s, begins[:, None] + gap_s + np.array(AFTER_S))  # (gaps, instants)
    return np.asarray(angle[looks].transpose(0, 2, 1).reshape(-1, len(AFTER_S)))


def _silent(frame: ImuFrame) -> ImuFrame:
    """As if no module had said anything."""
    none = np.full_like(frame.specific_force, np.nan)
    status = np.full_like(frame.status, Status.MISSING)
    return replace(frame, specific_force=none, angular_rate=none, magnetic_field=none, status=status)


def _solved(suit: WornSuit, frames: Sequence[ImuFrame]) -> FloatArray:
    """q_wb of the segments with modules, (T, modules, 4)."""
    interval_s = (frames[-1].time_ns - frames[0].time_ns) * 1e-9 / (len(frames) - 1)
    reconstructor = create_reconstructor(METHOD, suit, round(interval_s, 6))
    sensed = suit.module_of_segment >= 0
    return np.stack([reconstructor.update(frame).q_wb[sensed] for frame in frames])
