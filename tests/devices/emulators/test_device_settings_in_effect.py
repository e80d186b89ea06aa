"""Committed settings, as they show in what a module sends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.imperfections import Imperfections
from devices.emulators.motion.motions import walking_motion
from devices.emulators.suit_traffic import SuitTraffic
from firmware_protocol import (
    BROADCAST,
    DeviceInfo,
    FusedSample,
    InertialSample,
    LocalMeasurement,
    SamplingTrigger,
)
from firmware_protocol.commands import Result, Verb
from firmware_protocol.device_settings import factory_settings

FUSED, RAW, TRIGGERED = 1, 2, 3


def set_up(host, module, **settings):
    for name, value in settings.items():
        assert host.write(name, value, module=module).result == Result.DONE
    assert host.ask(Verb.COMMIT, module=module).result == Result.DONE


def times_us(samples):
    return np.array([s.module_time_us for s in samples])


def test_a_new_id_holds_from_the_commit_on(arm_host):
    host = arm_host()
    set_up(host, 2, module_id=20)
    host.listen(5.0)
    assert host.traffic.device(2).module_id == 20
    assert host.traffic.senders[2].module == 20
    old, new = host.of(InertialSample, 2), host.of(InertialSample, 20)
    assert times_us(new)[0] - times_us(old)[-1] == 10_000
    assert new[0].sequence == old[-1].sequence + 1
    assert [p.packet.unique_id for p in host.of(DeviceInfo, 20)] == [host.traffic.device(2).unique_id]


def test_a_new_rate_holds_from_the_commit_on(arm_host):
    host = arm_host()
    set_up(host, 1, sampling_rate=250.0)
    begins = len(host.of(InertialSample, 1))
    host.listen(2.0)
    samples = host.of(InertialSample, 1)
    assert set(np.diff(times_us(samples[begins:]))) == {4000}
    assert [s.sequence for s in samples] == list(range(len(samples)))
    assert len(host.of(InertialSample, 0)) == pytest.approx(100 * host.now_s, abs=2)
    info = host.traffic.device(1).introduction()[0]
    assert info.gyroscope_sampling_rate == pytest.approx(250.0)


def test_the_motion_is_true_before_and_after_a_change_of_rate(arm_host):
    host = arm_host(is_fine=False)
    set_up(host, 3, sampling_rate=170.0)
    host.listen(1.0)
    undisturbed = arm_host(module_rates_hz={3: 1000.0})
    undisturbed.listen(host.now_s)
    truth = undisturbed.of(InertialSample, 3)
    for axis in range(3):
        expected = np.interp(
            times_us(host.of(InertialSample, 3)),
            times_us(truth),
            [s.packet.angular_rate[axis] for s in truth],
        )
        measured = [s.packet.angular_rate[axis] for s in host.of(InertialSample, 3)]
        np.testing.assert_allclose(measured, expected, atol=0.003)


def test_readings_end_at_the_range_and_are_marked(arm_host):
    host = arm_host()
    host.listen(3.0)
    before = host.of(InertialSample, 3)
    largest = np.radians(40.0)
    set_up(host, 3, gyroscope_range=largest, accelerometer_range=10.0)
    begins = len(host.of(InertialSample, 3))
    host.listen(5.0)
    after = host.of(InertialSample, 3)[begins:]
    rates = np.abs([s.packet.angular_rate for s in after])
    assert np.abs([s.packet.angular_rate for s in before]).max() > largest
    assert rates.max() == pytest.approx(largest, abs=1.1e-3)  # a step on the wire
    is_marked = np.array([s.packet.angular_rate_clipped for s in after])
    assert 0 < is_marked.sum() < len(after)
    np.testing.assert_array_equal(is_marked, rates.max(axis=1) == rates.max())
    assert np.abs([s.packet.specific_force for s in after]).max() == pytest.approx(10.0, abs=0.005)
    assert not any(s.packet.angular_rate_clipped for s in before)


@pytest.mark.parametrize("has_random_heading", [False, True])
def test_fused_on_board(arm_host, arm4, has_random_heading):
    host = arm_host(Imperfections(has_random_heading=has_random_heading), seed=5)
    set_up(host, 3, mode=FUSED)
    host.listen(3.0)
    samples = host.of(FusedSample, 3)
    times = times_us(samples) * 1e-6
    assert len(samples) == pytest.approx(300, abs=20)
    assert not [s for s in host.of(InertialSample, 3) if s.module_time_us > 1e6 * times[0]]
    state = host.traffic.motion.state(times)
    q_bs = Rotation.from_quat(arm4.sensor_to_segment[3], scalar_first=True)
    R_ws = Rotation.from_quat(state.q_wb[:, 3], scalar_first=True) * q_bs
    R_es = Rotation.from_quat([s.packet.orientation for s in samples], scalar_first=True)
    R_we = R_ws * R_es.inv()
    headings = R_we.as_rotvec()
    np.testing.assert_allclose(headings[:, :2], 0.0, atol=2e-4)
    np.testing.assert_allclose(headings[:, 2], headings[0, 2], atol=2e-4)
    assert (abs(headings[0, 2]) > 0.05) == has_random_heading
    place = state.joint_position[:, 3] + state.R_wb[:, 3] @ arm4.module_positions[3]
    assert samples[0].packet.interval == 0.0
    assert samples[0].packet.displacement == (0.0, 0.0, 0.0)
    ways = R_we[0].apply([s.packet.displacement for s in samples[1:]])
    np.testing.assert_allclose(ways, np.diff(place, axis=0), atol=2e-6)
    np.testing.assert_allclose([s.packet.interval for s in samples[1:]], 0.01, atol=1.1e-6)


def test_fused_errors_are_as_asked(arm_host):
    host = arm_host(Imperfections(fused_orientation=0.02, fused_displacement=0.003), mode=FUSED)
    ideal = arm_host(mode=FUSED)
    host.listen(10.0)
    ideal.listen(10.0)
    noisy, true = (
        Rotation.from_quat([s.packet.orientation for s in h.of(FusedSample, 1)], scalar_first=True)
        for h in (host, ideal)
    )
    assert (true.inv() * noisy).as_rotvec().std() == pytest.approx(0.02, rel=0.05)
    ways = [np.array([s.packet.displacement for s in h.of(FusedSample, 1)]) for h in (host, ideal)]
    assert (ways[0] - ways[1]).std() == pytest.approx(0.003, rel=0.05)


def test_triggered_samples_bear_the_triggers_number_and_the_moment(arm_host):
    host = arm_host(Imperfections(has_random_clock_start=True), mode=TRIGGERED)
    host.listen(0.5)
    assert not host.of(InertialSample)
    triggers = {65530 + k: 0.5 + 0.0173 * k for k in range(6)}
    for number, at_s in triggers.items():
        host.send(SamplingTrigger(number), BROADCAST, at_s)
    host.send(SamplingTrigger(40000), 2, 0.7)
    host.listen(0.5)
    for module in range(4):
        clock = host.traffic.senders[module].clock
        samples = host.of(InertialSample, module)
        expected = triggers | ({40000: 0.7} if module == 2 else {})
        assert [s.sequence for s in samples] == list(expected)
        for sample, at_s in zip(samples, expected.values(), strict=True):
            assert sample.packet.triggered
            assert sample.module_time_us == clock.count_us(at_s)
            assert host.arrived_s[host.packets.index(sample)] == pytest.approx(at_s)
    host.ask(Verb.STOP, module=1)
    host.send(SamplingTrigger(7), BROADCAST)
    host.listen(0.1)
    assert [p.module for p in host.of(InertialSample)[-3:]] == [0, 2, 3]


def test_the_timer_does_not_heed_triggers(arm_host):
    host = arm_host()
    host.send(SamplingTrigger(1), BROADCAST, 0.105)
    host.listen(1.0)
    assert not any(s.packet.triggered for s in host.of(InertialSample))
    set_up(host, 1, mode=TRIGGERED)
    n_timed = len(host.of(InertialSample, 1))
    host.send(SamplingTrigger(500), 1)
    host.listen(0.5)
    assert [s.sequence for s in host.of(InertialSample, 1)[n_timed:]] == [500]
    set_up(host, 1, mode=RAW)
    host.listen(0.5)
    assert len(host.of(InertialSample, 1)) > n_timed + 40


def test_a_calibration_corrects_what_the_sensors_read(arm_host):
    errors = Imperfections(accelerometer_bias=0.5, gyroscope_bias=0.05, magnetometer_bias=5.0, scale=0.05)
    host, ideal = arm_host(errors, seed=6), arm_host()
    drawn = host.traffic._sampler._sensors[2]._errors
    calibration = np.array(factory_settings()[9])
    A, S = (np.linalg.inv(d) for d in (drawn.accelerometer_distortion, drawn.magnetometer_distortion))
    calibration[:15] = [*A.ravel(), *drawn.accelerometer_bias, *drawn.gyroscope_bias]
    calibration[15:27] = [*S.ravel(), *drawn.magnetometer_bias]
    set_up(host, 2, calibration=tuple(calibration.tolist()))
    host.listen(1.0)
    ideal.listen(host.now_s)
    for corrected, true in zip(
        host.of(InertialSample, 2)[60:], ideal.of(InertialSample, 2)[60:], strict=True
    ):
        assert corrected.packet.specific_force == pytest.approx(true.packet.specific_force, abs=0.011)
        assert corrected.packet.magnetic_field == pytest.approx(true.packet.magnetic_field, abs=0.11)
        rates = corrected.packet.angular_rate, true.packet.angular_rate
        assert np.linalg.norm(rates[0]) == pytest.approx(np.linalg.norm(rates[1]), rel=0.16, abs=0.01)


def test_local_devices_obey_too(human17, host_of):
    host = host_of(SuitTraffic(walking_motion(human17, 1)))
    host.listen(1.0)
    assert len(host.of(LocalMeasurement, 40)) == 10
    set_up(host, 40, sampling_rate=50.0, module_id=41)
    host.listen(1.0)
    assert len(host.of(LocalMeasurement, 41)) == pytest.approx(60, abs=2)
    host.ask(Verb.STOP, module=41)
    n = len(host.of(LocalMeasurement))
    host.listen(1.0)
    assert len(host.of(LocalMeasurement)) == n
