"""The module-by-module baseline."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_body import FIELD, GRAVITY, angular_error_deg, arm, imu_frames, instants, simulate

from gateway.frames import Clipped, Status
from gateway.reconstruction.inertial.independent import IndependentReconstructor


def run(suit, observations, rate_hz=100):
    reconstructor = IndependentReconstructor(suit, 1.0 / rate_hz)
    return [reconstructor.update(f) for f in observations]


def resting(seconds=20.0, **changes):
    body = arm(on_joint=False, from_rest=True, **changes)
    truth = simulate(body, instants(100, seconds, start_s=-seconds))
    return body, truth, imu_frames(body, truth, gyroscopes=True)


def test_at_rest_it_agrees_with_the_geographic_world_whatever_the_mounting():
    body, truth, observations = resting()
    mounting = Rotation.random(4, rng=np.random.default_rng(6))
    suit = replace(body.suit(), sensor_to_segment=mounting.as_quat()[:, [3, 0, 1, 2]])
    turned = [
        replace(
            f,
            specific_force=mounting.inv().apply(f.specific_force),
            magnetic_field=mounting.inv().apply(f.magnetic_field),
        )
        for f in observations
    ]
    assert np.degrees(np.arctan2(FIELD[0], FIELD[1])) == pytest.approx(3.0)  # declination is at stake
    last = run(suit, turned)[-1]
    assert angular_error_deg(last.q_wb, truth.R[-1]).max() < 0.3
    assert (last.q_wb[:, 0] >= 0.0).all()


def test_follows_motion_and_yields_joint_accelerations():
    body = arm(on_joint=False, from_rest=True, tempo=0.4)
    truth = simulate(body, instants(200, 12.0, start_s=-8.0))
    frames = run(body.suit(), imu_frames(body, truth, gyroscopes=True), 200)
    errors = angular_error_deg(np.array([f.q_wb for f in frames]), truth.R)
    assert np.sqrt(np.mean(errors[-800:] ** 2)) < 3.0
    found = np.array([f.joint_acceleration for f in frames])[-800:]
    # an orientation that is off by 1° mistakes 0.17 m/s² of gravity for acceleration
    assert np.sqrt(np.mean((found - truth.joint_acceleration[-800:]) ** 2)) < 0.35
    assert np.abs(truth.joint_acceleration[-800:]).max() > 1.0
    np.testing.assert_allclose(frames[-1].p_w, truth.p_w[-1], atol=0.05)


def test_without_field_only_the_inclination_is_right():
    body, truth, observations = resting()
    nothing = np.full((4, 3), np.nan)
    last = run(body.suit(), [replace(f, magnetic_field=nothing) for f in observations])[-1]
    q = last.q_wb[:, [1, 2, 3, 0]]
    up = Rotation.from_quat(q).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(up, truth.R[-1].transpose(0, 2, 1) @ [0.0, 0.0, 1.0], atol=1e-3)


def test_silence_holds_the_last_orientation():
    body, _, observations = resting(2.0)
    observations[150].specific_force[1] = np.nan
    observations[160].angular_rate[2] = np.nan
    observations[0].specific_force[3] = np.nan
    frames = run(body.suit(), observations)
    assert frames[0].status[3] == Status.MISSING
    assert np.isnan(frames[0].q_wb[3]).all()
    for k, segment in ((150, 1), (160, 2)):
        assert frames[k].status[segment] == Status.HELD
        np.testing.assert_array_equal(frames[k].q_wb[segment], frames[k - 1].q_wb[segment])
        assert np.isnan(frames[k].joint_acceleration[segment]).all()
        assert frames[k + 1].status[segment] == Status.MEASURED


def test_a_segment_without_module_follows_its_parent():
    body, _, observations = resting(0.5, module_of_segment=(0, 1, -1, 2))
    last = run(body.suit(), observations)[-1]
    np.testing.assert_array_equal(
        last.status, [Status.MEASURED, Status.MEASURED, Status.PREDICTED, Status.MEASURED]
    )
    np.testing.assert_array_equal(last.q_wb[2], last.q_wb[1])
    assert np.isnan(last.joint_acceleration[2]).all()


def test_a_root_without_module_is_missing():
    body, _, observations = resting(0.5, module_of_segment=(-1, 0, 1, 2))
    last = run(body.suit(), observations)[-1]
    assert last.status[0] == Status.MISSING
    assert np.isnan(last.q_wb[0]).all()
    assert np.isfinite(last.q_wb[1:]).all()


def test_a_module_on_the_joint_needs_no_rate_derivative():
    body = arm(on_joint=True, from_rest=True)
    truth = simulate(body, instants(100, 0.1, start_s=-1.0))
    first = run(body.suit(), imu_frames(body, truth, gyroscopes=True)[:1])[0]
    assert np.isfinite(first.joint_acceleration).all()
    on_lever = arm(on_joint=False, from_rest=True)
    truth = simulate(on_lever, instants(100, 0.1, start_s=-1.0))
    first = run(on_lever.suit(), imu_frames(on_lever, truth, gyroscopes=True)[:1])[0]
    assert np.isnan(first.joint_acceleration).all()
    assert first.time_ns == -(10**9)
    assert GRAVITY[2] == -9.81


def test_the_same_frames_after_reset_give_the_same_bits():
    body = arm(on_joint=False)
    truth = simulate(body, instants(100, 1.0))
    observations = imu_frames(body, truth, gyroscopes=True)
    reconstructor = IndependentReconstructor(body.suit(), 0.01)
    once = [reconstructor.update(f) for f in observations]
    reconstructor.reset()
    again = [reconstructor.update(f) for f in observations]
    for a, b in zip(once, again, strict=True):
        assert a.q_wb.tobytes() == b.q_wb.tobytes()
        assert a.joint_acceleration.tobytes() == b.joint_acceleration.tobytes()


def swinging(seconds):
    """An arm at rest, and then in motion for so long; with the frames of a run without gaps."""
    body = arm(on_joint=False, from_rest=True)
    truth = simulate(body, instants(100, seconds, start_s=-1.0))
    observations = imu_frames(body, truth, gyroscopes=True)
    return body, observations, run(body.suit(), observations)


def off_deg(frames, steady, segment=1):
    """Of a segment, frame by frame, against the run without gaps."""
    q, q_steady = (np.array([frame.q_wb[segment] for frame in some]) for some in (frames, steady))
    return np.degrees(2.0 * np.arccos(np.minimum(1.0, np.abs(np.sum(q * q_steady, axis=1)))))


def test_a_module_silent_for_long_is_predicted_and_keeps_its_orientation():
    body, observations, _ = swinging(6.0)
    silent = range(300, 400)
    for k in silent:
        observations[k].specific_force[1] = np.nan
    frames = run(body.suit(), observations)
    status = [frames[k].status[1] for k in silent]
    assert status[:19] == [Status.HELD] * 19
    assert status[21:] == [Status.PREDICTED] * (len(silent) - 21)
    for k in silent:
        np.testing.assert_array_equal(frames[k].q_wb[1], frames[299].q_wb[1])
    assert frames[400].status[1] == Status.MEASURED


@pytest.mark.parametrize(
    ("n_missing", "bounds_deg"),
    [(5, (0.5, 0.3, 0.15)), (15, (3.0, 1.0, 0.5)), (30, (5.0, 2.0, 1.0)), (100, (6.0, 2.0, 1.0))],
)
@pytest.mark.parametrize("status", [Status.HELD, Status.MISSING])
def test_a_module_that_is_back_soon_has_its_orientation(n_missing, bounds_deg, status):
    """At 0.5, 3 and 10 s. It used to go on from where it was, or to begin anew from one sample."""
    body, observations, steady = swinging(22.0)
    gap = range(1100, 1100 + n_missing)
    last = observations[gap.start - 1]
    for k in gap:
        f, w = observations[k].specific_force.copy(), observations[k].angular_rate.copy()
        is_held = status == Status.HELD
        f[1], w[1] = (last.specific_force[1], last.angular_rate[1]) if is_held else (np.nan, np.nan)
        told = np.where(np.arange(4) == 1, status, observations[k].status).astype(np.uint8)
        observations[k] = replace(observations[k], specific_force=f, angular_rate=w, status=told)
    errors = off_deg(run(body.suit(), observations), steady)
    assert errors[: gap.start].max() < 1e-4
    for after_s, bound in zip((0.5, 3.0, 10.0), bounds_deg, strict=True):
        assert errors[gap.stop + round(100 * after_s)] < bound, after_s


def test_the_heading_is_kept_over_a_gap_where_there_is_no_field():
    """It used to be lost: the filter began anew."""
    body, observations, _ = swinging(8.0)
    nothing = np.full((4, 3), np.nan)
    observations = [replace(f, magnetic_field=nothing) for f in observations]
    steady = run(body.suit(), observations)
    for k in range(300, 330):
        observations[k].specific_force[1] = np.nan
    assert off_deg(run(body.suit(), observations), steady)[600:].max() < 15.0


def test_gyroscopes_saturated_for_long_are_not_believed():
    """They used to be, bias and all: 20° off half a minute after a second of it."""
    body, observations, steady = swinging(14.0)
    for observation in observations[300:400]:
        observation.angular_rate[1] = np.radians(2000.0) * np.array([1.0, -1.0, 1.0])
    frames = run(body.suit(), observations)
    assert frames[310].status[1] == Status.MEASURED  # a fast swing of 0.1 s is not thrown away
    assert {frames[k].status[1] for k in range(321, 400)} == {Status.PREDICTED}
    errors = off_deg(frames, steady)
    assert errors[305] > 90.0  # what they say meanwhile
    assert errors[700] < 4.0
    assert errors[1300] < 2.0


def test_gyroscopes_that_say_that_they_are_clipped_are_believed():
    """Whatever their range is."""
    body = arm(on_joint=False, from_rest=True)
    truth = simulate(body, instants(100, 4.0, start_s=-1.0))
    observations = imu_frames(body, truth, gyroscopes=True)
    clipped = np.array([0, Clipped.ANGULAR_RATE, 0, 0], np.uint8)
    frames = run(
        body.suit(), [*observations[:300], *(replace(f, clipped=clipped) for f in observations[300:])]
    )
    assert [frame.status[1] for frame in frames[330:]] == [Status.PREDICTED] * (len(frames) - 330)
    assert {frame.status[2] for frame in frames} == {Status.MEASURED}


@pytest.mark.parametrize("says_so", [False, True])
def test_a_saturated_accelerometer_tells_no_inclination(says_so):
    body, truth, observations = resting(20.0)
    end = 100.0 if says_so else 160.0
    clipped = np.array([0, Clipped.SPECIFIC_FORCE, 0, 0], np.uint8) if says_so else None
    for k, observation in enumerate(observations[1000:], start=1000):
        observation.specific_force[1] = [end, end, end]
        observations[k] = replace(observation, clipped=clipped)
    frames = run(body.suit(), observations)
    assert {frame.status[1] for frame in frames[1000:]} == {Status.UNAIDED}
    assert {frame.status[1] for frame in frames[:1000]} == {Status.MEASURED}
    assert angular_error_deg(frames[-1].q_wb, truth.R[-1]).max() < 0.3
    assert np.isnan(frames[-1].joint_acceleration[1]).all()
