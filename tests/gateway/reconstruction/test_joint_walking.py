"""The tree filter on a person who walks: better than module by module, resumable, over missing segments."""

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.gait import WALK
from devices.emulators.motion.motions import gait_motion
from devices.emulators.sensing.ideal_sensors import sense
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress
from gateway.emulation.simulation import measure_walk
from gateway.frames import ImuFrame
from gateway.reconstruction import create_reconstructor, update_many

SECONDS = 20.0


def frames_of(rig):
    """The suit (nothing measures its place), its motion, and what slightly noisy, biased modules measure."""
    suit = replace(load_rig(rig), local_devices=())
    n = suit.skeleton.n_segments
    suit = replace(suit, sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)))
    motion, rng = gait_motion(dress(suit), 1, gait=WALK), np.random.default_rng(1)
    times = np.arange(round(100 * SECONDS)) / 100
    values = sense(
        motion.state(times), suit.lever_arms, np.tile(np.eye(3), (n, 1, 1)), suit.gravity, suit.magnetic_field
    )
    segments = [int(np.flatnonzero(suit.module_of_segment == m)[0]) for m in range(len(suit.module_ids))]
    shape = (len(times), len(segments), 3)
    force = values.specific_force[:, segments] + 0.03 * rng.normal(size=shape)
    rate = (
        values.angular_rate[:, segments] + 0.002 * rng.normal(size=shape) + 0.005 * rng.normal(size=shape[1:])
    )
    field, none = values.magnetic_field[:, segments], np.zeros(len(segments), np.int64)
    frames = [
        ImuFrame(k, round(t * 1e9), force[k], rate[k], field[k], none.astype(np.uint8), none)
        for k, t in enumerate(times)
    ]
    return suit, motion, frames


@pytest.fixture(scope="module")
def person():
    return frames_of("suit_17")


def test_who_walks_straight_on_is_not_tilted_by_feet_that_roll_off(person):
    suit, motion, frames = person
    ours, peer = (
        measure_walk(update_many(create_reconstructor(name, suit, 0.01), frames), motion)
        for name in ("joint", "independent")
    )
    assert ours.tilt_deg < 0.9 * peer.tilt_deg
    assert ours.total_deg < peer.total_deg
    assert ours.height_error_m < 0.05
    assert abs(ours.length_error) < 0.01
    assert ours.largest_step_deg < 0.5
    assert ours.covered_percent > 93


def test_segments_without_module_are_passed_over_and_the_others_gain(person):
    suit, motion, frames = frames_of("suit_23_from_17")
    found = update_many(create_reconstructor("joint", suit, 0.01), frames)
    without = update_many(create_reconstructor("independent", suit, 0.01), frames)
    truth = motion.state(np.array([frame.time_ns for frame in frames[500:]]) * 1e-9).q_wb
    ours, peer = (mean_error(way[500:], truth, suit.module_of_segment >= 0) for way in (found, without))
    assert ours < peer
    assert all(found[-1].status[suit.module_of_segment < 0] == 3)
    assert np.isfinite(found[-1].q_wb).all()


def mean_error(frames, truth, kept):
    """Degrees, RMS over time, mean of segments."""
    dot = np.abs(np.sum(np.stack([frame.q_wb for frame in frames])[:, kept] * truth[:, kept], axis=-1))
    return np.degrees(np.sqrt(np.mean((2.0 * np.arccos(np.minimum(dot, 1.0))) ** 2, axis=0))).mean()


@pytest.mark.parametrize("name", ["joint", "outward"])
def test_resuming_a_whole_body_equals_one_run_bit_for_bit(name, person, tmp_path):
    suit, _, frames = person
    whole, second = (create_reconstructor(name, suit, 0.01) for _ in range(2))
    update_many(whole, frames[:700])
    np.savez(tmp_path / "state.npz", **whole.state())
    second.set_state(dict(np.load(tmp_path / "state.npz")))
    for a, b in zip(update_many(whole, frames[700:1000]), update_many(second, frames[700:1000]), strict=True):
        for field in ("q_wb", "p_w", "sigma", "joint_acceleration", "angular_rate", "status", "root"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
