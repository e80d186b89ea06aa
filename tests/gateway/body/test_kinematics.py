"""Joint positions against chains added up by hand and by scipy."""

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.body.kinematics import joint_positions


def wxyz(rotations):
    return rotations.as_quat()[:, [3, 0, 1, 2]]


def test_a_stretched_chain_adds_up():
    parents = np.array([-1, 0, 1])
    offsets = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.2, 0.0, 0.1]])
    q_wb = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    p_w = joint_positions(parents, offsets, q_wb, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(p_w, [[1.0, 2.0, 3.0], [1.3, 2.0, 3.0], [1.5, 2.0, 3.1]], atol=1e-15)


def test_a_tree_agrees_with_scipy():
    rng = np.random.default_rng(4)
    parents = np.array([-1, 0, 1, 0, 3, 3])
    offsets = rng.normal(size=(6, 3))
    R = Rotation.random(6, rng=rng)
    p_w = joint_positions(parents, offsets, wxyz(R), np.zeros(3))
    for segment in (4, 5):
        expected = R[0].apply(offsets[3]) + R[3].apply(offsets[segment])
        np.testing.assert_allclose(p_w[segment], expected, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(p_w[2] - p_w[1]), np.linalg.norm(offsets[2]))


def test_nothing_is_known_beyond_an_unknown_orientation():
    parents = np.array([-1, 0, 1, 0])
    q_wb = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    q_wb[1] = np.nan
    p_w = joint_positions(parents, np.ones((4, 3)), q_wb, np.zeros(3))
    np.testing.assert_array_equal(np.isnan(p_w).any(axis=1), [False, False, True, False])
