"""Chains that begin in mid-motion: no module has felt gravity alone."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.fast_arm import fast_arm, sampled
from gateway.emulation.random_chains import drawn
from gateway.frames import FloatArray
from gateway.geometry.comparison import orientation_error
from gateway.reconstruction.inertial.tree.reconstructor import (
    ChainReconstructor,
    ChainSettings,
    JointReconstructor,
    OutwardReconstructor,
)
from gateway.reconstruction.inertial.tree.state import Validity, chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.unaided import note_speed, unaided_rows
from gateway.reconstruction.reconstructor import update_many


@pytest.mark.parametrize("method", [JointReconstructor, OutwardReconstructor])
@pytest.mark.parametrize("seed", [1012, 1048])
def test_inclinations_far_from_where_a_chain_is_held_are_found_soon(
    seed: int, method: type[ChainReconstructor]
) -> None:
    """Eight segments held at the last and three held at the first: until a joint told them, which takes one
    after the other, the far ones stayed 40 to 60° off for as many seconds."""
    times_s, inclination = _inclination_deg(seed, method, 5.0)
    assert np.max(inclination[0]) > 20.0  # one sample in mid-motion tells no better
    assert np.max(inclination[times_s > 4.0]) < 8.0


def test_what_a_start_was_off_by_is_no_drift_of_gyroscopes() -> None:
    """Nine segments that nothing aids, at 11 rad/s: the first second's accelerations were taken for small,
    the inclinations they gave for certain, and what came later for biases, which led it away by 7°."""
    times_s, inclination = _inclination_deg(6098, JointReconstructor, 30.0)
    assert np.max(np.mean(inclination[times_s > 15.0], axis=1)) < 4.0


def _inclination_deg(
    seed: int, method: type[ChainReconstructor], seconds: float
) -> tuple[FloatArray, FloatArray]:
    """Times (T,) and errors (T, n) of a chain that begins in mid-motion."""
    chain = drawn(seed)
    assert not chain.begins_at_rest
    observed = sampled(chain.suit, chain.motion, chain.switches, seed, chain.rate_hz)
    poses = update_many(method(chain.suit, 1.0 / chain.rate_hz), observed[: round(seconds * chain.rate_hz)])
    times_s = np.array([pose.time_ns for pose in poses]) * 1e-9
    truth = chain.motion.state(times_s).q_wb
    error = orientation_error(np.stack([pose.q_wb for pose in poses]), truth)
    return times_s, np.degrees(error.inclination)


def test_those_before_turn_to_one_whose_device_has_shown_its_heading() -> None:
    """A device on the fourth of six segments shows its heading within two seconds. Once a motion showed that
    against the root, all that were right were turned to the root, which was not: 40° off."""
    chain = drawn(5002)
    frames = sampled(chain.suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)
    joint = JointReconstructor(chain.suit, 1.0 / chain.rate_hz, ChainSettings(uses_field=False))
    late = [pose for pose in update_many(joint, frames) if pose.time_ns > frames[0].time_ns + 4e9]
    truth = chain.motion.state(np.array([pose.time_ns for pose in late]) * 1e-9).q_wb
    assert np.degrees(orientation_error(np.stack([pose.q_wb for pose in late]), truth).total).max() < 15.0


def test_a_chain_that_nothing_aids_finds_down_again() -> None:
    """A tilt is no acceleration that lasts: it makes a velocity that grows. When tilts of 10° counted as
    certain to 2° and passed for accelerations, gravity counted for nothing: 29° off at the end."""
    chain = drawn(36004)
    suit = replace(chain.suit, local_devices=())
    observed = [
        replace(f, local=()) for f in sampled(suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)
    ]
    joint = JointReconstructor(suit, 1.0 / chain.rate_hz, ChainSettings(uses_field=False))
    late = [pose for pose in update_many(joint, observed) if pose.time_ns > observed[0].time_ns + 8e9]
    times_s = np.array([pose.time_ns - observed[0].time_ns for pose in late]) * 1e-9
    truth = chain.motion.state(np.array([pose.time_ns for pose in late]) * 1e-9).q_wb
    inclination = np.degrees(orientation_error(np.stack([pose.q_wb for pose in late]), truth).inclination)
    assert inclination.max() < 4.0
    assert inclination[times_s > 20.0].mean() < 2.0


def test_a_tilt_that_is_wrong_is_no_speed_of_the_body() -> None:
    """No speed lasts: what a velocity is for good counts for less and less."""
    segment = initial_state(1, 0).segments[0]
    world = chain_body(fast_arm(), uses_field=False).world
    segment.velocity.felt[...] = 1.7, 0.0, 0.0
    segment.velocity.lasting[...] = segment.velocity.felt
    segment.velocity.square = 1.0
    for _ in range(1000):
        note_speed(segment, world, tuning(), 0.01)
    assert segment.velocity.square == pytest.approx(np.exp(-10.0 / tuning().speed_mean_s))


def test_a_tilt_that_gravity_contradicts_for_long_becomes_less_certain_for_all_alike() -> None:
    """What joints have shown of one segment against another stays as sure as it was."""
    body, used, dt = chain_body(fast_arm(), uses_field=False), tuning(), 0.01
    n = len(body.segments)
    state, work = initial_state(n, 1), work_space(n)
    work.segments["validity"], work.segments["chain"] = Validity.FORCE, 0
    state.segments["P"] = np.diag([1e-4] * 6)
    state.segments["velocity"]["tilted_s"], state.segments["velocity"]["variance"] = 0.5, 0.01
    for name in ("felt", "lasting"):
        state.segments["velocity"][name] = 1.7, 0.0, 0.0
    before = state.segments.copy()
    unaided_rows(body, state, used, work, dt)
    seen = (0.5 * 1.7**2 - 0.01) / (9.81 * 0.5) ** 2 - 1e-4
    grown = np.zeros((n, 6, 6))
    grown[:, :2, :2] = seen * (1.0 - np.exp(-dt / used.unaided_memory_s)) * np.eye(2)
    np.testing.assert_allclose(state.segments["P"], before["P"] + grown, rtol=1e-6)
    np.testing.assert_allclose(state.segments["C"][1:], grown[1:], rtol=1e-6)
