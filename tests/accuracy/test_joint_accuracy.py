"""The estimators against known truth, and against VQF on real chains."""

import os
from pathlib import Path

import numpy as np
import pytest
from simulated_body import angular_error_deg, arm, imu_frames, instants, simulate

from benchmarks.offline import imu_frames as recorded_frames
from benchmarks.offline import orientations
from benchmarks.scoring import score
from benchmarks.simulation import errors_deg, through_the_wire
from devices.emulators.imperfections import Imperfections
from devices.emulators.motions import generic_motion
from devices.emulators.recording_formats import read_ring_chain5
from gateway.body.rig import load_rig
from gateway.cli.emulated_rig import dress
from gateway.reconstruction import create_reconstructor

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
RING = DATA / "ring_chain5" / "trial1"


def test_ideal_sensors_are_followed_and_sigma_covers_the_error():
    body = arm(on_joint=False)
    truth = simulate(body, instants(100, 20.0))
    reconstructor = create_reconstructor("joint", body.suit(), 0.01)
    frames = [reconstructor.update(frame) for frame in imu_frames(body, truth, gyrometers=True)]
    errors = angular_error_deg(np.stack([frame.q_wb for frame in frames]), truth.R)[1000:]
    sigma = np.degrees(np.stack([frame.sigma for frame in frames]))[1000:]
    assert np.sqrt(np.mean(errors**2)) < 6.0
    assert np.mean(errors < 2.0 * sigma) > 0.95


@pytest.mark.parametrize(("name", "bound_deg"), [("joint", 4.0), ("outward", 6.0)])
def test_a_fast_arm_with_wrong_lever_arms(name, bound_deg):
    suit = load_rig("robot_arm_4")
    motion = generic_motion(dress(suit), 1, peak_angular_rate=9.0, peak_angular_acceleration=90.0)
    sensors = Imperfections(accelerometer_noise=0.03, gyrometer_noise=0.002, placement=0.01)
    frames = through_the_wire(suit, motion, sensors, name, 12.0, 1)
    assert np.mean(errors_deg(frames, motion, 4.0)) < bound_deg


@pytest.mark.skipif(not RING.is_dir(), reason=f"no recording in {RING}")
@pytest.mark.parametrize(("name", "ratio"), [("joint", 0.6), ("outward", 0.8)])
def test_a_real_chain_is_better_than_vqf_once_it_has_moved(name, ratio):
    recording, suit = read_ring_chain5(RING), load_rig("chain_5")
    observed = recorded_frames(recording, suit)
    means = []
    for method in (name, "independent"):
        reconstructor = create_reconstructor(method, suit, 1.0 / recording.sampling_rate_hz)
        frames = [reconstructor.update(frame) for frame in observed]
        means.append(score(*orientations(frames, 0.0), recording, from_s=5.0).total.mean())
    assert means[0] < ratio * means[1]
