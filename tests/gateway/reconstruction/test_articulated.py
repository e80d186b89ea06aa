"""The articulated reconstructor: when what is defined, on any tree, from any root, through gaps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_body import (
    ARM_LEVERS,
    GRAVITY,
    SimulatedBody,
    SumOfSines,
    Turn,
    angular_error_deg,
    arm,
    imu_frames,
    instants,
    local_readings,
    simulate,
)

from gateway.body.skeleton import LocalDevice
from gateway.frames import Quantity, Status
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor, StartingPose

ROOT_SWAY = tuple(SumOfSines(((0.05 + 0.02 * k, 5.0 + k, 0.4 * k),)) for k in range(3))
KINDS = (Quantity.FIXED_POINT, Quantity.ACCELERATION, Quantity.VELOCITY, Quantity.POSITION)


def run(body, imu_frames_, rate_hz=100, pose=None):
    reconstructor = ArticulatedReconstructor(body.suit(), 1.0 / rate_hz, starting_pose=pose)
    return [reconstructor.update(imu_frame) for imu_frame in imu_frames_]


def stack(frames, name):
    return np.array([getattr(frame, name) for frame in frames])


def rms_deg(frames, truth):
    errors = angular_error_deg(stack(frames, "q_wb"), truth.R)
    return np.sqrt(np.nanmean(errors**2, axis=0))


def starting_pose(truth):
    return StartingPose(Rotation.from_matrix(truth.R[0]).as_quat()[:, [3, 0, 1, 2]], truth.angular_rate[0])


def swaying(kind, on_joint=True, **changes):
    """The arm on a moving shoulder, or a fixed one, with a local device at the shoulder."""
    devices = (LocalDevice(kind, 0, np.zeros(3), device=9),)
    sway = () if kind is Quantity.FIXED_POINT else ROOT_SWAY
    return arm(on_joint, root_position=sway, local_devices=devices, **changes)


# --- warm-up ---------------------------------------------------------------------------------------

EXTRA = {Quantity.FIXED_POINT: 0, Quantity.ACCELERATION: 0, Quantity.VELOCITY: 1, Quantity.POSITION: 2}


@pytest.mark.parametrize("kind", KINDS)
def test_rank_n_is_defined_exactly_from_sample_2n_minus_1(kind):
    body = swaying(kind)
    truth = simulate(body, instants(100, 0.15))
    frames = run(body, imu_frames(body, truth, gyroscopes=False))
    status, q_wb = stack(frames, "status"), stack(frames, "q_wb")
    for rank in range(1, 5):
        first = 2 * rank - 1 + EXTRA[kind]  # samples count from 1
        assert (status[: first - 1, rank - 1] == Status.WARMING_UP).all()
        assert np.isnan(q_wb[: first - 1, rank - 1]).all()
        assert (status[first - 1 :, rank - 1] == Status.MEASURED).all()
        assert np.isfinite(q_wb[first - 1 :, rank - 1]).all()


@pytest.mark.parametrize("on_joint", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_with_gyroscopes_all_ranks_come_together(kind, on_joint):
    body = swaying(kind, on_joint)
    truth = simulate(body, instants(100, 0.1))
    status = stack(run(body, imu_frames(body, truth, gyroscopes=True)), "status")
    needs_rate_derivative = [0 if on_joint else 1, 1, 1, 1]
    first = np.maximum(needs_rate_derivative, EXTRA[kind])  # counted from 0
    expected = np.where(np.arange(len(status))[:, None] < first, Status.WARMING_UP, Status.MEASURED)
    np.testing.assert_array_equal(status, expected)


def test_general_case_without_gyroscopes_or_start_says_so():
    body = arm(on_joint=False)
    truth = simulate(body, instants(100, 0.5))
    frames = run(body, imu_frames(body, truth, gyroscopes=False))
    assert (stack(frames, "status") == Status.WARMING_UP).all()
    assert np.isnan(stack(frames, "q_wb")).all()


def test_a_starting_pose_counts_from_the_first_frame():
    body = arm(on_joint=False)
    truth = simulate(body, instants(100, 0.5))
    frames = run(body, imu_frames(body, truth, gyroscopes=False), pose=starting_pose(truth))
    assert (stack(frames, "status") == Status.MEASURED).all()
    assert angular_error_deg(frames[0].q_wb, truth.R[0]).max() < 1e-6


# --- local devices ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gyroscopes", [False, True])
@pytest.mark.parametrize("on_joint", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_local_device_carries_the_chain(kind, on_joint, gyroscopes):
    body = swaying(kind, on_joint)
    errors = []
    for rate_hz in (200, 400):
        truth = simulate(body, instants(rate_hz, 2.0))
        frames = run(body, imu_frames(body, truth, gyroscopes), rate_hz, starting_pose(truth))
        errors.append(rms_deg(frames, truth)[:2])
    assert errors[1].max() < 1.0
    if kind is Quantity.POSITION:  # lags by a whole step, so the first rank shows the order best
        assert errors[1][0] == pytest.approx(errors[0][0] / 2.0, rel=0.15)


@pytest.mark.parametrize("gyroscopes", [False, True])
def test_local_device_away_from_the_joint_makes_a_virtual_joint(gyroscopes):
    device = LocalDevice(Quantity.ACCELERATION, 0, np.array([0.2, 0.05, -0.1]), device=9)
    body = arm(False, root_position=ROOT_SWAY, local_devices=(device,))
    truth = simulate(body, instants(400, 2.0))
    frames = run(body, imu_frames(body, truth, gyroscopes), 400, starting_pose(truth))
    assert rms_deg(frames, truth).max() < 1.0
    found = stack(frames, "joint_acceleration")[20:]
    np.testing.assert_allclose(found, truth.joint_acceleration[20:], atol=1.5)
    assert np.sqrt(np.mean((found - truth.joint_acceleration[20:]) ** 2)) < 0.15


def test_slower_local_device_is_interpolated_when_its_readings_are_ahead():
    body = swaying(Quantity.ACCELERATION)
    truth = simulate(body, instants(400, 1.0))
    every_fourth = [local_readings(body, truth, k) if k % 4 == 0 else () for k in range(len(truth.time_ns))]
    ahead = [every_fourth[k + 4] if k + 4 < len(every_fourth) else () for k in range(len(every_fourth))]
    errors = {}
    for name, readings in (("held", every_fourth), ("interpolated", ahead)):
        errors[name] = rms_deg(run(body, imu_frames(body, truth, True, readings), 400), truth)[0]
    assert errors["interpolated"] < 0.1 * errors["held"]


def test_position_device_places_the_body():
    device = LocalDevice(Quantity.POSITION, 1, np.array([0.1, 0.0, 0.05]), device=9)
    body = arm(False, root_position=ROOT_SWAY, local_devices=(device,))
    truth = simulate(body, instants(400, 1.0))
    frames = run(body, imu_frames(body, truth, gyroscopes=True), 400)
    assert frames[0].root == 1
    np.testing.assert_allclose(stack(frames, "p_w")[5:], truth.p_w[5:], atol=0.01)


# --- trees and roots -------------------------------------------------------------------------------


def two_chains(root=0, kind=Quantity.FIXED_POINT, position=(0.0, 0.0, 0.0), on_joint=False):
    """A trunk with two chains of two: 0 ─ 1 ─ 2, 0 ─ 3 ─ 4."""
    rng = np.random.default_rng(12)
    offsets = np.array([[0, 0, 0], [0.05, 0.4, 0.15], [0.3, 0, 0], [0.05, 0.4, -0.15], [0.28, 0, 0.0]], float)
    turns = []
    for segment in range(5):
        scale = 0.15 if segment == 0 else 0.25
        angles = [
            SumOfSines(((scale * rng.uniform(0.6, 1.0), rng.uniform(3.0, 6.0), rng.uniform(0.0, 6.0)),))
            for _ in range(3)
        ]
        turns.append(tuple(Turn(axis, angle) for axis, angle in enumerate(angles)))
    levers = np.array(
        [[0.2, 0.05, 0.02], [0.15, 0.01, 0], [0.12, 0, 0.02], [0.15, 0, 0.01], [0.12, 0.02, 0]], float
    )
    return SimulatedBody(
        parents=(-1, 0, 1, 0, 3),
        offsets=offsets,
        lever_arms=np.zeros((5, 3)) if on_joint else levers,
        turns=tuple(turns),
        root_position=() if kind is Quantity.FIXED_POINT else ROOT_SWAY,
        local_devices=(LocalDevice(kind, root, np.array(position), device=9),),
    )


@pytest.mark.parametrize("gyroscopes", [False, True])
@pytest.mark.parametrize("on_joint", [False, True])
def test_two_chains_share_a_root(gyroscopes, on_joint):
    body = two_chains(on_joint=on_joint)
    truth = simulate(body, instants(400, 2.0))
    frames = run(body, imu_frames(body, truth, gyroscopes), 400, starting_pose(truth))
    assert rms_deg(frames, truth).max() < 0.5
    np.testing.assert_allclose(stack(frames, "p_w")[10:], truth.p_w[10:], atol=0.02)


# from root 4 the trunk's module lies in the plane of force and field: without gyroscopes not observable
@pytest.mark.parametrize(("root", "gyroscopes"), [(1, False), (2, False), (1, True), (2, True), (4, True)])
def test_any_segment_may_be_the_root(root, gyroscopes):
    body = two_chains(root, Quantity.ACCELERATION, position=(0.1, 0.02, -0.03))
    truth = simulate(body, instants(400, 2.0))
    frames = run(body, imu_frames(body, truth, gyroscopes), 400, starting_pose(truth))
    assert frames[0].root == root
    assert rms_deg(frames, truth).max() < 1.5
    found, true = stack(frames, "joint_acceleration")[20:], truth.joint_acceleration[20:]
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.25
    # no position is measured: P_1 is the origin, and everything else lies right around it
    shift = stack(frames, "p_w")[20:] - truth.p_w[20:]
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=0.02)


def test_without_local_device_the_root_is_fixed():
    body = arm(on_joint=True, local_devices=())
    truth = simulate(body, instants(100, 0.3))
    assert rms_deg(run(body, imu_frames(body, truth, gyroscopes=True)), truth)[0] < 1e-6


# --- missing data ----------------------------------------------------------------------------------


def test_a_segment_without_module_cuts_its_chain_and_no_other():
    body = replace(two_chains(), module_of_segment=(0, -1, 1, 2, 3))
    truth = simulate(body, instants(200, 0.5))
    frames = run(body, imu_frames(body, truth, gyroscopes=True), 200)
    last = frames[-1]
    M, ok = Status.MISSING, Status.MEASURED
    np.testing.assert_array_equal(last.status, [ok, M, M, ok, ok])
    np.testing.assert_array_equal(np.isnan(last.q_wb).any(axis=1), [False, True, True, False, False])
    # the joint at which the chain is cut still moves as its neighbour says
    np.testing.assert_allclose(last.joint_acceleration[1], truth.joint_acceleration[-1, 1], atol=0.3)
    np.testing.assert_array_equal(np.isnan(last.p_w).any(axis=1), [False, False, True, False, False])


@pytest.mark.parametrize("status", [Status.MEASURED, Status.HELD])
def test_a_module_that_falls_silent_is_missing_for_that_instant_only(status):
    body = arm(on_joint=True)
    truth = simulate(body, instants(200, 0.5))
    observations = imu_frames(body, truth, gyroscopes=False)
    if status is Status.HELD:
        observations[50].status[1] = Status.HELD
    else:
        observations[50].specific_force[1] = np.nan
    frames = run(body, observations, 200)
    np.testing.assert_array_equal(frames[50].status, [Status.MEASURED] + 3 * [Status.MISSING])
    assert (frames[51].status == Status.MEASURED).all()


def test_silence_longer_than_the_longest_gap_starts_the_warm_up_anew():
    body = arm(on_joint=True)
    truth = simulate(body, instants(100, 1.0))
    observations = imu_frames(body, truth, gyroscopes=False)
    for k in range(30, 60):
        observations[k].specific_force[0] = np.nan
    status = stack(run(body, observations), "status")
    assert (status[30:60] == Status.MISSING).all()
    for rank in range(1, 5):
        first = 60 + 2 * rank - 2
        assert (status[60:first, rank - 1] == Status.WARMING_UP).all()
        assert (status[first:, rank - 1] == Status.MEASURED).all()


@pytest.mark.parametrize("gyroscopes", [False, True])
@pytest.mark.parametrize("on_joint", [True, False])
def test_lost_frames_are_bridged_with_the_true_time_step(on_joint, gyroscopes):
    body = arm(on_joint)
    truth = simulate(body, instants(400, 2.0))
    observations = imu_frames(body, truth, gyroscopes)
    kept = [k for k in range(len(observations)) if k % 50 != 25]  # every 50th step is twice as long
    frames = run(body, [observations[k] for k in kept], 400, starting_pose(truth))
    errors = angular_error_deg(stack(frames, "q_wb"), truth.R[kept])
    whole = angular_error_deg(stack(run(body, observations, 400, starting_pose(truth)), "q_wb"), truth.R)
    loss = np.sqrt(np.nanmean(errors**2, axis=0)) / np.sqrt(np.nanmean(whole**2, axis=0))
    assert loss[:2].max() < 1.6
    assert np.nanmax(errors[:, :2]) < 1.0


@pytest.mark.parametrize("back_ns", [0, 5_000_000, 10**9])
@pytest.mark.parametrize("gyroscopes", [False, True])
def test_time_that_stands_or_goes_back_starts_the_warm_up_anew(gyroscopes, back_ns):
    body = arm(on_joint=True)
    truth = simulate(body, instants(100, 0.6))
    observations = imu_frames(body, truth, gyroscopes)
    late = [replace(f, time_ns=f.time_ns - back_ns - 10_000_000) for f in observations[31:]]
    frames = run(body, observations[:31] + late)
    status, first = stack(frames, "status"), 31
    for rank in range(1, 5):
        defined = first + (min(rank - 1, 1) if gyroscopes else 2 * rank - 2)
        assert (status[first:defined, rank - 1] == Status.WARMING_UP).all()
        assert (status[defined:, rank - 1] == Status.MEASURED).all()


def test_no_reading_of_sensor_x_is_no_value():
    body = arm(on_joint=True)
    truth = simulate(body, instants(100, 0.1))
    observations = imu_frames(body, truth, gyroscopes=True)
    observations[5].magnetic_field[2] = np.nan
    frames = run(body, observations)
    M, ok = Status.MISSING, Status.MEASURED
    np.testing.assert_array_equal(frames[5].status, [ok, ok, M, M])


# --- what it yields --------------------------------------------------------------------------------


@pytest.mark.parametrize("gyroscopes", [False, True])
@pytest.mark.parametrize("on_joint", [True, False])
def test_the_same_frames_after_reset_give_the_same_bits(on_joint, gyroscopes):
    body = swaying(Quantity.POSITION, on_joint)
    truth = simulate(body, instants(100, 0.5))
    observations = imu_frames(body, truth, gyroscopes)
    reconstructor = ArticulatedReconstructor(body.suit(), 0.01, starting_pose=starting_pose(truth))
    once = [reconstructor.update(f) for f in observations]
    reconstructor.reset()
    again = [reconstructor.update(f) for f in observations]
    for name in ("q_wb", "angular_rate", "joint_acceleration", "p_w", "status"):
        assert stack(once, name).tobytes() == stack(again, name).tobytes()


def test_fields_of_the_skeleton_frame():
    body = arm(on_joint=False, lever_arms=ARM_LEVERS)
    truth = simulate(body, instants(400, 1.0))
    observations = imu_frames(body, truth, gyroscopes=True)
    frames = run(body, observations, 400)
    assert [f.sequence for f in frames] == [o.sequence for o in observations]
    assert [f.time_ns for f in frames] == [o.time_ns for o in observations]
    assert np.isnan(stack(frames, "sigma")).all()
    q_wb = stack(frames, "q_wb")[2:]
    assert (q_wb[..., 0] >= 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(q_wb, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_array_equal(stack(frames, "angular_rate")[2:], truth.angular_rate[2:])
    np.testing.assert_allclose(stack(frames, "p_w")[5:], truth.p_w[5:], atol=0.01)


def test_a_frame_does_not_change_when_the_next_one_comes():
    body = arm(on_joint=True)
    truth = simulate(body, instants(100, 0.1))
    reconstructor = ArticulatedReconstructor(body.suit(), 0.01)
    first, *rest = imu_frames(body, truth, gyroscopes=True)
    frame = reconstructor.update(first)
    before = frame.q_wb.copy()
    for imu_frame in rest:
        reconstructor.update(imu_frame)
    np.testing.assert_array_equal(frame.q_wb, before)


def test_free_fall_is_not_an_orientation():
    body = arm(on_joint=True)
    truth = simulate(body, instants(100, 0.05))
    falling = LocalDevice(Quantity.ACCELERATION, 0, np.zeros(3), device=9)
    body = replace(body, local_devices=(falling,))
    truth.point["acceleration"] = np.broadcast_to(GRAVITY, (len(truth.time_ns), 3))
    frames = run(body, imu_frames(body, truth, gyroscopes=True))
    assert (stack(frames, "status") == Status.WARMING_UP).all()
    assert np.isnan(stack(frames, "q_wb")).all()
