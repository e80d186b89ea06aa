"""Ellipsoid fits against known distortions, within the uncertainty they claim."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.calibration.coverage import CELLS, DIRECTIONS, coverage, evenly, missing_sides
from gateway.calibration.ellipsoid import Shape, fit_ellipsoid

STRENGTH = 49.0


def sphere(n, rng):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def distorted(seed, n=400, noise=0.3, hard=30.0, soft=0.15):
    """Readings, the matrix that would undo them up to a rotation, and the bias."""
    rng = np.random.default_rng(seed)
    distortion = np.eye(3) + soft * rng.uniform(-1, 1, (3, 3))
    bias = hard * rng.uniform(-1, 1, 3)
    readings = STRENGTH * sphere(n, rng) @ distortion.T + bias + noise * rng.normal(size=(n, 3))
    return readings, distortion, bias


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_hard_and_soft_iron_are_found_within_the_claimed_uncertainty(seed):
    readings, distortion, bias = distorted(seed)
    fit = fit_ellipsoid(readings, STRENGTH)
    assert (np.abs(fit.bias - bias) < 5 * fit.bias_sigma).all()
    assert fit.bias_sigma.max() < 0.2
    # what the correction makes of the distortion is a rotation
    left = fit.matrix @ distortion
    np.testing.assert_allclose(left @ left.T, np.eye(3), atol=0.01)
    np.testing.assert_allclose(fit.matrix, fit.matrix.T)
    assert fit.spread_after < 0.012
    assert fit.spread_after < 0.2 * fit.spread_before


def test_without_noise_it_is_exact():
    readings, distortion, bias = distorted(5, noise=0.0)
    fit = fit_ellipsoid(readings, STRENGTH)
    np.testing.assert_allclose(fit.bias, bias, atol=1e-6)
    left = fit.matrix @ distortion
    np.testing.assert_allclose(left @ left.T, np.eye(3), atol=1e-7)


def test_outliers_weigh_little():
    readings, _, bias = distorted(7)
    readings[:20] += 40.0
    fit = fit_ellipsoid(readings, STRENGTH)
    assert np.abs(fit.bias - bias).max() < 0.5


def test_triangular_matrix_undoes_scales_and_skewed_axes_exactly():
    rng = np.random.default_rng(1)
    true = np.triu(np.eye(3) + 0.05 * rng.uniform(-1, 1, (3, 3)))
    bias = np.array([0.2, -0.3, 0.1])
    readings = 9.81 * sphere(14, rng) @ np.linalg.inv(true).T + bias
    fit = fit_ellipsoid(readings, 9.81, Shape.TRIANGULAR)
    np.testing.assert_allclose(fit.matrix, true, atol=1e-7)
    np.testing.assert_allclose(fit.bias, bias, atol=1e-6)


def test_few_parameters_for_few_readings():
    rng = np.random.default_rng(2)
    readings = np.vstack([np.eye(3), -np.eye(3), sphere(1, rng)]) * 9.81 * [1.02, 0.99, 1.0] + [
        0.1,
        0.2,
        -0.1,
    ]
    fit = fit_ellipsoid(readings, 9.81, Shape.DIAGONAL)
    np.testing.assert_allclose(fit.bias, [0.1, 0.2, -0.1], atol=1e-3)
    with pytest.raises(ValueError, match="7 readings cannot give 9 parameters"):
        fit_ellipsoid(readings, 9.81, Shape.TRIANGULAR)


@pytest.mark.parametrize("readings", [np.zeros((50, 3)), np.tile([10.0, 20, 30], (50, 1))])
def test_no_variation_is_refused(readings):
    with pytest.raises(ValueError, match="all readings are the same"):
        fit_ellipsoid(readings, STRENGTH)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(["plane", "arc", "cap"]))
def test_poor_data_never_give_anything_but_numbers(seed, kind):
    rng = np.random.default_rng(seed)
    v = sphere(60, rng)
    bad = {"plane": v * [1, 1, 0], "arc": np.abs(v) * [1, 1, 0.01], "cap": v + np.array([0, 0, 5.0])}
    v = bad[kind] * STRENGTH
    fit = fit_ellipsoid(v, STRENGTH, Shape.SCALE)
    assert np.isfinite(fit.matrix).all()
    assert np.isfinite(fit.bias).all()


def test_coverage_counts_equal_cells():
    rng = np.random.default_rng(0)
    assert coverage(np.zeros((0, 3))) == 0.0
    assert coverage(DIRECTIONS) == 1.0
    assert coverage(sphere(5000, rng)) == 1.0
    v = sphere(5000, rng)
    assert coverage(v[v[:, 2] > 0]) == pytest.approx(0.5, abs=0.12)
    counts = np.bincount(np.argmax(sphere(60_000, rng) @ DIRECTIONS.T, axis=1), minlength=CELLS)
    assert counts.max() < 1.5 * counts.mean()


def test_missing_sides_are_named():
    v = sphere(2000, np.random.default_rng(0))
    assert missing_sides(v) == []
    assert missing_sides(v[v[:, 2] > 0.2]) == ["-z"]
    assert missing_sides(np.zeros((0, 3))) == ["+x", "-x", "+y", "-y", "+z", "-z"]


def test_a_long_rest_does_not_outweigh_the_rest():
    v = sphere(500, np.random.default_rng(0))
    rest = np.tile([0.0, 0.0, 1.0], (5000, 1))
    kept = evenly(np.vstack([rest, v]), np.zeros(3), most=10)
    assert (np.abs(kept - [0, 0, 1]).max(axis=1) < 1e-9).sum() <= 10
    assert coverage(kept) == 1.0
