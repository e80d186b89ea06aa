"""Rates of real modules, recovered from arrival times."""

from __future__ import annotations

import csv
import os
from datetime import datetime
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, table
from gateway.clocks import EstimatedClock
from gateway.frames import FloatArray, IntArray
from gateway.sources.statistics import LinkLosses, SequenceCounter

DATA = Path(os.environ.get("MOCAP_DATA") or Path(__file__).parents[2] / "shared" / "data")
JITTER_US = 1000.0
NOMINAL_US = 20_000.0
SEEDS = 5


def xio_modules(folder: Path) -> dict[str, tuple[IntArray, FloatArray]]:
    """By module: counters (n,) as they would have been sent, and its real times on the shared clock, µs."""
    modules = {}
    for path in sorted(folder.glob("*/Inertial.csv")):
        times_us = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0)
        interval_us = np.median(np.diff(times_us))
        counter = np.concatenate([[0], np.cumsum(np.round(np.diff(times_us) / interval_us))]).astype(np.int64)
        modules[path.parent.name.split(" 64")[0]] = (counter, times_us)
    return modules


def recovered_ppm(counter: IntArray, times_us: FloatArray, seed: int, seconds: float = np.inf) -> float:
    """Rate against nominal from counters and arrivals with added jitter, after so many seconds, ppm."""
    arrived_us = times_us + np.random.default_rng(seed).exponential(JITTER_US, len(times_us))
    arrived_us = np.maximum.accumulate(arrived_us)
    clock = EstimatedClock()
    for n, at in zip(counter.tolist(), arrived_us.tolist(), strict=True):
        if at - times_us[0] <= seconds * 1e6:
            clock.gateway_time(round(n * NOMINAL_US), round(at * 1e3))
    return clock.figures().skew_ppm


def _fitted_ppm(counter: IntArray, times_us: FloatArray) -> float:
    return float((NOMINAL_US / np.polyfit(counter, times_us, 1)[0] - 1.0) * 1e6)


def riot_modules(path: Path) -> dict[str, FloatArray]:
    """By module: arrival times, s."""
    arrivals: dict[str, list[float]] = {}
    with path.open() as lines:
        for row in csv.reader(lines):
            arrivals.setdefault(row[1], []).append(datetime.fromisoformat(row[0]).timestamp())
    return {name: np.array(times) for name, times in arrivals.items()}


def recorded_clocks() -> tuple[list[Figure], str]:
    """Figures of both recordings and their table; nothing where the recordings are absent."""
    if not (DATA / "xio_lower_body7").is_dir() or not (DATA / "riot_idle2").is_dir():
        return [], "## Recordings\n\nNot there when this was written."
    rows, errors, lost = [], [], 0
    for name, (counter, times_us) in xio_modules(DATA / "xio_lower_body7").items():
        fitted = _fitted_ppm(counter, times_us)
        found = np.array([recovered_ppm(counter, times_us, seed, 15.0) for seed in range(SEEDS)])
        sequence, link = SequenceCounter(), LinkLosses()
        for number in counter.tolist():
            sequence.count(number % 65536, link)
        errors.append(np.abs(found - fitted).max())
        lost += sequence.lost
        rows.append([name, f"{fitted:+.1f}", f"{found.mean():+.1f}", f"{errors[-1]:.1f}", str(sequence.lost)])
    for name, times in riot_modules(DATA / "riot_idle2" / "idle.csv").items():
        clock = EstimatedClock()
        for n, at in enumerate((times - times[0]).tolist()):
            clock.gateway_time(n * 5000, round(at * 1e9))
        settled = times > times[0] + 1.0
        fitted = (0.005 / np.polyfit(np.arange(len(times))[settled], times[settled], 1)[0] - 1.0) * 1e6
        rows.append([f"riot {name}", f"{fitted:+.0f}", f"{clock.figures().skew_ppm:+.0f}", "–", "–"])
    figures = [
        Figure(
            "xio_worst_ppm", float(np.max(errors)), "ppm", "<=5",
            f"7 real modules, stamps hidden, 1 ms of jitter added, after 15 s: worst of {SEEDS} draws",
        ),
        Figure("xio_lost_found", float(lost), "", "", "lost packets found by their counters; 126 are known"),
    ]  # fmt: skip
    text = (
        "## Recordings\n\n"
        "Rate against nominal. `xio_lower_body7`: fitted to the real stamps; found from counters and "
        "jittered arrivals alone after 15 s. `riot_idle2` (bursts to 0.94 s, no stamps, no counters, so "
        "losses count as slowness): fitted is the straight line through the arrivals after the first "
        "second.\n\n"
    )
    return figures, text + table(["module", "fitted ppm", "found ppm", "worst error ppm", "lost"], rows)
