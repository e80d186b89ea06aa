"""The literal method against exact truth: its error is that of the backward differences, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_body import (
    FIELD,
    SimulatedBody,
    SumOfSines,
    Turn,
    angular_error_deg,
    arm,
    imu_frames,
    instants,
    simulate,
)

from gateway.body.skeleton import LocalDevice
from gateway.frames import Quantity
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor, StartingPose

COMBINATIONS = {
    "special": (True, False),
    "special with gyroscopes": (True, True),
    "general": (False, False),
    "general with gyroscopes": (False, True),
}


def starting_pose(truth):
    q = Rotation.from_matrix(truth.R[0]).as_quat()[:, [3, 0, 1, 2]]
    return StartingPose(q, truth.angular_rate[0])


def run(body, rate_hz, gyroscopes, seconds=3.0, after_each=None):
    """Errors in degrees, (instants, segments)."""
    truth = simulate(body, instants(rate_hz, seconds))
    reconstructor = ArticulatedReconstructor(body.suit(), 1.0 / rate_hz, starting_pose=starting_pose(truth))
    q_wb = []
    for imu_frame in imu_frames(body, truth, gyroscopes):
        q_wb.append(reconstructor.update(imu_frame).q_wb)
        if after_each is not None:
            after_each(reconstructor)
    return angular_error_deg(np.array(q_wb), truth.R)


def rms(errors):
    return np.sqrt(np.nanmean(errors**2, axis=0))


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_below_half_a_degree_at_800_hz(combination):
    on_joint, gyroscopes = COMBINATIONS[combination]
    assert rms(run(arm(on_joint), 800, gyroscopes)).max() < 0.5


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_error_falls_in_proportion_to_the_sampling_interval(combination):
    on_joint, gyroscopes = COMBINATIONS[combination]
    # without gyroscopes and U = 0 rounding takes over in rank 4 above 800 Hz: see below
    rates = [100, 200, 400, 800] if combination == "special" else [100, 400, 1600]
    errors = np.array([rms(run(arm(on_joint), rate, gyroscopes)) for rate in rates])
    first = 1 if on_joint else 0  # rank 1 with U = 0 under a fixed joint is exact
    order = -np.diff(np.log(errors[:, first:]), axis=0) / np.diff(np.log(rates))[:, None]
    # the first-order term is all there is, to within what the transient of the start and rank 4's spikes do
    assert np.all(np.abs(order - 1.0) < 0.2), order
    assert on_joint is False or errors[:, 0].max() < 1e-13 * 180


def test_rank_1_is_exact_where_its_joint_is_fixed():
    assert run(arm(on_joint=True), 100, gyroscopes=False)[:, 0].max() < 1e-12


@pytest.mark.parametrize(
    ("rate_hz", "floor_deg"), [(100, 1e-6), (200, 6e-5), (400, 4e-3), (800, 0.25), (1600, 16.0)]
)
def test_rounding_sets_a_floor_in_the_special_case(rate_hz, floor_deg):
    """A body that hardly moves has no error of differences; what is left is rounding, 64-fold an octave."""
    almost_still = arm(on_joint=True, amplitude=0.02, tempo=0.02, bent=0.3)
    errors = rms(run(almost_still, rate_hz, gyroscopes=False, seconds=1.0))
    assert floor_deg / 10.0 < errors[3] < floor_deg
    assert errors[2] < 1e-3


def test_general_case_holds_for_half_a_minute():
    errors = run(arm(on_joint=False), 100, gyroscopes=False, seconds=30.0)
    assert rms(errors[-500:]).max() < 1.0
    assert errors.max() < 5.0


def test_earlier_orientations_taken_as_exact_run_away():
    """Why the general case weighs them: without their uncertainty the equations are a pendulum."""

    def forget_uncertainty(reconstructor):
        reconstructor._state.covariance[:] = 0.0

    errors = run(arm(on_joint=False), 400, gyroscopes=False, after_each=forget_uncertainty)
    assert errors[40].max() < 0.3
    assert errors[-400:].max() > 60.0


def test_general_case_from_a_static_start():
    body = arm(on_joint=False, from_rest=True)
    truth = simulate(body, instants(200, 6.0, start_s=-0.5))
    reconstructor = ArticulatedReconstructor(body.suit(), 1.0 / 200)
    q_wb = np.array([reconstructor.update(f).q_wb for f in imu_frames(body, truth, gyroscopes=False)])
    assert np.isnan(q_wb[:19]).all()
    errors = angular_error_deg(q_wb[19:], truth.R[19:])
    assert errors[:70].max() < 1e-10  # at rest
    assert rms(errors).max() < 0.5


@pytest.mark.parametrize("gyroscopes", [False, True])
def test_general_case_bears_the_noise_of_real_modules(gyroscopes):
    """0.02 m/s², 0.005 rad/s, 0.5 % of the field, at 100 Hz."""
    rng = np.random.default_rng(1)
    body = arm(on_joint=False)
    truth = simulate(body, instants(100, 10.0))
    reconstructor = ArticulatedReconstructor(body.suit(), 0.01, starting_pose=starting_pose(truth))
    q_wb = []
    for imu_frame in imu_frames(body, truth, gyroscopes):
        noise = rng.standard_normal((3, *imu_frame.specific_force.shape))
        q_wb.append(
            reconstructor.update(
                replace(
                    imu_frame,
                    specific_force=imu_frame.specific_force + 0.02 * noise[0],
                    angular_rate=imu_frame.angular_rate + 0.005 * noise[1],
                    magnetic_field=imu_frame.magnetic_field + 0.005 * np.linalg.norm(FIELD) * noise[2],
                )
            ).q_wb
        )
    errors = rms(angular_error_deg(np.array(q_wb), truth.R))
    assert errors[0] < 1.0
    assert errors.max() < 3.5


def resting(lever_arm):
    """One segment at rest, axes along the world's."""
    return SimulatedBody(
        parents=(-1,),
        offsets=np.zeros((1, 3)),
        lever_arms=np.array([lever_arm]),
        turns=((Turn(2, SumOfSines(((0.0, 1.0, 0.0),))),),),
        local_devices=(LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),),
    )


@pytest.mark.parametrize(
    ("lever_arm", "seconds", "bound_deg"),
    [([0.12, 0.0, 0.0], 0.5, 0.15), ([0.08, 0.0, 0.08], 1.0, 0.01), ([0.0, 0.0, -0.12], 8.0, 0.2)],
)
def test_a_wrong_start_is_corrected_where_the_module_is_not_in_the_plane(lever_arm, seconds, bound_deg):
    assert wrong_start_error(lever_arm, seconds) < bound_deg


def test_a_wrong_start_is_not_seen_where_force_arm_and_field_are_coplanar():
    assert wrong_start_error([0.0, 0.0, 0.12], 2.0) > 1.0


def wrong_start_error(lever_arm, seconds):
    """Degrees left of a start that is 1° wrong about the field."""
    body = resting(lever_arm)
    truth = simulate(body, instants(200, seconds))
    wrong = Rotation.from_rotvec(np.radians(1.0) * FIELD / np.linalg.norm(FIELD)).as_quat()[[3, 0, 1, 2]]
    pose = StartingPose(wrong[None], np.zeros((1, 3)))
    reconstructor = ArticulatedReconstructor(body.suit(), 1.0 / 200, starting_pose=pose)
    for imu_frame in imu_frames(body, truth, gyroscopes=False):
        last = reconstructor.update(imu_frame)
    return angular_error_deg(last.q_wb, truth.R[-1])[0]
