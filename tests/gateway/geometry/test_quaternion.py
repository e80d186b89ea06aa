"""Quaternions against their axioms and against scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gateway.geometry import quaternion as quat

components = st.floats(-1.0, 1.0, allow_subnormal=False)
quaternions = (
    st.tuples(components, components, components, components)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
vectors = st.tuples(*3 * [st.floats(-20.0, 20.0, allow_subnormal=False)]).map(np.array)


def reference(q):
    return Rotation.from_quat(q[[1, 2, 3, 0]])


def same_rotation(a, b):
    return np.isclose(abs(a @ b), 1.0, atol=1e-12)


@settings(deadline=None)  # the first call compiles
@given(quaternions, quaternions, vectors)
def test_products_and_rotations_agree_with_scipy(a, b, v):
    np.testing.assert_allclose(
        quat.to_matrix(quat.multiply(a, b)), (reference(a) * reference(b)).as_matrix(), atol=1e-13
    )
    np.testing.assert_allclose(quat.rotate(a, v), reference(a).apply(v), atol=1e-12)
    np.testing.assert_allclose(quat.to_matrix(a) @ v, quat.rotate(a, v), atol=1e-12)


@settings(deadline=None)  # the first call compiles
@given(quaternions, quaternions, quaternions)
def test_multiplication_is_associative_and_conjugate_its_inverse(a, b, c):
    left, right = quat.multiply(quat.multiply(a, b), c), quat.multiply(a, quat.multiply(b, c))
    np.testing.assert_allclose(left, right, atol=1e-14)
    np.testing.assert_allclose(quat.multiply(a, quat.conjugate(a)), [1, 0, 0, 0], atol=1e-14)


@settings(deadline=None)  # the first call compiles
@given(quaternions, vectors)
def test_rotating_back_gives_the_vector(q, v):
    np.testing.assert_allclose(quat.rotate_inverse(q, quat.rotate(q, v)), v, atol=1e-12)


@settings(deadline=None)  # the first call compiles
@given(quaternions)
def test_matrix_and_logarithm_lead_back(q):
    assert same_rotation(quat.from_matrix(quat.to_matrix(q)), q)
    assert same_rotation(quat.from_rotation_vector(quat.to_rotation_vector(q)), q)
    assert np.linalg.norm(quat.to_rotation_vector(q)) <= np.pi + 1e-12


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 1.0, 3.1])
def test_logarithm_keeps_all_digits_at_small_angles(angle):
    r = angle * np.array([0.6, -0.64, 0.48])
    np.testing.assert_allclose(quat.to_rotation_vector(quat.from_rotation_vector(r)), r, rtol=1e-14)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.6, 0.8], [0.6, -0.8, 0]])
def test_half_turns_survive_the_matrix(axis):
    q = np.array([0.0, *axis], float)
    assert same_rotation(quat.from_matrix(quat.to_matrix(q)), q)


@settings(deadline=None)  # the first call compiles
@given(quaternions)
def test_canonical_has_no_negative_scalar_part(q):
    assert quat.canonical(q)[0] >= 0.0
    assert quat.canonical(-q)[0] >= 0.0
    assert same_rotation(quat.canonical(q), q)


@settings(deadline=None)  # the first call compiles
@given(quaternions, quaternions)
def test_angle_between_agrees_with_scipy(a, b):
    expected = (reference(a).inv() * reference(b)).magnitude()
    assert quat.angle_between(a, b) == pytest.approx(expected, abs=1e-7)
    assert quat.angle_between(a, -b) == pytest.approx(expected, abs=1e-7)


@settings(deadline=None)  # the first call compiles
@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_slerp_divides_the_angle(a, b, fraction):
    whole = quat.angle_between(a, b)
    between = quat.slerp(a, b, fraction)
    if whole < 3.0:  # at a half turn there is no short way
        assert quat.angle_between(a, between) == pytest.approx(fraction * whole, abs=1e-7)
        assert quat.angle_between(between, b) == pytest.approx((1.0 - fraction) * whole, abs=1e-7)


def test_arguments_are_not_changed():
    q, v = np.array([-0.5, 0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0])
    for result in (quat.canonical(q), quat.normalise(q), quat.rotate(q, v), quat.multiply(q, q)):
        assert not np.shares_memory(result, q)
    np.testing.assert_array_equal(q, [-0.5, 0.5, 0.5, 0.5])
    np.testing.assert_array_equal(v, [1.0, 2.0, 3.0])
