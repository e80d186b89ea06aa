"""Magnetometers that stay in their own axes while their modules turn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.emulation.fast_arm import Switches, carried_arm, carried_motion, sampled
from gateway.geometry.comparison import orientation_error
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor
from gateway.reconstruction.inertial.tree.state import Validity, initial_state, work_space
from gateway.reconstruction.inertial.tree.stuck import leave_out_stuck_fields
from gateway.reconstruction.inertial.tree.tuning import tuning

DT, TUNING = 0.01, tuning()
FIELD = np.array([0.0, 21.0, -45.0])


def used_of(fields, rates):
    """Which of a module's fields (T, 3) µT are used, while it turns by rates (T, 3) rad/s."""
    state, work = initial_state(1, 0), work_space(1)
    now, used = work.segments[0], []
    for field, rate in zip(fields, rates, strict=True):
        now.validity = Validity.FORCE.value
        now.magnetic_field[:], now.mean_rate[:] = field, rate
        leave_out_stuck_fields(state, TUNING, work, DT)
        used.append(bool(np.isfinite(now.magnetic_field).all()))
    return np.array(used)


def turning(rate, seconds, noise=0.5):
    """Rates (T, 3) of an even turn, and the fields of a sound magnetometer of so much noise, µT."""
    n = round(seconds / DT)
    rates = np.tile(rate, (n, 1))
    turned = Rotation.from_rotvec(np.arange(1, n + 1)[:, None] * rates * DT)
    fields = turned.inv().apply(FIELD) + noise * np.random.default_rng(1).standard_normal((n, 3))
    return rates, fields


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_field_that_stays_is_left_out_once_the_module_has_turned(noise):
    rates, fields = turning([0.5, 0.2, 0.0], 6.0, 0.0)
    stuck = FIELD + noise * np.random.default_rng(2).standard_normal(fields.shape)
    used = used_of(stuck, rates)
    assert used[:100].all()
    assert not used[250:].any()


@pytest.mark.parametrize("speed", [0.06, 0.5, 5.0, 20.0])
def test_a_sound_field_is_used(speed):
    rates, fields = turning([speed, 0.3 * speed, 0.0], 20.0)
    assert used_of(fields, rates).all()


def test_a_turn_about_the_field_itself_proves_nothing():
    rates, fields = turning(2.0 * FIELD / np.linalg.norm(FIELD), 10.0)
    assert used_of(fields, rates).all()


def test_a_module_at_rest_whose_gyroscope_is_off_keeps_its_field():
    rates, _ = turning([0.04, 0.0, 0.0], 60.0)
    assert used_of(np.tile(FIELD, (len(rates), 1)), rates).all()


def test_a_magnetometer_that_is_read_seldom_is_not_stuck():
    rates, fields = turning([6.0, 2.0, 0.0], 10.0)
    seldom = fields[np.arange(len(fields)) // 20 * 20]
    assert used_of(seldom, rates).all()


def test_a_field_that_comes_back_is_used_again():
    rates, fields = turning([0.5, 0.2, 0.0], 10.0)
    fields[:500] = FIELD
    used = used_of(fields, rates)
    assert not used[300:500].any()
    assert used[500:].all()


def test_a_stuck_magnetometer_no_longer_turns_a_whole_chain():
    suit = carried_arm()
    motion = carried_motion(suit, 1)
    frames = sampled(suit, motion, Switches(), 1, seconds=20.0)
    suit = replace(suit, local_devices=())
    stuck = []
    for frame in frames:
        field = frame.magnetic_field.copy()
        field[1] = [20.0, -40.0, 15.0]
        stuck.append(replace(frame, magnetic_field=field, local=()))
    found = JointReconstructor(suit, DT).update_many(stuck)
    truth = motion.state(np.array([frame.time_ns for frame in frames]) * 1e-9).q_wb
    later = slice(len(frames) // 2, None)
    error = orientation_error(np.stack([pose.q_wb for pose in found])[later], truth[later])
    assert np.degrees(error.total).mean() < 1.0
