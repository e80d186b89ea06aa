"""Without gyroscopes: one body whose position is measured, loss of that, a resting body beside a magnet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.motions import generic_motion
from devices.emulators.sensing.ideal_sensors import measure_point
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress
from gateway.emulation.simulation import PLACEMENTS, arm, errors_deg, ideal_frames
from gateway.frames import ImuFrame, LocalReading, Quantity, Status
from gateway.reconstruction import create_reconstructor

RATE_HZ, SECONDS = 100.0, 12.0


@pytest.fixture(scope="module")
def moving_body():
    """The shipped single module, 3 rad/s and 20 rad/s² at the peaks, consumer noise, no gyroscopes."""
    suit = load_rig("single_placed")
    motion = generic_motion(
        dress(suit), 3, peak_angular_rate=3.0, peak_angular_acceleration=20.0, root_travel_m=1.0
    )
    times_ns = np.arange(round(SECONDS * RATE_HZ)) * round(1e9 / RATE_HZ)
    rng = np.random.default_rng(4)
    frames = []
    for frame in ideal_frames(suit, dress(suit), motion, times_ns, has_gyroscopes=False):
        place = measure_point(motion.state(frame.time_ns * 1e-9), np.zeros((1, 3)), int(Quantity.POSITION))[
            0, 0
        ]
        noisy = place + 0.001 * rng.standard_normal(3)
        reading = LocalReading(60, frame.time_ns, Quantity.POSITION, noisy, np.full(3, 0.001))
        frames.append(
            replace(
                frame,
                specific_force=frame.specific_force + 0.03 * rng.standard_normal((1, 3)),
                magnetic_field=frame.magnetic_field + 0.5 * rng.standard_normal((1, 3)),
                local=(reading,),
            )
        )
    return suit, motion, frames


def solve(suit, frames, delay_s=0.0):
    reconstructor = create_reconstructor("gyro_free", suit, 1.0 / RATE_HZ, delay_s=delay_s)
    return [reconstructor.update(frame) for frame in frames]


def test_the_orientation_is_found_and_better_half_a_second_later(moving_body):
    suit, motion, frames = moving_body
    causal = errors_deg(solve(suit, frames), motion, 3.0)[0]
    delayed = errors_deg(solve(suit, frames, delay_s=0.5), motion, 3.0)[0]
    print(f"causal {causal:.2f}°, delayed {delayed:.2f}°")
    assert causal < 8.0
    assert delayed < 0.65 * causal


def test_a_late_magnetometer_costs_little_once_its_lag_is_known(moving_body):
    suit, motion, frames = moving_body
    late = [replace(f, magnetic_field=g.magnetic_field) for f, g in zip(frames[2:], frames, strict=False)]
    in_time, behind = (errors_deg(solve(suit, some), motion, 6.0)[0] for some in (frames, late))
    print(f"in time {in_time:.2f}°, field 20 ms late {behind:.2f}°")
    assert behind < in_time + 1.0


def test_the_delayed_frames_are_of_the_instant_they_claim(moving_body):
    suit, _, frames = moving_body
    given = solve(suit, frames[:80], delay_s=0.5)
    assert [f.time_ns for f in given] == [f.time_ns - 500_000_000 for f in frames[:80]]
    sooner = solve(suit, frames[:20], delay_s=0.1)
    assert [f.time_ns for f in sooner] == [f.time_ns - 100_000_000 for f in frames[:20]]
    assert {int(f.status[0]) for f in given[:50]} == {Status.WARMING_UP}
    assert given[60].status[0] == Status.MEASURED


def test_without_the_position_it_falls_back_and_recovers(moving_body):
    suit, motion, frames = moving_body
    lost = [replace(f, local=()) if 4.0 < f.time_ns * 1e-9 < 8.0 else f for f in frames]
    given = solve(suit, lost)
    assert all(np.isfinite(f.q_wb).all() for f in given)
    assert errors_deg(given, motion, 9.5)[0] < 8.0


def test_a_silent_module_is_predicted_then_missing_and_begins_anew(moving_body):
    suit, motion, frames = moving_body
    gone = np.full((1, 3), np.nan)
    silent = [
        replace(f, specific_force=gone, magnetic_field=gone, status=np.full(1, Status.MISSING, np.uint8))
        if 4.0 < f.time_ns * 1e-9 < 6.0
        else f
        for f in frames
    ]
    given = solve(suit, silent)
    assert given[420].status[0] == Status.PREDICTED
    assert given[590].status[0] == Status.MISSING
    assert errors_deg(given, motion, 9.0)[0] < 8.0


def test_a_magnet_beside_a_resting_module_turns_nothing():
    suit = load_rig("single_placed")
    frames = []
    rng = np.random.default_rng(5)
    for k in range(1000):
        magnet = np.array([30.0, 0.0, 20.0]) * (400 < k < 800)
        field = suit.magnetic_field + magnet + 0.3 * rng.standard_normal(3)
        force = -suit.gravity + 0.03 * rng.standard_normal(3)
        row = np.zeros(1, np.int64)
        frames.append(still_frame(k, force, field, row))
    given = solve(suit, frames)
    angles = [2.0 * np.degrees(np.arccos(min(1.0, abs(f.q_wb[0, 0])))) for f in given[200:]]
    assert max(angles) < 5.0


def still_frame(k, force, field, row):
    none = np.full((1, 3), np.nan)
    still = (LocalReading(60, k * 10_000_000, Quantity.POSITION, np.zeros(3), np.full(3, 0.001)),)
    return ImuFrame(k, k * 10_000_000, force[None], none, field[None], row.astype(np.uint8), row, still)


def test_a_chain_off_the_joints_is_carried_from_its_fixed_point_outward():
    """Four links, modules 0.12 m up them, noise-free, 3 rad/s and 20 rad/s² at the peaks."""
    suit = arm(PLACEMENTS["0.12 m up the links"])
    motion = generic_motion(dress(suit), 1, peak_angular_rate=3.0, peak_angular_acceleration=20.0)
    times_ns = np.arange(900) * 10_000_000
    frames = list(ideal_frames(suit, dress(suit), motion, times_ns, has_gyroscopes=False))
    errors = errors_deg(solve(suit, frames, delay_s=0.5), motion, 3.0)
    print(f"delayed, by rank: {np.round(errors, 2)}°")
    assert errors[0] < 3.0
    assert errors.max() < 15.0
