"""The filter's parts against independent truth: dense algebra, finite differences, calculus."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.geometry.records import record, records
from gateway.geometry.rotation_matrix import from_rotation_vector
from gateway.reconstruction.inertial.tree import prediction
from gateway.reconstruction.inertial.tree import update as tree_update
from gateway.reconstruction.inertial.tree.devices import derivative_weights
from gateway.reconstruction.inertial.tree.lever_arms import is_due, learn_joint_arms, learn_rows
from gateway.reconstruction.inertial.tree.state import (
    PHASES,
    Evidence,
    Joint,
    Learning,
    Link,
    SegmentWork,
    initial_state,
    work_space,
)
from gateway.reconstruction.inertial.tree.tuning import tuning

PARENTS = np.array([-1, 0, 1, 1, -1, 4])


def random_tree(rng):
    """A dense Gaussian that is Markov on PARENTS; its blocks P and C."""
    n = len(PARENTS)
    dense = np.zeros((6 * n, 6 * n))
    for s, p in enumerate(PARENTS):
        A, B = 0.3 * rng.standard_normal((2, 6, 6))
        block = slice(6 * s, 6 * s + 6)
        noise = B @ B.T + 0.2 * np.eye(6)
        if p >= 0:
            parent = slice(6 * p, 6 * p + 6)
            dense[block, : 6 * s] = A @ dense[parent, : 6 * s]
            dense[: 6 * s, block] = dense[block, : 6 * s].T
            noise = noise + A @ dense[parent, parent] @ A.T
        dense[block, block] = noise
    return dense, *blocks(dense)


def filtered(parents, P, C):
    """Links, segments of these covariances, and work space without evidence."""
    n = len(parents)
    links, segments, work = records(Link, n), initial_state(n, 0).segments, work_space(n)
    links["parent"], segments["P"], segments["C"] = parents, P, C
    return links, segments, work


def blocks(dense):
    n = len(PARENTS)
    P = np.array([dense[6 * s : 6 * s + 6, 6 * s : 6 * s + 6] for s in range(n)])
    C = np.zeros((n, 6, 6))
    for s, p in enumerate(PARENTS):
        if p >= 0:
            C[s] = dense[6 * s : 6 * s + 6, 6 * p : 6 * p + 6]
    return P, C


@pytest.mark.parametrize("seed", range(5))
def test_two_sweeps_equal_the_dense_update(seed):
    rng = np.random.default_rng(seed)
    n = len(PARENTS)
    dense, P, C = random_tree(rng)
    tree, rows, residuals, variances = filtered(PARENTS, P, C), [], [], []
    _, segments, work = tree
    for s, p in enumerate(PARENTS):
        for _ in range(3):
            row, row_p, residual, variance = (
                *rng.standard_normal((2, 3)),
                rng.standard_normal(),
                rng.uniform(0.1, 2),
            )
            full = np.zeros(6 * n)
            full[6 * s : 6 * s + 3] = row
            if p >= 0:
                full[6 * p : 6 * p + 3] = row_p
                tree_update.add_edge(work.segments[s].evidence, row, row_p, residual, variance)
            else:
                tree_update.add_own(work.segments[s].evidence, row, residual, variance)
            rows.append(full)
            residuals.append(residual)
            variances.append(variance)
    H, R = np.array(rows), np.diag(variances)
    gain = dense @ H.T @ np.linalg.inv(H @ dense @ H.T + R)
    after = dense - gain @ H @ dense
    tree_update.update_tree(*tree)
    np.testing.assert_allclose(work.segments["x"].ravel(), gain @ residuals, atol=1e-10)
    P_after, C_after = blocks(after)
    np.testing.assert_allclose(segments["P"], P_after, atol=1e-10)
    np.testing.assert_allclose(segments["C"], C_after, atol=1e-10)


def test_without_evidence_nothing_changes():
    _, P, C = random_tree(np.random.default_rng(1))
    links, segments, work = filtered(PARENTS, P, C)
    tree_update.update_tree(links, segments, work)
    np.testing.assert_array_equal(work.segments["x"], 0.0)
    np.testing.assert_allclose(segments["P"], P, atol=1e-12)
    np.testing.assert_allclose(segments["C"], C, atol=1e-12)


def cross_matrix(a):
    return np.cross(a, np.eye(3)).T


@pytest.mark.parametrize("seed", range(3))
def test_a_vector_row_is_its_three_scalar_rows(seed):
    m, residual, other = np.random.default_rng(seed).standard_normal((3, 3))
    whole, rows = record(Evidence), record(Evidence)
    tree_update.add_joint(whole, m, residual, 0.3)
    tree_update.add_known(whole, m, other, 0.7)
    for i, H in enumerate(cross_matrix(m)):
        tree_update.add_edge(rows, H, -H, residual[i], 0.3)
        tree_update.add_own(rows, H, other[i], 0.7)
    for name in rows.dtype.names:
        np.testing.assert_allclose(getattr(whole, name), getattr(rows, name), atol=1e-14, err_msg=name)


@pytest.mark.parametrize("size", [3, 6])
def test_inverse_of_ill_conditioned_blocks(size):
    """A heading unknown to 1.6 rad beside tilts known to a milliradian and biases to 1e-4 rad/s."""
    rng = np.random.default_rng(5)
    scale = np.diag([1e-3, 1e-3, 1.6, 1e-4, 1e-4, 1e-3][:size])
    A = scale @ (np.eye(size) + 0.3 * (B := rng.standard_normal((size, size))) @ B.T) @ scale
    M = np.empty_like(A)
    (tree_update.inverse_into if size == 6 else tree_update.inverse_3_into)(M, A)
    np.testing.assert_array_equal(M, M.T)
    unscaled = np.linalg.inv(scale)
    np.testing.assert_allclose(scale @ M @ scale @ unscaled @ A @ unscaled, np.eye(size), atol=1e-12)


def test_evidence_of_three_states_is_taken_as_by_inverting_the_whole_block():
    """Of an open heading, a tilt known well, and a row that says nothing about one direction."""
    rng, n = np.random.default_rng(6), len(PARENTS)
    _, P, C = random_tree(rng)
    P[0] = np.diag([1e-4, 1e-4, 2.56, 1e-8, 1e-8, 1e-8])
    links, segments, work = filtered(PARENTS, P, C)
    for s in range(n):
        evidence = work.segments[s].evidence
        tree_update.add_known(evidence, rng.standard_normal(3), rng.standard_normal(3), 0.01)
        if s % 2:
            evidence.own[3:, 3:] += 50.0 * np.eye(3)
            evidence.own_vector[3:] += rng.standard_normal(3)
    expected = np.linalg.inv(np.linalg.inv(P) + work.segments["evidence"]["own"])
    vectors = work.segments["evidence"]["own_vector"].copy()
    tree_update.update_outward(links, segments, work)
    np.testing.assert_allclose(segments["P"], expected, atol=1e-9)
    np.testing.assert_allclose(work.segments["x"], np.einsum("sij,sj->si", expected, vectors), atol=1e-8)


def test_outward_a_child_learns_what_its_edge_tells_with_the_parent_integrated_out():
    """Against the dense update of the two, whose errors are independent to this filter."""
    rng = np.random.default_rng(7)
    _, P, C = random_tree(rng)
    P = P[:2]
    rows, residuals = rng.standard_normal((3, 2, 3)), rng.standard_normal(3)
    links, segments, work = filtered(PARENTS[:2], P, C[:2])
    H = np.zeros((3, 12))
    for k in range(3):
        tree_update.add_edge(work.segments[1].evidence, rows[k, 0], rows[k, 1], residuals[k], 0.5)
        H[k, 6:9], H[k, :3] = rows[k]
    dense = np.zeros((12, 12))
    dense[:6, :6], dense[6:, 6:] = P
    gain = dense @ H.T @ np.linalg.inv(H @ dense @ H.T + 0.5 * np.eye(3))
    after, x = dense - gain @ H @ dense, gain @ residuals
    tree_update.update_outward(links, segments, work)
    np.testing.assert_allclose(segments[1].P, after[6:, 6:], atol=1e-10)
    np.testing.assert_allclose(work.segments[1].x, x[6:], atol=1e-10)
    np.testing.assert_array_equal(work.segments[0].x, 0.0)


def test_propagation_is_that_of_the_turning_error():
    """Against finite differences of the world error δ of R exp((ω − b) Δt) with respect to δ and b."""
    rng = np.random.default_rng(2)
    R, w, dt = Rotation.random(random_state=3), rng.standard_normal(3), 0.01

    def error_after(delta, bias):
        true = Rotation.from_rotvec(delta) * R * Rotation.from_rotvec((w - bias) * dt)
        return (true * (R * Rotation.from_rotvec(w * dt)).inv()).as_rotvec()

    step = 1e-6
    F = np.eye(6)
    for i, e in enumerate(step * np.eye(3)):
        F[:3, i] = error_after(e, np.zeros(3)) / step
        F[:3, 3 + i] = error_after(np.zeros(3), e) / step
    A = rng.standard_normal((6, 6))
    P = A @ A.T
    expected = F @ P @ F.T
    own = P.copy()
    prediction.propagate(P, R.as_matrix(), R.as_matrix(), dt)
    np.testing.assert_allclose(P, expected, atol=2e-3 * dt * 100)
    prediction.propagate_own(own, R.as_matrix(), dt)
    np.testing.assert_allclose(own, P, atol=1e-13)
    np.testing.assert_array_equal(own, own.T)


@pytest.mark.parametrize("surprise", [0.1, 30.0])
def test_three_rows_at_once_are_three_scalar_updates(surprise):
    """Against Joseph's form, one row after another; a surprising row counts less."""
    rng = np.random.default_rng(6)
    A, learning = rng.standard_normal((6, 6)), record(Learning)
    P, x, rows = A @ A.T, np.zeros(6), rng.standard_normal((3, 6))
    residual, off = tuple(surprise * rng.standard_normal(3)), (0.1, 0.2, 0.3)
    variance, at_once, huber, memory = 2.0, 0.5, 2.0, 100.0
    found = P.copy()
    learning.rows[...], learning.residual[...], learning.off[...] = rows, residual, off
    learning.variance, learning.at_once, learning.memory = variance, at_once, memory
    added = learn_rows(found, learning, huber)
    assert added == pytest.approx(np.trace(rows @ P @ rows.T) / 3.0)
    for row, seen, spread in zip(rows, residual, off, strict=True):
        innovation, uncertain = seen - row @ x, row @ P @ row
        deviations = abs(innovation) / np.sqrt(at_once + spread + uncertain)
        white = (variance + spread * memory) * max(1.0, deviations / huber)
        gain = P @ row / (uncertain + white)
        x = x + gain * innovation
        left = np.eye(6) - np.outer(gain, row)
        P = left @ P @ left.T + white * np.outer(gain, gain)
    np.testing.assert_allclose(learning.change, x, atol=1e-12)
    np.testing.assert_allclose(found, P, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)


def test_joints_are_asked_about_their_arms_in_turn():
    """At 100 Hz every third frame; what their uncertainty adds to a row is told in every frame."""
    segments, learning, constants = initial_state(6, 0).segments, record(Learning), tuning()
    segments["arms"]["covariance"] = constants.lever_arm_offset**2 * np.eye(6)
    now, links = records(SegmentWork, 6), records(Link, 6)
    links["phase"] = np.arange(6) % PHASES
    now["K"], learning.at_once = 20.0 * np.eye(3), 0.04
    asked = np.zeros((30, 6), bool)
    for frame in range(30):
        for s in range(1, 6):
            now["u"] = now["u_parent"] = [0.0, 0.0, 10.0]
            asked[frame, s] = is_due(segments[s], constants, 0.01)
            if asked[frame, s]:
                before = segments[s].arms.covariance.copy()
                joint = Joint(links[s], segments[s], segments[0], now[s], now[0])
                learn_joint_arms(joint, learning, constants, 0.01)
                assert (segments[s].arms.covariance != before).any()
            assert segments[s].arms.row_variance > 0.0
    assert asked[0, 1:].all()
    assert asked[1:].sum(axis=1).max() <= 2
    assert asked[:, 1:].sum(axis=0) == pytest.approx(10, abs=1)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.1, 0.4999, 0.5001, 3.0])
def test_small_and_large_turns_have_all_digits(angle):
    r = angle * np.array([0.6, -0.48, 0.64])
    wanted = Rotation.from_rotvec(r).as_matrix()
    np.testing.assert_allclose(from_rotation_vector(r), wanted, rtol=0.0, atol=4e-16)


@pytest.mark.parametrize("angle", [0.01, 0.5, 1.5, 2.5])
def test_a_segment_is_turned_by_the_very_angle_that_a_joint_has_shown(angle):
    """Of u = E⁻¹ y a row about the mean of both shows 2 tan(θ/2) times the axis, however large θ is."""
    turn = angle * np.array([0.48, -0.6, 0.64])
    sides = [Rotation.from_rotvec(-turn).apply(y) for y in np.eye(3)]
    rows = np.concatenate([0.5 * np.cross(u + y, np.eye(3)).T for u, y in zip(sides, np.eye(3), strict=True)])
    residual = np.concatenate([u - y for u, y in zip(sides, np.eye(3), strict=True)])
    state, work = initial_state(1, 0), work_space(1)
    work.segments[0].x[:3] = np.linalg.lstsq(rows, residual, rcond=None)[0]
    prediction.correct(state, work)
    np.testing.assert_allclose(work.segments[0].turn, turn, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_weights_differentiate_polynomials_exactly_at_uneven_times(order):
    t = np.sort(np.random.default_rng(4).uniform(0.0, 0.2, 8))
    weights = derivative_weights(t, order)
    for power in range(order + 1):
        wanted = {1: [0.0, 1.0], 2: [0.0, 0.0, 2.0]}[order][power]
        assert weights @ t**power == pytest.approx(wanted, abs=1e-8)
