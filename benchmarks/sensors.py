"""Magnetometer ellipsoids on synthetic and real data: how much |field| varies before and after.

Fitted on every other second of a recording, judged on the seconds between: nothing is fitted to noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from devices.emulators.data_sets import (
    read_broad,
    read_hipose_mtw17,
    read_repoimu_pendulum,
    read_repoimu_tstick,
    read_ring_chain5,
)
from devices.recorded_tracks import RecordedTracks
from gateway.calibration.sensors import magnetometer_ellipsoid
from gateway.frames import FloatArray

STRENGTH_UT = 50.0
ERGOWEAR_RATE_HZ = 100.0
RIOT_RATE_HZ = 200.0
BROAD_INTERVAL_S = 0.0035
SYNTHETIC = 200
HARD = np.array([22.0, -15.0, 30.0])
SOFT = np.array([[1.10, 0.04, -0.03], [0.02, 0.93, 0.05], [-0.05, 0.03, 1.02]])
"""Iron added to the real readings of a calibrated module (`broad_distorted`)."""


def run() -> Report:
    """Synthetic truth, then every recording that is there."""
    report = Report("sensors")
    _add_synthetic(report)
    rows: list[list[str]] = []
    by_set: dict[str, list[tuple[float, float]]] = {}
    for source, module, readings, rate in _recordings():
        row, spreads = _judged(source, module, readings, rate)
        rows.append(row)
        if spreads is not None:
            by_set.setdefault(source, []).append(spreads)
    for source, found in by_set.items():
        before, after = np.mean(found, axis=0)
        note = f"{source}: mean of {len(found)} modules whose calibration is not poor; before {before:.2f} %"
        report.figures.append(Figure(f"{source}_field_spread_after_percent", float(after), "%", "", note))
    heads = ["recording", "module", "directions seen %", "before %", "after %", "quality", "why"]
    report.tables.append(
        "## Spread of the field's norm (standard deviation over mean), on seconds not used for the fit\n\n"
        + table(heads, rows)
    )
    return report


def _add_synthetic(report: Report) -> None:
    errors, after = [], []
    for seed in range(SYNTHETIC):
        rng = np.random.default_rng(seed)
        v = rng.normal(size=(1000, 3))
        v *= STRENGTH_UT / np.linalg.norm(v, axis=1, keepdims=True)
        soft, hard = np.eye(3) + 0.15 * rng.uniform(-1, 1, (3, 3)), 40.0 * rng.uniform(-1, 1, 3)
        fit = magnetometer_ellipsoid(v @ soft.T + hard + 0.5 * rng.normal(size=v.shape), STRENGTH_UT).fit
        errors.append(float(np.abs(fit.bias - hard).max()))
        after.append(100.0 * fit.spread_after)
    note = f"{SYNTHETIC} modules: hard iron to 40 µT, soft iron to 15 %, noise 0.5 µT"
    report.figures += [
        Figure("synthetic_hard_iron_worst_ut", max(errors), "µT", "<=0.5", note),
        Figure("synthetic_field_spread_after_percent", float(np.mean(after)), "%", "<=1.5", note),
    ]


def _judged(
    source: str, module: str, readings: FloatArray, rate: float
) -> tuple[list[str], tuple[float, float] | None]:
    second = (np.arange(len(readings)) / rate).astype(np.int64)
    known = np.isfinite(readings).all(axis=1)
    used, judged = readings[known & (second % 2 == 0)], readings[known & (second % 2 == 1)]
    used = used * (STRENGTH_UT / np.linalg.norm(used, axis=1).mean())
    judged = judged * (STRENGTH_UT / np.linalg.norm(judged, axis=1).mean())
    try:
        result = magnetometer_ellipsoid(used, STRENGTH_UT)
    except ValueError as error:
        return [source, module, "–", "–", "–", "none", str(error)], None
    before, after = _spread(judged), _spread(result.fit.corrected(judged))
    quality = result.quality
    cells = [f"{100 * result.fit.coverage:.0f}", f"{before:.2f}", f"{after:.2f}", quality.verdict]
    why = quality.reasons[0] if quality.reasons else ""
    return [source, module, *cells, why], None if quality.verdict == "poor" else (before, after)


def _spread(readings: FloatArray) -> float:
    lengths = np.linalg.norm(readings, axis=1)
    return float(100.0 * lengths.std() / lengths.mean())


def _recordings() -> Iterator[tuple[str, str, FloatArray, float]]:
    """Name, module, raw readings (n, 3), samples a second."""
    if (path := DATA / "hipose_ergowear9" / "0.txt").exists():
        rows = np.loadtxt(path, delimiter=",")
        for n in range(9):
            yield "ergowear9", str(n + 1), rows[:, 7 + 9 * n : 10 + 9 * n], ERGOWEAR_RATE_HZ
    if (path := DATA / "riot_idle2" / "idle.csv").exists():
        yield from _riot(path)
    sources = [
        ("hipose_mtw17", read_hipose_mtw17, DATA / "hipose_mtw17"),
        ("ring_chain5", read_ring_chain5, DATA / "ring_chain5" / "trial1"),
        ("repoimu_pendulum", read_repoimu_pendulum, DATA / "repoimu_pendulum"),
        *(
            ("tstick", read_repoimu_tstick, trial)
            for trial in sorted((DATA / "repoimu_tstick").glob("*.csv"))
        ),
        *(("broad", read_broad, trial) for trial in sorted((DATA / "broad").glob("*.mat"))),
    ]
    for source, read, place in sources:
        if place.exists():
            recording: RecordedTracks = read(place)
            for track in recording.modules:
                name = place.stem if len(recording.modules) == 1 else track.name
                yield source, name, track.magnetic_field, recording.sampling_rate_hz
                if source == "broad":
                    yield (
                        "broad_distorted",
                        name,
                        track.magnetic_field @ SOFT.T + HARD,
                        1.0 / BROAD_INTERVAL_S,
                    )


def _riot(path: Path) -> Iterator[tuple[str, str, FloatArray, float]]:
    modules: dict[str, list[list[float]]] = {}
    for line in path.read_text().splitlines():
        cells = line.split(",")
        if len(cells) > 10 and cells[1].endswith("/raw"):
            modules.setdefault(cells[1].split("/")[1], []).append([float(cell) for cell in cells[8:11]])
    for module, readings in modules.items():
        yield "riot_idle2", module, np.array(readings), RIOT_RATE_HZ
