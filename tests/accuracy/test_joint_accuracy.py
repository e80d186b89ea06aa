"""The estimators against known truth, and against VQF on real chains."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_body import angular_error_deg, arm, imu_frames, instants, simulate

from benchmarks.fast_arm import Switches, fast_arm, fast_motion, sampled
from benchmarks.offline import imu_frames as recorded_frames
from benchmarks.offline import orientations
from benchmarks.scoring import score
from benchmarks.simulation import errors_deg
from devices.emulators.recording_formats import read_ring_chain5
from gateway.body.rig import load_rig
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.inertial.joint import JointReconstructor

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
    assert np.sqrt(np.mean(errors**2)) < 1.0
    assert np.mean(errors < 2.0 * sigma) > 0.95


@pytest.mark.parametrize(("name", "ratio"), [("joint", 0.4), ("outward", 0.6)])
def test_a_fast_arm_with_wrong_lever_arms_is_far_better_than_vqf(name, ratio):
    suit = fast_arm()
    motion = fast_motion(suit, 1)
    observed = sampled(suit, motion, Switches(), 1)
    means = []
    for method in (name, "independent"):
        reconstructor = create_reconstructor(method, suit, 0.01)
        frames = [reconstructor.update(frame) for frame in observed]
        means.append(np.mean(errors_deg(frames, motion, 4.0)))
    assert means[0] < ratio * means[1]


def test_lever_arms_that_are_wrong_are_found_where_they_show():
    suit = fast_arm()
    motion = fast_motion(suit, 2)
    wrong = replace(suit, lever_arms=suit.lever_arms + np.array([0.0, 0.02, 0.0]))
    reconstructor = JointReconstructor(wrong, 0.01)
    for frame in sampled(suit, motion, Switches(False, False, 0.0), 2):
        reconstructor.update(frame)
    # to_joint is minus the lever arm: too small by 0.02 along y, on the links that turn about all axes
    found = reconstructor.state()["arm"][2:, 1]
    np.testing.assert_allclose(found, 0.02, atol=0.006)


@pytest.mark.skipif(not RING.is_dir(), reason=f"no recording in {RING}")
@pytest.mark.parametrize(("kind", "ratio"), [("rigid", 0.4), ("nonrigid", 0.75)])
def test_a_real_chain_is_better_than_vqf_once_it_has_moved(kind, ratio):
    recording, suit = read_ring_chain5(RING, kind), load_rig("chain_5")
    observed = recorded_frames(recording, suit)
    means = []
    for method in ("joint", "independent"):
        reconstructor = create_reconstructor(method, suit, 1.0 / recording.sampling_rate_hz)
        frames = [reconstructor.update(frame) for frame in observed]
        means.append(score(*orientations(frames, 0.0), recording, from_s=5.0).total.mean())
    assert means[0] < ratio * means[1]
