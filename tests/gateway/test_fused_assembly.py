"""Orientations fused on board, at the reference module's instants: against closed form."""

import numpy as np
import pytest

from gateway.frames import FusedReading, Status
from gateway.stages.frame_assembler import AssemblyParams, Lost
from gateway.stages.fused_assembler import FusedAssembler

MS = 1_000_000
PARAMS = AssemblyParams(frame_interval_ns=10 * MS, max_wait_ns=30 * MS, max_gap_ns=50 * MS, hold_ns=200 * MS)
SHIFT = {1: 0, 2: 3 * MS, 3: 7 * MS}
RATE = 2.0  # rad/s, about z


def orientation(time_ns):
    angle = RATE * time_ns * 1e-9
    return (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))


def run(assembler, n, is_sent=lambda module, k: True, start=0):
    """Frames of n readings of every module, 10 ms apart, each arriving 2 ms after its instant."""
    frames = []
    for k in range(start, start + n):
        for module, shift in SHIFT.items():
            if is_sent(module, k):
                at = 10 * k * MS + shift
                frames += assembler.add(FusedReading(module, k, at, orientation(at)), at + 2 * MS)
    return frames


def assert_on_the_motion(frame, rows):
    for row in rows:
        expected = orientation(frame.time_ns)
        assert abs(np.dot(frame.orientation[row], expected)) == pytest.approx(1.0, abs=1e-12)


def test_frames_lie_at_the_reference_modules_instants():
    frames = run(FusedAssembler((1, 2, 3), PARAMS, 1), 50)
    assert [frame.time_ns for frame in frames] == [10 * k * MS for k in range(len(frames))]
    assert len(frames) >= 48
    assert frames[0].status.tolist() == [Status.MEASURED, Status.MISSING, Status.MISSING]
    for frame in frames[1:]:
        assert frame.status.tolist() == [Status.MEASURED] * 3
        assert frame.gap_ns.tolist() == [0, 10 * MS, 10 * MS]
        assert_on_the_motion(frame, range(3))
    assert [frame.sequence for frame in frames] == list(range(len(frames)))


def test_a_short_gap_is_bridged_and_a_long_one_held_then_missing():
    def is_sent(module, k):
        return module != 2 or not (10 <= k < 12 or k >= 30)

    frames = run(FusedAssembler((1, 2, 3), PARAMS, 1), 80, is_sent)
    by_time = {frame.time_ns // (10 * MS): frame for frame in frames}
    assert by_time[11].status[1] == Status.INTERPOLATED
    assert by_time[11].gap_ns[1] == 30 * MS
    assert_on_the_motion(by_time[11], [1])
    assert by_time[40].status[1] == Status.HELD
    np.testing.assert_array_equal(by_time[40].orientation[1], by_time[29].orientation[1])
    assert by_time[60].status[1] == Status.MISSING
    assert np.isnan(by_time[60].orientation[1]).all()
    assert len(frames) >= 78  # nobody waits for the silent one for ever


def test_a_gap_too_long_to_bridge_is_held():
    frames = run(FusedAssembler((1, 2, 3), PARAMS, 1), 40, lambda module, k: module != 2 or not 10 <= k < 20)
    by_time = {frame.time_ns // (10 * MS): frame for frame in frames}
    assert by_time[14].status[1] == Status.HELD
    assert by_time[25].status[1] == Status.MEASURED


def test_another_module_takes_the_place_of_a_silent_reference():
    assembler = FusedAssembler((1, 2, 3), PARAMS, 1)
    frames = run(assembler, 100, lambda module, k: module != 1 or not 20 <= k < 60)
    times = [frame.time_ns for frame in frames]
    assert times == sorted(set(times))
    assert assembler.reference != 1
    assert max(np.diff(times)) < PARAMS.hold_ns + 30 * MS
    assert frames[-1].status.tolist() == [Status.MEASURED] * 3
    for frame in frames[-20:]:
        assert_on_the_motion(frame, range(3))


def test_a_reference_that_never_comes_is_replaced():
    frames = run(FusedAssembler((1, 2, 3), PARAMS, 1), 150, lambda module, k: module != 1)
    assert len(frames) > 30
    assert frames[-1].status[1] == frames[-1].status[2] == Status.MEASURED
    assert frames[-1].status[0] == Status.MISSING


def test_every_reading_is_counted_as_taken_or_as_no_use():
    assembler = FusedAssembler((1, 2, 3), PARAMS, 1)
    assert assembler.taken == 0
    run(assembler, 5)
    assert assembler.taken == 3 * 5
    assert assembler.add(FusedReading(9, 0, 0, orientation(0)), 0) == []
    assert assembler.add(FusedReading(2, 1, 13 * MS, orientation(0)), 60 * MS) == []
    assert assembler.lost == {Lost.UNKNOWN_MODULE: 1, Lost.LATE: 1}
    assert assembler.taken == 3 * 5


def test_after_a_pause_of_all_the_reference_stays_and_late_frames_hold_all_that_came_with_it():
    """As when an app, or its machine, pauses: one datagram with all of them, the reference last."""
    assembler = FusedAssembler((1, 2, 3), PARAMS, 1)
    frames, late = [], 2 * PARAMS.max_wait_ns
    for k in (*range(20), *range(20 + PARAMS.hold_ns // (10 * MS), 100)):
        at = 10 * k * MS
        for module in (3, 2, 1):
            frames += assembler.add(FusedReading(module, k, at, orientation(at)), at + late)
    assert assembler.reference == 1
    assert {tuple(frame.status.tolist()) for frame in frames} == {(Status.MEASURED,) * 3}
