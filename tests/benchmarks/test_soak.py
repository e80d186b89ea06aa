"""A minute of random faults on a running gateway, the short form of `make soak`; and what judges it."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from benchmarks import soak
from benchmarks.soak_reference import LATEST_S, SETTLED_S, SINCE_S, Comparison, Orientations
from benchmarks.soak_simulated import simulated
from devices.emulators.faults.fault_plan import FaultPlan
from gateway.emulation.simulation import suit_17
from gateway.frames import Status

HELD_UP = {
    "seconds": 100.0,
    "suit_s": 100.0,
    "poses": 9000,
    "failures": {},
    "suit_late_s": 0.1,
    "busy_share": 0.0,
    "compared_in": soak.REAL_TIME,
    "uneven_looks": 0,
    "rss_growth_mb": 1.0,
    "descriptors_left": 0,
    "tasks_left": 0,
    "compared": [
        {"intact_s": since_s, "count": 100, "p99.9_deg": 1.0, "p99_rad_s": 0.1} for since_s in SINCE_S
    ],
}


@pytest.mark.slow(reason="a minute of faults in real time")
@pytest.mark.system
@pytest.mark.timeout(400)
async def test_a_minute_of_faults():
    if shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin") is None:
        pytest.skip("mosquitto is not installed")
    report = await soak.soak(seed=2, seconds=60.0)
    # A minute is too short for a segment to be intact for long, and for memory to show a trend.
    found = [c for c in soak.complaints(report) if "intact for long" not in c and "memory" not in c]
    assert found == []
    assert len(report["faults"]) >= 5


@pytest.mark.slow(reason="seconds of real time, one suit after another")
@pytest.mark.system
@pytest.mark.parametrize("shape", soak.SHAPES)
async def test_a_few_seconds_of_a_suit_of_which_somebody_is_silent(shape):
    if shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin") is None:
        pytest.skip("mosquitto is not installed")
    report = await soak.soak_shape(shape, 5.0)
    assert [c for c in soak.complaints(report) if "memory" not in c] == []
    assert (report["poses"] > 0) == soak.SHAPES[shape].makes_poses


def test_without_faults_only_what_is_left_over_and_missing_poses_are_complained_of():
    quiet = {key: value for key, value in HELD_UP.items() if not key.startswith("compared")}
    assert soak.complaints(quiet | {"shape": "single"}) == []
    assert soak.complaints(quiet | {"shape": "local", "poses": 0}) == []
    (said,) = soak.complaints(quiet | {"shape": "lone", "poses": 0})
    assert "only 0 poses" in said


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"failures": {"suit": "OSError(5)"}}, "the suit ended before its time: OSError(5)"),
        ({"uneven_looks": 2}, "balances were uneven at 2 looks"),
        ({"rss_growth_mb": 5.0}, "memory grew by 5.0 MB"),
        ({"descriptors_left": 1}, "1 descriptors were left open"),
        ({"tasks_left": 3}, "3 tasks were left running"),
        ({"poses": 4000}, "only 4000 poses came of 100 s of the suit"),
        ({"compared": [{**HELD_UP["compared"][0], "p99.9_deg": 9.0}]}, "9.0 degrees"),
        ({"compared": [{**HELD_UP["compared"][0], "count": 0}]}, "no segment was intact"),
        ({"compared": [{**HELD_UP["compared"][0], "p99_rad_s": 2.0}]}, "2.0 rad/s"),
    ],
)
def test_what_does_not_hold_is_said(changed, complaint):
    assert soak.complaints(HELD_UP) == []
    (said,) = soak.complaints(HELD_UP | changed)
    assert complaint in said


def test_rates_need_clocks_that_a_busy_machine_did_not_unsettle():
    first, last = HELD_UP["compared"][0], HELD_UP["compared"][-1]
    off = HELD_UP | {"compared": [{**first, "p99_rad_s": 2.0}, last]}
    busy = {"busy_share": 0.4}
    assert soak.complaints(off) != []
    assert soak.complaints(off | busy) == []
    assert soak.complaints(off | busy | {"compared_in": soak.SIMULATED_TIME}) != []
    assert soak.complaints(off | busy | {"compared": [first, {**last, "p99_rad_s": 2.0}]}) != []


@pytest.mark.slow(reason="minutes of simulated time, twice")
@pytest.mark.timeout(900)
def test_poses_equal_those_of_a_fault_free_run_in_simulated_time():
    """A gyroscope that was saturated for a second used to leave its segment 20° off for half a minute."""
    faults = [
        {"kind": "saturated", "at": 21.0, "lasts": 1.0, "module": 1},
        {"kind": "reset", "at": 22.0, "lasts": 0.3, "module": 2},
        {"kind": "clock_jump", "at": 23.0, "by": -5.0, "module": 3},
        {"kind": "unplug", "at": 24.0, "lasts": 1.0},
    ]
    *_, longest = simulated(FaultPlan.model_validate({"faults": faults}), 50.0)
    assert longest["count"] > 1000
    assert longest["p99.9_deg"] < soak.LARGEST_ANGLE_DEG
    assert longest["p99_rad_s"] < soak.LARGEST_RATE


def test_only_segments_with_intact_inputs_are_compared():
    """A fault of one module's sensors takes its segment out, and a status that tells of a loss does."""
    worn, _ = suit_17()
    n, module = len(worn.skeleton.segment_names), worn.module_ids[3]
    segment = int(np.flatnonzero(worn.module_of_segment == 3)[0])
    sensed = int(np.count_nonzero(worn.module_of_segment >= 0))
    plan = FaultPlan.model_validate(
        {"faults": [{"kind": "stuck", "at": SETTLED_S, "lasts": 1.0, "module": module}]}
    )
    comparison = Comparison(worn, plan, start_ns=0)
    upright = Orientations(np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), np.zeros((n, 3)))
    turned = Orientations(upright.q_wb.copy(), upright.angular_rate)
    turned.q_wb[segment] = [0.0, 1.0, 0.0, 0.0]
    status = np.full(n, Status.MEASURED, dtype=np.uint8)
    for k in range(1, 101):
        comparison.take(round((SETTLED_S + 0.01 * k) * 1e9), status, turned, upright)
    first = comparison.summary()[0]
    assert first["p100_deg"] == pytest.approx(0.01)  # the upper end of the first bin
    assert first["count"] == 99 * (sensed - 1)
    status[:] = Status.INTERPOLATED
    comparison.take(round((SETTLED_S + 1.01) * 1e9), status, turned, upright)
    status[:] = Status.MEASURED
    comparison.take(round((SETTLED_S + 1.02) * 1e9), status, turned, upright, 2.0 * LATEST_S)
    assert sum(row["count"] for row in comparison.summary()) == first["count"]
