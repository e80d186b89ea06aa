"""Ideal sensors against closed forms, imperfect ones against their statistics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.imperfections import (
    IDEAL,
    PRESETS,
    ROUGH,
    TYPICAL,
    Imperfections,
    draw_clock,
    draw_errors,
    module_random,
)
from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.motions import pendulum_motion, walking_motion
from devices.emulators.sensing.ideal_sensors import GRAVITY, MAGNETIC_FIELD, measure_point, sense
from devices.emulators.sensing.inertial_sampler import ImperfectSensors

IDENTITY = np.eye(3)[None]


def spinning_disc(t, rate, growth):
    """A disc about the vertical, angle rate t + growth t²/2, its centre at rest at the origin."""
    turned = np.outer(rate * t + growth * t**2 / 2, [0.0, 0.0, 1.0])
    R = Rotation.from_rotvec(turned).as_matrix()[:, None]
    zeros = np.zeros((len(t), 1, 3))
    omega, alpha = zeros.copy(), zeros.copy()
    omega[..., 2] = (rate + growth * t)[:, None]
    alpha[..., 2] = growth
    return MotionState(R, omega, alpha, zeros, zeros, zeros)


def test_a_point_on_a_spinning_disc():
    t, radius = np.linspace(0, 2, 50), 0.3
    state = spinning_disc(t, 4.0, 1.5)
    values = sense(state, np.array([[radius, 0, 0]]), IDENTITY)
    omega = 4.0 + 1.5 * t
    # Centripetal inwards (−x), tangential along y, the support against gravity along z.
    expected = np.stack([-radius * omega**2, np.full(50, radius * 1.5), np.full(50, 9.80665)], axis=1)
    np.testing.assert_allclose(values.specific_force[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(values.angular_rate[:, 0, 2], omega)


def test_the_field_turns_against_the_disc():
    t = np.linspace(0, 2, 50)
    values = sense(
        spinning_disc(t, 4.0, 0.0), np.zeros((1, 3)), IDENTITY, magnetic_field=np.array([0, 20.0, -40])
    )
    expected = np.stack([20 * np.sin(4 * t), 20 * np.cos(4 * t), np.full(50, -40.0)], axis=1)
    np.testing.assert_allclose(values.magnetic_field[:, 0], expected, atol=1e-12)


def test_a_pendulum_at_rest_reads_gravity_upwards(pendulum3):
    state = pendulum_motion(pendulum3, 1).state([0.5])
    values = sense(state, pendulum3.module_positions, np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_allclose(values.specific_force[0], np.tile([9.80665, 0, 0], (3, 1)), atol=1e-12)


def test_sensor_axes_are_turned_into_the_segment_by_sensor_to_segment(human17):
    state = walking_motion(human17, 1).state([5.0, 6.0])
    in_segment = sense(state, human17.module_positions, np.tile(np.eye(3), (17, 1, 1)))
    q_bs = Rotation.from_quat(human17.sensor_to_segment, scalar_first=True)
    in_sensor = sense(state, human17.module_positions, q_bs.as_matrix())
    for name in ("specific_force", "angular_rate", "magnetic_field"):
        turned = [q_bs.apply(row) for row in getattr(in_sensor, name)]
        np.testing.assert_allclose(turned, getattr(in_segment, name), atol=1e-10)


def test_the_accelerometer_is_the_second_derivative_of_its_place(human17):
    motion, h, t = walking_motion(human17, 4), 1e-4, 6.3
    before, now, after = (
        measure_point(motion.state([x]), human17.module_positions, 3)[0] for x in (t - h, t, t + h)
    )
    b_w = (after - 2 * now + before) / h**2
    state = motion.state([t])
    expected = np.einsum("sji,sj->si", state.R_wb[0], b_w - GRAVITY)
    values = sense(state, human17.module_positions, np.tile(np.eye(3), (17, 1, 1)))
    np.testing.assert_allclose(values.specific_force[0], expected, atol=1e-4)


def test_local_devices_measure_derivatives_of_one_another(human17):
    motion, h, t = walking_motion(human17, 4), 1e-5, 6.3
    points = np.full((17, 3), 0.1)
    for lower, higher in ((3, 2), (2, 1)):
        before, after = (measure_point(motion.state([x]), points, lower) for x in (t - h, t + h))
        measured = measure_point(motion.state([t]), points, higher)
        np.testing.assert_allclose((after - before) / (2 * h), measured, atol=1e-5)
    with pytest.raises(ValueError, match="quantity 7"):
        measure_point(motion.state([t]), points, 7)


def readings(settings, n, rate_hz=100.0, seed=1, blocks=1):
    sensors = ImperfectSensors(settings, draw_errors(settings, module_random(seed, 3, 0)), seed, 3)
    truth = (
        np.tile([0.0, 0.0, 9.8], (n // blocks, 1)),
        np.zeros((n // blocks, 3)),
        np.full((n // blocks, 3), 20.0),
    )
    parts = [sensors.read(*truth, rate_hz) for _ in range(blocks)]
    return {name: np.vstack([part[name] for part in parts]) for name in parts[0]}


def test_white_noise_has_the_asked_rms_and_is_white():
    settings = Imperfections(accelerometer_noise=0.03, gyroscope_noise=0.002, magnetometer_noise=0.5)
    read = readings(settings, 20_000)
    for name, sigma in (("specific_force", 0.03), ("angular_rate", 0.002), ("magnetic_field", 0.5)):
        np.testing.assert_allclose(read[name].std(axis=0), sigma, rtol=0.03)
        noise = read[name] - read[name].mean(axis=0)
        assert np.abs((noise[1:] * noise[:-1]).mean(axis=0)).max() < 0.04 * sigma**2
    np.testing.assert_allclose(read["specific_force"].mean(axis=0), [0, 0, 9.8], atol=1e-3)


def test_noise_goes_with_the_root_of_the_rate():
    read = readings(Imperfections(gyroscope_noise=0.002), 20_000, rate_hz=400.0)
    np.testing.assert_allclose(read["angular_rate"].std(axis=0), 0.004, rtol=0.03)


def test_bias_and_scale_and_misalignment_are_drawn_with_the_asked_spread():
    settings = Imperfections(gyroscope_bias=0.01, scale=0.02, misalignment=0.03, placement=0.01)
    drawn = [draw_errors(settings, module_random(5, module, 0)) for module in range(400)]
    assert np.std([e.gyroscope_bias for e in drawn]) == pytest.approx(0.01, rel=0.1)
    assert np.std([e.placement for e in drawn]) == pytest.approx(0.01, rel=0.1)
    distortion = np.array([e.accelerometer_distortion for e in drawn])
    assert np.std(distortion[:, range(3), range(3)]) == pytest.approx(0.02, rel=0.1)
    off_diagonal = (distortion[:, 2, 1] - distortion[:, 1, 2]) / 2
    assert np.std(off_diagonal) == pytest.approx(0.03, rel=0.1)


def test_the_bias_walks():
    settings = Imperfections(gyroscope_bias_walk=0.001)
    ends = [readings(settings, 2500, seed=seed)["angular_rate"][-1] for seed in range(60)]
    assert np.std(ends) == pytest.approx(0.001 * np.sqrt(25.0), rel=0.2)  # 25 s


def test_noise_does_not_depend_on_how_it_is_cut():
    whole, cut = (readings(TYPICAL, 600, blocks=blocks) for blocks in (1, 30))
    for name, values in whole.items():
        np.testing.assert_allclose(cut[name], values, rtol=1e-12, atol=1e-14)


def test_ideal_sensors_tell_the_truth():
    read = readings(IDEAL, 10)
    assert (read["specific_force"] == [0, 0, 9.8]).all()
    assert not read["angular_rate"].any()


def test_clocks_are_drawn_within_their_limits():
    clocks = [draw_clock(TYPICAL, module_random(1, module, 1), 0.01) for module in range(200)]
    skews = 1e6 * np.array([clock.skew for clock in clocks])
    assert 40 < np.abs(skews).max() <= 50
    assert 0 <= min(c.phase_s for c in clocks) < max(c.phase_s for c in clocks) < 0.01
    assert len({clock.start_us for clock in clocks}) == 200
    assert draw_clock(IDEAL, module_random(1, 1, 1), 0.01).count_us(1.5) == 1_500_000


def test_presets_grow_worse():
    assert list(PRESETS) == ["ideal", "typical", "rough", "uncalibrated"]
    for name in ("gyroscope_noise", "accelerometer_bias", "clock_skew_ppm", "loss", "jitter"):
        assert 0 == getattr(IDEAL, name) < getattr(TYPICAL, name) < getattr(ROUGH, name)


def test_the_default_field_dips_below_north():
    assert MAGNETIC_FIELD[0] == 0
    assert MAGNETIC_FIELD[1] > 0 > MAGNETIC_FIELD[2]
