"""Rotation matrices against scipy, and the two-vector solve against what it promises."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gateway.geometry import rotation_matrix

numbers = st.floats(-3.0, 3.0, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(deadline=None)  # the first call compiles
@given(vectors)
def test_exponential_agrees_with_scipy(r):
    np.testing.assert_allclose(
        rotation_matrix.from_rotation_vector(r), Rotation.from_rotvec(r).as_matrix(), atol=1e-14
    )


@settings(deadline=None)  # the first call compiles
@given(directions, st.floats(1e-9, 3.0), vectors)
def test_increment_is_the_logarithm_of_the_product(axis, angle, start):
    r = angle * axis / np.linalg.norm(axis)
    before = Rotation.from_rotvec(start).as_matrix()
    now = before @ rotation_matrix.from_rotation_vector(r)
    np.testing.assert_allclose(rotation_matrix.increment(before, now), r, atol=1e-14, rtol=1e-13)


def test_increment_of_nothing_is_zero():
    R = Rotation.from_rotvec([0.3, 0.2, -1.0]).as_matrix()
    np.testing.assert_array_equal(rotation_matrix.increment(R, R), np.zeros(3))


@settings(deadline=None)  # the first call compiles
@given(vectors, vectors)
def test_rotating_agrees_with_the_product(r, v):
    R = Rotation.from_rotvec(r).as_matrix()
    np.testing.assert_allclose(rotation_matrix.rotate(R, v), R @ v, atol=1e-14)
    np.testing.assert_allclose(rotation_matrix.rotate_inverse(R, v), R.T @ v, atol=1e-14)
    np.testing.assert_allclose(rotation_matrix.multiply(R, R), R @ R, atol=1e-14)


@settings(deadline=None)  # the first call compiles
@given(vectors, directions, directions)
def test_two_vectors_give_the_rotation_back(r, primary, secondary):
    sine = np.linalg.norm(np.cross(primary, secondary)) / np.linalg.norm(primary) / np.linalg.norm(secondary)
    R = Rotation.from_rotvec(r).as_matrix()
    found = rotation_matrix.from_two_vectors(R.T @ primary, R.T @ secondary, primary, secondary)
    if sine > 2e-3:
        np.testing.assert_allclose(found, R, atol=1e-11)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    elif sine < 5e-4:
        assert np.isnan(found).all()


def test_the_primary_vector_is_met_exactly_when_the_two_disagree():
    up, north = np.array([0.0, 0.0, 9.81]), np.array([0.0, 20.0, -40.0])
    f, x = np.array([0.4, -1.0, 9.0]), np.array([3.0, 25.0, -35.0])
    R = rotation_matrix.from_two_vectors(f, x, up, north)
    np.testing.assert_allclose(R @ f / np.linalg.norm(f), [0.0, 0.0, 1.0], atol=1e-15)
    assert (R @ x)[0] == pytest.approx(0.0, abs=1e-13)  # no part of the field to the east is left
    assert (R @ x)[1] > 0.0


@pytest.mark.parametrize("f", [np.zeros(3), np.array([np.nan, 0.0, 1.0])])
def test_nothing_to_stand_on_is_nan(f):
    x = np.array([0.0, 1.0, -2.0])
    assert np.isnan(rotation_matrix.from_two_vectors(f, x, np.array([0.0, 0.0, 9.81]), x)).all()
