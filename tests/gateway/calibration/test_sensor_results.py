"""Gyroscope, accelerometer and magnetometer results: right numbers, and right reasons when poor."""

import numpy as np
import pytest

from gateway.calibration.quality import QualityAspect, graded, judged
from gateway.calibration.rest import RestDetector
from gateway.calibration.sensors import (
    accelerometer_ellipsoid,
    gyroscope_bias,
    magnetometer_ellipsoid,
    rest_positions,
    six_positions,
)

GRAVITY = 9.81
RATE_HZ = 100
BIAS = np.radians([0.8, -1.2, 0.3])


def fed(*parts, seed=0):
    """A detector that saw parts (seconds, force, rate), with a consumer sensor's noise."""
    rng = np.random.default_rng(seed)
    detector, time_ns = RestDetector(), 0
    for seconds, force, rate in parts:
        for _ in range(round(seconds * RATE_HZ)):
            f = np.asarray(force) + 0.05 * rng.normal(size=3)
            w = np.asarray(rate) + np.radians(0.1) * rng.normal(size=3)
            detector.add(time_ns, tuple(f.tolist()), tuple(w.tolist()))
            time_ns += 10_000_000
    return detector.stretches


UP = np.array([0, 0, GRAVITY])


def test_gyroscope_bias_at_rest():
    result = gyroscope_bias(fed((5, UP, BIAS)))
    np.testing.assert_allclose(result.bias, BIAS, atol=np.radians(0.03))
    assert result.quality.verdict == "good"
    assert result.quality.reasons == ()


def test_a_steady_rotation_is_no_bias():
    with pytest.raises(ValueError, match="never lay still"):
        gyroscope_bias(fed((5, UP, np.radians([0, 0, 60]))))


def test_a_module_moved_during_rest_never_scores_good():
    moved = [(2, UP, BIAS), (2, UP, BIAS + np.radians([1.2, 0, 0])), (2, UP, BIAS)]
    result = gyroscope_bias(fed(*moved))
    assert result.quality.verdict != "good"
    assert "it was moved" in " ".join(result.quality.reasons)


def test_a_short_rest_says_so():
    result = gyroscope_bias(fed((1.4, UP, BIAS)))
    assert result.quality.verdict != "good"
    assert "leave it untouched" in result.quality.reasons[0]


@pytest.mark.parametrize("shake", [0.5, 2.0])
def test_shaking_is_not_rest(shake):
    rng = np.random.default_rng(0)
    detector = RestDetector()
    for k in range(500):
        force = UP + shake * rng.normal(size=3)
        detector.add(k * 10_000_000, tuple(force.tolist()), (0.0, 0.0, 0.0))
    assert detector.stretches == []


def directions(n):
    rng = np.random.default_rng(4)
    sides = np.vstack([np.eye(3), -np.eye(3)])
    more = rng.normal(size=(max(n - 6, 0), 3))
    return np.vstack([sides, more / np.linalg.norm(more, axis=1, keepdims=True)])[:n]


MATRIX = np.array([[1.02, 0.004, -0.006], [0.0, 0.985, 0.003], [0.0, 0.0, 1.01]])
OFFSET = np.array([0.25, -0.3, 0.15])


def readings(n, noise=0.002, seed=0):
    rng = np.random.default_rng(seed)
    return GRAVITY * directions(n) @ np.linalg.inv(MATRIX).T + OFFSET + noise * rng.normal(size=(n, 3))


def test_accelerometer_from_fourteen_positions():
    result = accelerometer_ellipsoid(readings(14), GRAVITY)
    np.testing.assert_allclose(result.fit.bias, OFFSET, atol=0.01)
    np.testing.assert_allclose(result.fit.matrix, MATRIX, atol=0.003)
    assert result.quality.verdict == "good"
    assert result.fit.spread_after < 0.1 * result.fit.spread_before


def test_six_positions_give_biases_and_scales_but_are_not_good():
    result = accelerometer_ellipsoid(readings(6), GRAVITY)
    np.testing.assert_allclose(result.fit.bias, OFFSET, atol=0.01)
    assert result.quality.verdict != "good"
    assert "positions" in result.quality.reasons[0]


def test_fewer_are_refused_and_a_missing_side_is_named():
    with pytest.raises(ValueError, match="only 5 positions"):
        accelerometer_ellipsoid(readings(5), GRAVITY)
    upper = np.array([p for p in readings(40) if p[2] > 0])
    quality = accelerometer_ellipsoid(upper, GRAVITY).quality
    assert quality.verdict == "fair"
    assert any("-z" in reason for reason in quality.reasons)


def test_six_sides_of_a_cube_give_all_twelve_numbers():
    result = six_positions(readings(6), GRAVITY)
    np.testing.assert_allclose(result.fit.bias, OFFSET, atol=0.01)
    np.testing.assert_allclose(result.fit.matrix, MATRIX, atol=0.003)
    with pytest.raises(ValueError, match="never lay with -z up"):
        six_positions(readings(5), GRAVITY)
    askew = readings(7)
    with pytest.raises(ValueError, match="askew"):
        six_positions(askew, GRAVITY)


def test_stretches_in_one_position_count_once():
    side = np.array([GRAVITY, 0, 0])
    moving = np.radians([100, 0, 0])
    found = rest_positions(
        fed((2, UP, BIAS), (1, UP, moving), (2, side, BIAS), (1, UP, moving), (2, UP, BIAS))
    )
    assert len(found) == 2
    np.testing.assert_allclose(found, [UP, side], atol=0.05)


def field_readings(v, noise=0.4, seed=0):
    rng = np.random.default_rng(seed)
    soft = np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3))
    return 49.0 * v @ soft.T + [20, -15, 8] + noise * rng.normal(size=v.shape)


def unit(n, seed=0):
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_magnetometer_turned_everywhere():
    result = magnetometer_ellipsoid(field_readings(unit(3000)), 49.0)
    assert np.abs(result.fit.bias - [20, -15, 8]).max() < 0.5
    assert result.quality.verdict == "good"
    assert result.fit.spread_before > 0.2
    assert result.fit.spread_after < 0.015


def test_half_a_sphere_is_poor_and_says_where_it_lacks():
    v = unit(3000)
    result = magnetometer_ellipsoid(field_readings(v[v[:, 0] > 0.5]), 49.0)
    assert result.quality.verdict == "poor"
    assert any("directions seen" in reason and "-x" in reason for reason in result.quality.reasons)


def test_a_disturbed_field_is_not_good():
    v = unit(3000)
    swing = 1 + 0.25 * np.sin(np.arange(3000) / 200)[:, None]
    result = magnetometer_ellipsoid(field_readings(v) * swing, 49.0)
    assert result.quality.verdict != "good"
    assert any("iron" in reason for reason in result.quality.reasons)


def test_the_worst_finding_counts():
    quality = judged(QualityAspect(0.9, "fine"), QualityAspect(0.2, "bad"), QualityAspect(0.6, "so so"))
    assert (quality.score, quality.verdict, quality.reasons) == (0.2, "poor", ("bad", "so so"))
    assert judged(QualityAspect(0.8, "fine")).reasons == ()


@pytest.mark.parametrize(("good", "bad"), [(0.03, 0.2), (3.0, 0.5), (0.75, 0.2)])
def test_grades_fall_from_one_over_good_to_nothing(good, bad):
    values = np.linspace(0, 2 * max(good, bad), 200)
    grades = np.array([graded(v, good, bad) for v in values])
    assert grades.max() == 1.0
    assert grades.min() == 0.0
    assert (np.diff(grades) * np.sign(good - bad) >= 0).all()
    assert graded(good, good, bad) == pytest.approx(0.7)
    assert graded(float("nan"), good, bad) == 0.0
