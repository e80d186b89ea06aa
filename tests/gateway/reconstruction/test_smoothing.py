"""Forward and backward through a recording: better than forward, the same however it is cut into blocks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_body import angular_error_deg, arm, imu_frames, instants, simulate

from gateway.errors import GatewayError
from gateway.frames import ImuFrame, LocalReading, Quantity, Status
from gateway.reconstruction import create_reconstructor, smoothing, update_many
from gateway.reconstruction.inertial.tree.smoothing import put_together, seen_backward, turned_back
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.smoothing import Smoother

RATE_HZ = 100
GRAVITY = np.array([0.0, 0.0, -9.81])


def quaternions(*rotation_vectors):
    return Rotation.from_rotvec(rotation_vectors).as_quat(scalar_first=True, canonical=True)


def test_two_orientations_are_put_together_by_their_covariances():
    q_wb = quaternions([0.2, 0.0, 0.0])[None]
    q_back = quaternions([0.2, 0.0, 0.3])[None]
    wide, sigma = np.diag([1e-4, 1e-4, 0.02]), np.full((1, 1), 0.2)
    sigma_back = np.full((1, 1), 0.1)
    published, published_back = np.diag([1e-3, 2e-3, 0.05]), np.diag([3e-3, 1e-3, 0.005])
    P = np.array([[[wide, published]]])
    put_together(q_wb, P, sigma, q_back, np.array([[[wide / 2.0, published_back]]]), sigma_back)
    turned = Rotation.from_quat(q_wb[0, 0], scalar_first=True)
    difference = turned * Rotation.from_rotvec([0.2, 0.0, 0.0]).inv()
    full = Rotation.from_quat(q_back[0, 0], scalar_first=True) * Rotation.from_rotvec([0.2, 0, 0]).inv()
    # twice as sure: two thirds of the way, about the one axis that is uncertain
    np.testing.assert_allclose(difference.as_rotvec(), full.as_rotvec() * 2.0 / 3.0, atol=1e-12)
    # the claims likewise
    np.testing.assert_allclose(P[0, 0, 1], np.diag([7e-3, 4e-3, 0.06]) / 3.0)
    assert sigma[0, 0] == pytest.approx(np.sqrt(0.071 / 3.0))


@pytest.mark.parametrize("known", ["forward", "backward"])
def test_where_only_one_knows_it_counts(known):
    q_wb, q_back = quaternions([0.1, 0.2, 0.3])[None], quaternions([0.1, 0.2, 0.3])[None]
    expected = q_wb.copy()
    (q_back if known == "forward" else q_wb)[:] = np.nan
    P, sigma = np.tile(0.01 * np.eye(3), (1, 1, 2, 1, 1)), np.full((1, 1), np.sqrt(0.03))
    put_together(q_wb, P, sigma, q_back, P, sigma.copy())
    np.testing.assert_array_equal(q_wb, expected)
    assert sigma[0, 0] == pytest.approx(np.sqrt(0.03))


def frame(time_ns, *local):
    ones, none = np.ones((1, 3)), np.zeros(1, np.int64)
    return ImuFrame(0, time_ns, ones, 2.0 * ones, ones, none.astype(np.uint8), none, tuple(local))


def reading(time_ns, quantity):
    return LocalReading(60, time_ns, quantity, np.ones(3), 0.1 * np.ones(3))


def test_a_motion_seen_backward_turns_rates_and_velocities_and_waits_for_readings():
    late = reading(15, Quantity.VELOCITY)
    frames = [frame(10), frame(20, reading(5, Quantity.POSITION)), frame(30, late)]
    turned, left = seen_backward(frames, 30, [reading(28, Quantity.POSITION)])
    assert [f.time_ns for f in turned] == [0, 10, 20]
    assert all((f.angular_rate == -2.0).all() and (f.specific_force == 1.0).all() for f in turned)
    # each in the first frame that is not before it, going backward
    assert [[r.time_ns for r in f.local] for f in turned] == [[], [2], [15]]
    np.testing.assert_array_equal(turned[2].local[0].value, -np.ones(3))
    np.testing.assert_array_equal(turned[1].local[0].value, np.ones(3))
    assert [r.time_ns for r in left] == [5]


def test_turning_a_state_back_twice_keeps_what_it_knows():
    state, rng = initial_state(3, 1), np.random.default_rng(1)
    for records, name in known_of(state):
        records[name] = rng.normal(size=records[name].shape)
    back = turned_back(state, tuning(), GRAVITY, is_tree=False)
    again = turned_back(back, tuning(), GRAVITY, is_tree=False)
    for (records, name), (records_again, _) in zip(known_of(state), known_of(again), strict=True):
        np.testing.assert_array_equal(records_again[name], records[name])


def known_of(state):
    """Some of what stays: records and the names in them."""
    segments = state.segments
    watch = [(segments["field_watch"], name) for name in ("norm", "dip", "error_square")]
    own = [(segments, name) for name in ("bias", "force_bias", "C")]
    return [*own, *watch, (segments["arms"], "error"), (state.devices, "shift")]


def test_the_last_frame_is_not_taken_twice():
    state = initial_state(2, 1)
    state.clock.last_ns, state.clock.first_ns = 7_000_000_000, 1_000_000_000
    rest = state.segments["zero_rate"]
    rest["rate"], rest["force"], rest["still_s"] = [0.0, 1.0, 2.0], [3.0, 4.0, 5.0], 8.0
    back = turned_back(state, tuning(), GRAVITY, is_tree=True)
    (last, _), _ = seen_backward([frame(10), frame(20)], 20, [])
    assert last.time_ns == 0 == back.clock.last_ns
    kept = back.segments[0].zero_rate
    np.testing.assert_array_equal(kept.rate, [-0.0, -1.0, -2.0])
    np.testing.assert_array_equal(kept.force, [3.0, 4.0, 5.0])
    assert kept.still_s == 8.0


def test_the_way_back_knows_that_it_begins_in_motion():
    state = initial_state(2, 0)
    still, moving = state.segments[0], state.segments[1]
    still.averages.last_force[:] = 0.0, 0.0, 9.81
    moving.averages.last_force[:] = 6.0, 0.0, 12.0
    moving.rate[:] = 0.0, 5.0, 0.0
    back = turned_back(state, tuning(), GRAVITY, is_tree=True)
    usual = tuning().unaided_speed ** 2
    assert back.segments[0].velocity.square == usual
    assert back.segments[1].velocity.square > 2.0 * usual


def test_the_way_back_keeps_relative_headings_and_what_compasses_have_seen():
    state, rng = initial_state(2, 0), np.random.default_rng(2)
    segments, compasses = state.segments, state.segments["compass"]
    segments["P"][:] = np.diag([0.01, 0.01, 0.2, 0.0, 0.0, 0.0])
    segments["C"][1, 2, 2] = 0.18
    for name in ("angle", "variance", "settled_s", "error"):
        compasses[name] = rng.uniform(size=2)
    back = turned_back(state, tuning(), GRAVITY, is_tree=True).segments
    P, C = back["P"][:, 2, 2], back["C"][1, 2, 2]
    assert P[0] + P[1] - 2.0 * C == pytest.approx(0.04)
    np.testing.assert_allclose(P, 0.2 + tuning().start_heading ** 2)
    for name in ("angle", "variance", "settled_s", "error"):
        np.testing.assert_array_equal(back["compass"][name], compasses[name])
    # ``outward`` knows of nothing that two segments have in common
    segments["C"] = 0.0
    assert not turned_back(state, tuning(), GRAVITY, is_tree=False).segments["C"].any()


def test_a_method_that_cannot_go_backward_says_so(tmp_path):
    reconstructor = create_reconstructor("independent", arm(on_joint=False).suit(), 0.01)
    with pytest.raises(GatewayError, match="smoothing is for the methods joint and outward"):
        Smoother(reconstructor, tmp_path)


class TestSmoothing:
    @pytest.fixture(scope="class")
    @staticmethod
    def moving():
        """An arm with noise, biases and a module that is silent for half a second."""
        body = arm(on_joint=False)
        truth = simulate(body, instants(RATE_HZ, 12.0))
        rng, frames = np.random.default_rng(1), imu_frames(body, truth, gyroscopes=True)
        bias = rng.normal(0.0, 0.005, frames[0].angular_rate.shape)
        noisy = [
            replace(
                f,
                specific_force=f.specific_force + rng.normal(0.0, 0.1, f.specific_force.shape),
                angular_rate=f.angular_rate + bias + rng.normal(0.0, 0.01, f.angular_rate.shape),
            )
            for f in frames
        ]
        for k in range(600, 650):
            status = noisy[k].status.copy()
            status[1] = Status.MISSING
            rate = noisy[k].angular_rate.copy()
            rate[1] = np.nan
            noisy[k] = replace(noisy[k], status=status, angular_rate=rate)
        return body, truth, noisy

    def solved(self, body, frames, folder):
        folder.mkdir()
        smoother = Smoother(create_reconstructor("joint", body.suit(), 1.0 / RATE_HZ), folder)
        for k in range(0, len(frames), 100):
            smoother.add(frames[k : k + 100])
        return list(smoother.smoothed())

    def test_it_is_nearer_to_the_truth_than_the_filter(self, moving, tmp_path):
        body, truth, frames = moving
        smoothed = self.solved(body, frames, tmp_path / "s")
        forward = update_many(create_reconstructor("joint", body.suit(), 1.0 / RATE_HZ), frames)
        error, live = (
            angular_error_deg(np.stack([frame.q_wb for frame in way]), truth.R) for way in (smoothed, forward)
        )
        assert np.sqrt(np.mean(error**2)) < 0.8 * np.sqrt(np.mean(live**2))
        silent = slice(600, 650)
        assert error[silent, 1].max() < 0.6 * live[silent, 1].max()
        assert smoothed[620].status[1] == Status.PREDICTED
        claimed, of_filter = (np.stack([frame.sigma for frame in way]) for way in (smoothed, forward))
        lasting = np.sqrt(2.0) * tuning().force_bias / np.linalg.norm(GRAVITY)
        # weighed by their inverses two variances become at most twice the smaller one
        assert (claimed <= np.sqrt(2.0) * of_filter).all()
        assert claimed.mean() < 0.9 * of_filter.mean()
        assert (claimed > lasting).all()

    def test_how_it_is_cut_into_blocks_changes_no_bit(self, moving, tmp_path, monkeypatch):
        body, _, frames = moving
        whole = self.solved(body, frames, tmp_path / "a")
        monkeypatch.setattr(smoothing, "FRAMES_A_BLOCK", 170)
        cut = self.solved(body, frames, tmp_path / "b")
        assert len(list((tmp_path / "b").iterdir())) == -(-len(frames) // 170)
        for a, b in zip(whole, cut, strict=True):
            for name in ("q_wb", "angular_rate", "joint_acceleration", "sigma", "p_w", "status"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
