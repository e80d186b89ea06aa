"""The chain estimators as reconstructors: resuming, faults, what they say about themselves."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_body import angular_error_deg, arm, imu_frames, instants, simulate

from gateway.frames import Status
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.inertial.tree.reconstructor import (
    STATE_VERSION,
    JointReconstructor,
    OutwardReconstructor,
)

RATE_HZ = 100
BOTH = pytest.mark.parametrize("kind", [JointReconstructor, OutwardReconstructor])


@pytest.fixture(scope="module")
def moving():
    body = arm(on_joint=False)
    truth = simulate(body, instants(RATE_HZ, 6.0))
    return body, truth, imu_frames(body, truth, gyroscopes=True)


def changed(frame, module, **values):
    """The frame with other values of one module."""
    arrays = {}
    for name, value in values.items():
        arrays[name] = getattr(frame, name).copy()
        arrays[name][module] = value
    return replace(frame, **arrays)


@BOTH
def test_resuming_equals_one_run_bit_for_bit(kind, moving):
    body, _, frames = moving
    whole, second = kind(body.suit(), 0.01), kind(body.suit(), 0.01)
    for frame in frames[:200]:
        whole.update(frame)
    second.set_state(whole.state())
    for frame in frames[200:300]:
        a, b = whole.update(frame), second.update(frame)
        for name in ("q_wb", "sigma", "joint_acceleration", "angular_rate"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_state_of_another_body_is_refused(moving):
    reconstructor = JointReconstructor(moving[0].suit(), 0.01)
    state = reconstructor.state()
    state["segments"] = state["segments"][:2]
    with pytest.raises(ValueError, match="'segments' does not fit"):
        reconstructor.set_state(state)


@pytest.mark.parametrize("version", [{}, {"version": np.array([STATE_VERSION + 1])}])
def test_a_state_of_another_version_is_refused(moving, version):
    reconstructor = JointReconstructor(moving[0].suit(), 0.01)
    state = reconstructor.state()
    del state["version"]
    with pytest.raises(ValueError, match=f"of version {version.get('version', [1])[0]}; this is version"):
        reconstructor.set_state(state | version)


def test_a_state_with_other_fields_is_refused(moving):
    reconstructor = JointReconstructor(moving[0].suit(), 0.01)
    state = reconstructor.state()
    state["segments"] = state["segments"][["R", "bias"]].copy()
    with pytest.raises(ValueError, match="'segments' have other fields"):
        reconstructor.set_state(state)


@BOTH
def test_reset_forgets_everything(kind, moving):
    body, _, frames = moving
    reconstructor = kind(body.suit(), 0.01)
    first = [reconstructor.update(frame).q_wb for frame in frames[:50]]
    reconstructor.reset()
    np.testing.assert_array_equal(first, [reconstructor.update(frame).q_wb for frame in frames[:50]])


FAULTS = {
    "dead": {"specific_force": np.nan, "angular_rate": np.nan, "magnetic_field": np.nan, "status": 5},
    "held": {"status": 2},
    "saturated": {"angular_rate": 34.9, "specific_force": 156.9},
    "magnet": {"magnetic_field": 400.0},
    "no field": {"magnetic_field": np.nan},
    "no accelerometer": {"specific_force": np.nan},
}


@BOTH
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seconds", [0.3, 2.0])
def test_a_fault_of_one_module_stays_finite_and_the_neighbours_recover(kind, fault, seconds, moving):
    body, truth, frames = moving
    reconstructor = kind(body.suit(), 0.01)
    last = 200 + int(seconds * RATE_HZ)
    for k, frame in enumerate(frames):
        seen = reconstructor.update(changed(frame, 1, **FAULTS[fault]) if 200 <= k < last else frame)
        assert np.isfinite(seen.q_wb).all()
        assert np.isfinite(seen.sigma).all()
        np.testing.assert_allclose(np.linalg.norm(seen.q_wb, axis=1), 1.0, atol=1e-9)
        if fault in ("dead", "held") and k == 210:
            assert list(seen.status) == [Status.MEASURED, Status.PREDICTED, Status.MEASURED, Status.MEASURED]
    errors = angular_error_deg(seen.q_wb, truth.R[-1])
    assert errors[[0, 2, 3]].max() < 3.0
    assert seen.status.max() == Status.MEASURED


def test_sigma_grows_while_a_module_is_silent(moving):
    body, _, frames = moving
    reconstructor = JointReconstructor(body.suit(), 0.01)
    sigma = [
        reconstructor.update(changed(f, 2, **FAULTS["dead"]) if 200 <= k < 250 else f).sigma[2]
        for k, f in enumerate(frames[:250])
    ]
    # for the first instants it goes on at the rate it had, and the others know where
    assert (np.diff(sigma[203:250]) > 0.0).all()
    assert sigma[249] > 2.0 * sigma[199]


@pytest.mark.parametrize("name", ["joint", "outward"])
def test_a_segment_without_module_follows_its_parent(name, moving):
    body = replace(moving[0], module_of_segment=(0, -1, 1, 2))
    truth = moving[1]
    reconstructor = create_reconstructor(name, body.suit(), 0.01)
    for frame in imu_frames(body, truth, gyroscopes=True)[:300]:
        seen = reconstructor.update(frame)
    assert seen.status[1] == Status.PREDICTED
    np.testing.assert_array_equal(seen.q_wb[1], seen.q_wb[0])
    assert np.isfinite(seen.q_wb).all()


def test_nothing_is_defined_before_the_first_sample(moving):
    body, _, frames = moving
    seen = JointReconstructor(body.suit(), 0.01).update(changed(frames[0], 3, **FAULTS["dead"]))
    assert list(seen.status) == [0, 0, 0, Status.MISSING]
    assert np.isnan(seen.q_wb[3]).all()
    assert np.isnan(seen.sigma[3])


def test_a_repeated_frame_changes_nothing(moving):
    body, _, frames = moving
    reconstructor = JointReconstructor(body.suit(), 0.01)
    for frame in frames[:20]:
        before = reconstructor.update(frame)
    np.testing.assert_array_equal(reconstructor.update(frames[19]).q_wb, before.q_wb)
