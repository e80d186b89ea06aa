"""Headings by the sun against those by the magnetometer: an emulated arm through the wire; the almanac."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from benchmarks.figures import Figure, Report, table
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.sensing.light_sampler import Shade
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.rig import dress, move, sunlight
from gateway.geometry.comparison import orientation_error, rmse_deg
from gateway.pipeline import Pipeline
from gateway.sources.light import sun_direction
from gateway.stages.frame_assembler import AssemblyParams

MORNING_NS = round(datetime(2026, 6, 21, 7, 0, tzinfo=UTC).timestamp()) * 1_000_000_000
SECONDS, SETTLED_S, FROM_S, TO_S = 20.0, 5.0, 8.0, 16.0
STEP_S = 0.05
SEEDS = (1,)
MODULE = 2
LINK = "arm"

NREL_EXAMPLE = (datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 39.742476, -105.1786, 50.11162, 194.34024)
"""Time, latitude, longitude, topocentric zenith and azimuth, degrees: Reda & Andreas, NREL/TP-560-34302,
table A5.1 (refraction at 820 hPa)."""

SKY = {
    "clear": (),
    "cloud for 8 s": (Shade(FROM_S, TO_S, direct=0.05, sky=2.0),),
    "thin cloud for 8 s": (Shade(FROM_S, TO_S, direct=0.4, sky=2.5),),
    "one module in shadow": (Shade(FROM_S, TO_S, sky=0.7, module=MODULE),),
    "shadow's edge on one module": (Shade(FROM_S, TO_S, module=MODULE, cells=(0, 2)),),
}
MAGNETS = {
    "undisturbed": (),
    "magnet at one module for 8 s": (
        {"kind": "magnet", "module": MODULE, "at": FROM_S, "lasts": TO_S - FROM_S, "field": 60.0},
    ),
}
METHODS = ("joint", "articulated", "independent")


@dataclass(frozen=True)
class Result:
    """Heading errors of one or more runs, degrees RMS over all segments."""

    throughout: float
    meanwhile: float
    """Of the module concerned, from ``FROM_S`` to ``TO_S``."""
    counts: Counter[str]
    """Light readings by what they told."""


def run() -> Report:
    """The table of methods and skies; the almanac against a published example."""
    report, rows, figures = Report("sun"), [], {}
    for field, name, method, result in _all():
        readings = sum(result.counts.values())
        used = f"{100 * result.counts['sun'] / readings:.1f}" if readings else "–"
        why = ", ".join(f"{word} {n}" for word, n in result.counts.most_common() if word != "sun") or "–"
        rows.append(
            [field, name, method, f"{result.throughout:.2f}", f"{result.meanwhile:.2f}", used, why],
        )
        figures[field, name, method] = result
    heads = [
        "second field",
        "what happens",
        "method",
        "heading, °",
        "meanwhile, °",
        "light used, %",
        "turned away",
    ]
    report.tables.append(
        f"## Robot arm of 4 links, 100 Hz, June at 47.4° N, 9 o'clock; RMS; draws: {len(SEEDS)}\n\n"
        f"*Meanwhile*: of the module concerned, {FROM_S:g} s to {TO_S:g} s.\n\n" + table(heads, rows)
    )
    clear, magnetic = figures["sun", "clear", "joint"], figures["magnetometer", "undisturbed", "joint"]
    note = "heading error of `joint`, arm in the sun, magnetometers unused"
    report.figures.append(Figure("sun_heading_deg", clear.throughout, "°", "", note))
    note = "the same by an undisturbed magnetometer"
    report.figures.append(Figure("magnetometer_heading_deg", magnetic.throughout, "°", "", note))
    worst = max(figures["sun", name, "joint"].meanwhile for name in SKY)
    report.figures.append(
        Figure("sun_worst_sky_deg", worst, "°", "", "the same, worst sky or shadow, meanwhile")
    )
    note = "sun's place against NREL's published example"
    report.figures.append(Figure("sun_position_error_deg", _almanac_error_deg(), "°", "<=0.02", note))
    return report


def _all() -> Any:
    for name, shades in SKY.items():
        for method in METHODS if not shades else METHODS[:1]:
            yield "sun", name, method, _result("sun", method, shades, ())
    for name, faults in MAGNETS.items():
        for method in METHODS if not faults else METHODS[:1]:
            yield "magnetometer", name, method, _result("magnetometer", method, (), faults)
        yield "both", name, "joint", _result("both", "joint", (), faults)


def arm(second_field: str) -> WornSuit:
    """The shipped arm with cells, by what shows its headings."""
    suit = load_rig("robot_arm_4_sun")
    if suit.sun is None or second_field == "magnetometer":
        return replace(suit, sun=None)
    return replace(suit, sun=replace(suit.sun, beside_magnetometer=second_field == "both"))


def _result(field: str, method: str, shades: tuple[Shade, ...], faults: tuple[dict[str, Any], ...]) -> Result:
    suit, squares, meanwhile, counts = arm(field), [], [], Counter[str]()
    for seed in SEEDS:
        times_s, heading, seen = emulated(suit, method, shades, faults, seed)
        now = (times_s >= FROM_S) & (times_s < TO_S)
        squares.append(rmse_deg(heading[times_s >= SETTLED_S]) ** 2)
        meanwhile.append(rmse_deg(heading[now][:, MODULE]) ** 2)
        counts += seen
    return Result(float(np.sqrt(np.mean(squares))), float(np.sqrt(np.mean(meanwhile))), counts)


def emulated(
    suit: WornSuit, method: str, shades: tuple[Shade, ...], faults: tuple[dict[str, Any], ...], seed: int
) -> tuple[np.ndarray, np.ndarray, Counter[str]]:
    """Times (T,) s, heading errors (T, n) rad, light readings by what they told."""
    motion = move(dress(suit), suit.skeleton.name, seed)
    light = sunlight(suit, MORNING_NS)
    settings = SuitSettings(
        gravity=suit.gravity,
        magnetic_field=suit.magnetic_field,
        sunlight=None if light is None else replace(light, shades=shades),
    )
    plan = FaultPlan.model_validate({"faults": faults})
    traffic = FaultySuit(SuitTraffic(motion, settings, TYPICAL, seed), plan)
    pipeline = Pipeline(suit, AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000), method)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    frames = []
    for step in range(1, round(SECONDS / STEP_S) + 1):
        for sent in traffic.advance(step * STEP_S):
            frames += pipeline.feed(Chunk(sent.data, MORNING_NS + round(sent.time_s * 1e9), LINK))
    times_s = np.array([frame.time_ns - MORNING_NS for frame in frames]) * 1e-9
    q_wb = np.stack([frame.q_wb for frame in frames])
    heading = orientation_error(q_wb, motion.state(times_s).q_wb).heading
    seen: Counter[str] = (
        Counter() if pipeline.module_stage.sun is None else pipeline.module_stage.sun.totals()
    )
    return times_s, heading, seen


def _almanac_error_deg() -> float:
    when, latitude, longitude, zenith, azimuth = NREL_EXAMPLE
    found = sun_direction(round(when.timestamp()) * 1_000_000_000, latitude, longitude)
    up, around = np.radians(90.0 - zenith), np.radians(azimuth)
    true = np.array([np.cos(up) * np.sin(around), np.cos(up) * np.cos(around), np.sin(up)])
    return float(np.degrees(np.linalg.norm(np.cross(found, true))))
