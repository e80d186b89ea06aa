"""Frame assembly: interpolation against closed form, status, waiting, gaps, determinism."""

import numpy as np
import pytest

from gateway.frames import NOT_READ, Clipped, InertialBatch, LocalReading, Quantity, Status
from gateway.stages.frame_assembler import AssemblyParams, FrameAssembler, Lost

MS = 1_000_000
PARAMS = AssemblyParams(frame_interval_ns=10 * MS, max_wait_ns=20 * MS, max_gap_ns=50 * MS, hold_ns=200 * MS)


def reading(module, sequence, time_ns, value=None, magnetic_field=(1.0, 2.0, 3.0)):
    x = time_ns / 1e9 if value is None else value
    measured = (x, 2 * x, -x), (3 * x, 0.0, x), magnetic_field or NOT_READ
    return InertialBatch.of([(module, sequence, time_ns, measured, 0)]).samples


def run(readings, ids=(0, 1), params=PARAMS, delay_ns=MS):
    assembler = FrameAssembler(ids, params)
    frames = []
    for item in readings:
        frames += assembler.add(item, int(item["time_ns"][0]) + delay_ns)
    return frames, assembler


def test_values_between_samples_are_interpolated_linearly_and_count_as_measured():
    readings = []
    for k in range(50):
        readings.append(reading(0, k, 10 * MS * k))
        readings.append(reading(1, k, 10 * MS * k + 3 * MS))  # sampled 3 ms later
    frames, _ = run(readings)
    assert len(frames) > 40
    for frame in frames:
        expected = frame.time_ns / 1e9
        np.testing.assert_allclose(frame.specific_force[:, 0], expected, atol=1e-12)
        np.testing.assert_allclose(frame.angular_rate[:, 0], 3 * expected, atol=1e-12)
        assert set(frame.status) == {Status.MEASURED}
    assert np.all(np.diff([frame.time_ns for frame in frames]) == 10 * MS)
    assert [frame.sequence for frame in frames] == list(range(len(frames)))


def test_what_rests_on_a_clipped_reading_is_marked_so():
    readings = []
    for k in range(50):
        early = reading(0, k, 10 * MS * k)
        early["clipped"] = int(Clipped.ANGULAR_RATE) if k == 20 else 0
        readings.append(early)
        readings.append(reading(1, k, 10 * MS * k + 3 * MS))
    frames, _ = run(readings)
    marked = {frame.time_ns // MS: frame.clipped.tolist() for frame in frames if frame.clipped is not None}
    assert marked == {193: [Clipped.ANGULAR_RATE, 0], 203: [Clipped.ANGULAR_RATE, 0]}


def test_a_lost_sample_is_bridged_and_marked_with_its_gap():
    readings = [reading(m, k, 10 * MS * k) for k in range(30) for m in (0, 1) if (m, k) != (1, 15)]
    frames, _ = run(readings)
    at_loss = next(f for f in frames if f.time_ns == 150 * MS)
    assert at_loss.status.tolist() == [Status.MEASURED, Status.INTERPOLATED]
    assert at_loss.gap_ns[1] == 20 * MS
    assert at_loss.specific_force[1, 0] == pytest.approx(0.15)
    others = [f.status.tolist() for f in frames if f is not at_loss]
    assert others == [[Status.MEASURED] * 2] * len(others)


def test_a_silent_module_is_held_then_missing_and_the_others_go_on():
    readings = [reading(m, k, 10 * MS * k) for k in range(100) for m in (0, 1) if m == 0 or k < 20]
    frames, _ = run(readings)
    status = {f.time_ns // MS: f.status[1] for f in frames}
    assert status[190] == Status.MEASURED
    assert status[200] == status[380] == Status.HELD
    assert status[400] == Status.MISSING
    after = next(f for f in frames if f.time_ns == 500 * MS)
    assert np.isnan(after.specific_force[1]).all()
    assert after.status[0] == Status.MEASURED


def test_frames_wait_no_longer_than_the_latency_budget():
    assembler = FrameAssembler((0, 1), PARAMS)
    emitted = {}
    for k in range(60):
        time_ns = 10 * MS * k
        for module in (0, 1):
            if module == 1 and k >= 30:
                continue  # gone
            for frame in assembler.add(reading(module, k, time_ns), time_ns + MS):
                emitted[frame.time_ns] = time_ns + MS
    waits_ms = [(arrived - instant) / MS for instant, arrived in emitted.items()]
    assert max(waits_ms) <= 30  # the budget, and the arrival that shows it has passed
    assert len(emitted) >= 57


def test_after_silence_of_all_the_grid_goes_on_at_the_present():
    readings = [reading(m, k, 10 * MS * k) for k in range(20) for m in (0, 1)]
    readings += [reading(m, 520 + k, 5200 * MS + 10 * MS * k) for k in range(20) for m in (0, 1)]
    frames, assembler = run(readings)
    assert assembler.lost[Lost.SKIPPED_INSTANT] > 400
    later = [f for f in frames if f.time_ns >= 5200 * MS]
    assert len(later) >= 19
    assert all(f.time_ns % (10 * MS) == 0 for f in later)
    assert len(frames) < 60


def test_late_duplicate_and_unknown_readings_are_counted():
    assembler = FrameAssembler((0,), PARAMS)
    for k in range(10):
        assembler.add(reading(0, k, 10 * MS * k), 10 * MS * k)
    assembler.add(reading(0, 3, 33 * MS), 100 * MS)
    assembler.add(reading(0, 9, 90 * MS), 100 * MS)
    assembler.add(reading(7, 0, 90 * MS), 100 * MS)
    assert assembler.lost == {Lost.LATE: 1, Lost.DUPLICATE: 1, Lost.UNKNOWN_MODULE: 1}


def test_a_reading_overtaken_on_its_way_is_put_in_its_place():
    in_order = [reading(m, k, 10 * MS * k) for k in range(20) for m in (0, 1)]
    swapped = [samples for samples in in_order if samples["sequence"][0] not in {10, 11}]
    at = next(k for k, samples in enumerate(swapped) if samples["sequence"][0] == 12)
    swapped[at:at] = [in_order[23], in_order[21], in_order[20], in_order[22]]  # 1: 11, 10; then 0: 10, 11
    frames, assembler = run(swapped)
    assert not assembler.lost
    assert all(frame.status.tolist() == [Status.MEASURED] * 2 for frame in frames)
    assert len(frames) == 20


def test_a_slow_magnetometer_is_interpolated_by_itself():
    readings = [
        reading(0, k, 10 * MS * k, magnetic_field=(float(k), 0.0, 0.0) if k % 4 == 0 else None)
        for k in range(60)
    ]
    frames, _ = run(readings, ids=(0,))
    inner = [f for f in frames if 100 * MS <= f.time_ns <= 400 * MS]
    measured = np.array([f.magnetic_field[0, 0] for f in inner if f.time_ns % (40 * MS) == 0])
    np.testing.assert_allclose(measured, [f.time_ns / (10 * MS) for f in inner if f.time_ns % (40 * MS) == 0])
    assert all(f.status[0] == Status.MEASURED for f in inner)


def test_local_readings_ride_with_the_frame_at_or_after_them():
    assembler = FrameAssembler((0,), PARAMS)
    zero = np.zeros(3)
    frames = []
    for k in range(20):
        if k % 3 == 0:
            assembler.add_local(LocalReading(40, 10 * MS * k - 2 * MS, Quantity.POSITION, zero, zero))
        frames += assembler.add(reading(0, k, 10 * MS * k), 10 * MS * k)
    assert [len(f.local) for f in frames] == [1 if k % 3 == 0 else 0 for k in range(20)]


def test_start_waits_for_all_modules_but_not_for_ever():
    assembler = FrameAssembler((0, 1), PARAMS)
    frames = [f for k in range(200) for f in assembler.add(reading(0, k, 10 * MS * k), 10 * MS * k)]
    assert frames[0].time_ns == 1000 * MS
    assert frames[0].status.tolist() == [Status.MEASURED, Status.MISSING]


def test_a_burst_that_comes_late_as_a_whole_is_read_to_its_end():
    """After a stall of 300 ms, module by module: no sample is given up for one read a moment before."""
    assembler, frames = FrameAssembler((0, 1), PARAMS), []
    for k in range(100):
        time_ns = 10 * MS * k
        stalled = 300 * MS < time_ns <= 600 * MS
        for module in (0, 1):
            arrived_ns = (600 * MS if stalled else time_ns) + (module + 1) * MS
            frames += assembler.add(reading(module, k, time_ns), arrived_ns)
    assert {status for frame in frames for status in frame.status} == {Status.MEASURED}
    assert len(frames) == 100
    assert not assembler.lost


def test_in_a_late_burst_a_dead_module_holds_up_the_others_for_milliseconds_only():
    assembler, frames = FrameAssembler((0, 1), PARAMS), {}
    for k in range(100):
        time_ns = 10 * MS * k
        arrived_ns = max(time_ns, 600 * MS if time_ns > 300 * MS else 0) + MS
        for module in (0, 1) if time_ns <= 200 * MS else (0,):
            for frame in assembler.add(reading(module, k, time_ns), arrived_ns):
                frames[frame.time_ns] = arrived_ns
    assert frames[700 * MS] <= 740 * MS
    assert len(frames) >= 95


def test_a_reading_older_than_all_that_are_remembered_is_late_and_takes_no_place():
    """Modules at 1000 Hz, frames at 5 Hz: more samples lie between two instants than are remembered."""
    params = AssemblyParams(200 * MS, 20 * MS, 50 * MS, 400 * MS)
    in_order = [reading(0, k, MS * k) for k in range(390)]
    frames, assembler = run(
        [*in_order, reading(0, 205, 205 * MS + 1), reading(0, 390, 399 * MS)], (0,), params
    )
    assert [frame.time_ns for frame in frames] == [0, 200 * MS]
    assert assembler.lost == {Lost.LATE: 1}
    assert assembler.taken == 391
    (frame,) = assembler.add(reading(0, 391, 401 * MS), 402 * MS)
    assert frame.gap_ns.tolist() == [2 * MS]
    assert frame.specific_force[0, 0] == pytest.approx(0.4)
