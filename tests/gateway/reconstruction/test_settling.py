"""Where a module is after a gap, against what is known of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gateway.reconstruction.inertial.module_filter import (
    BeforeSilence,
    after_gap,
    no_motion_statistics,
    note,
    nothing_since,
    settle,
)

DT = 0.01
G = 9.81
DIP = np.radians(66.0)
FIELD = 49.0 * np.array([0.0, np.cos(DIP), -np.sin(DIP)])
STILL = np.array([1.0, 0.0, 0.0, 0.0])
seeds = st.integers(0, 2**32 - 1)


def wxyz(rotation):
    return rotation.as_quat()[[3, 0, 1, 2]]


def angle_deg(q, rotation):
    return np.degrees((Rotation.from_quat(q[[1, 2, 3, 0]]).inv() * rotation).magnitude())


def before(q_wi, sigma, field_norm=49.0, swing=0.0):
    return BeforeSilence(wxyz(q_wi), sigma, swing, field_norm, DIP, G)


def settled(known, forces, fields):
    """Of a module whose gyroscopes say that it does not turn: specific forces (n, 3) and fields (n, 3)."""
    since = nothing_since()
    for f, x in zip(forces, fields, strict=True):
        q, sigma = settle(known, since, STILL, f, x, DT)
    return q, sigma


def still(truth, n):
    return np.tile(truth.inv().apply([0.0, 0.0, G]), (n, 1)), np.tile(truth.inv().apply(FIELD), (n, 1))


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_a_module_at_rest_is_found_whatever_was_expected(seed):
    rng = np.random.default_rng(seed)
    truth, expected = Rotation.random(2, rng=rng)
    q, sigma = settled(before(expected, 30.0), *still(truth, 100))
    assert angle_deg(q, truth) < 0.1
    assert sigma < 0.3


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_without_a_field_the_heading_is_the_expected_one(seed):
    rng = np.random.default_rng(seed)
    expected = Rotation.random(rng=rng)
    tilted = Rotation.from_rotvec([0.2, -0.1, 0.0]) * expected  # no heading is lost between level axes
    forces, fields = still(tilted, 300)
    q, _ = settled(before(expected, 1.0), forces, np.full_like(fields, np.nan))
    up = Rotation.from_quat(q[[1, 2, 3, 0]]).apply(forces[0]) / G
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=0.005)
    assert angle_deg(q, tilted) < 1.0


def test_a_field_of_another_strength_does_not_tell_the_inclination():
    """Nor does its dip count, which is that of another place."""
    truth = Rotation.from_euler("zyx", [0.3, 0.2, -0.4])
    forces, _ = still(truth, 100)
    other = np.tile(truth.inv().apply([0.0, 70.0, 0.0]), (100, 1))
    q, _ = settled(before(truth, 30.0), forces, other)
    assert angle_deg(q, truth) < 0.1


@pytest.mark.parametrize("period_s", [0.7, 0.9, 1.3])
def test_swings_are_no_inclination_once_they_are_spanned(period_s):
    """Of the plain mean over 3 s the inclination would be off by degrees, and the heading by twice that."""
    truth = Rotation.from_euler("zyx", [0.3, 0.2, -0.4])
    forces, fields = still(truth, 300)
    phase = 2.0 * np.pi * (np.arange(300) + 0.5) * DT / period_s
    forces = forces + truth.inv().apply(6.0 * np.sin(phase)[:, None] * [1.0, 0.0, 0.0])
    q, _ = settled(before(truth, 30.0, swing=3.0), forces, fields)
    plain = truth.apply(forces.mean(axis=0))
    assert angle_deg(q, truth) < 0.6 * np.degrees(np.arctan2(plain[0], plain[2]))


def test_what_was_expected_counts_by_its_uncertainty():
    truth = Rotation.identity()
    expected = Rotation.from_rotvec([0.0, 0.0, 0.2])
    off_deg = [
        angle_deg(settled(before(expected, sigma), *still(truth, 10))[0], truth) for sigma in (0.01, 0.1, 1.0)
    ]
    assert off_deg[0] > 10.0
    assert off_deg == sorted(off_deg, reverse=True)
    assert off_deg[2] < 1.0


def noted(rates, seconds=10.0):
    """Motion statistics of one segment that turned about x at rates (n,), rad/s."""
    motion, one = no_motion_statistics(1), np.zeros(1, np.int64)
    angle = np.cumsum(np.asarray(rates) * DT)
    f, x = np.array([[0.0, 0.0, G]]), np.array([FIELD])
    for at, rate in zip(angle, rates, strict=True):
        q = wxyz(Rotation.from_rotvec([at, 0.0, 0.0]))[None]
        note(motion, one, one, np.array([True]), q, f, np.array([[rate, 0.0, 0.0]]), x, G, DT)
    return motion, angle[-1]


def test_over_a_short_gap_it_turns_by_its_rate():
    motion, angle = noted(np.full(500, 0.8))
    q, sigma = after_gap(motion, 0, 0.2, np.array([0.8, 0.0, 0.0]))
    assert angle_deg(q, Rotation.from_rotvec([angle + 0.16, 0.0, 0.0])) < 1e-6
    assert sigma < 0.2


def test_over_a_long_gap_a_limb_comes_back_to_where_it_uses_to_be():
    rates = 2.0 * np.cos(2.0 * np.pi * np.arange(1225) * DT)  # ± 0.32 rad; ends at an extreme
    motion, angle = noted(rates)
    assert abs(angle) > 0.3
    q, sigma = after_gap(motion, 0, 1.0, np.zeros(3))
    assert angle_deg(q, Rotation.identity()) < 3.0
    assert 0.2 < sigma < 0.5
    assert after_gap(motion, 0, 60.0, np.zeros(3))[1] > 1.5  # nobody knows for long


def test_what_has_just_begun_is_less_certain():
    sigmas = [after_gap(noted(np.zeros(n))[0], 0, 0.2, np.zeros(3))[1] for n in (10, 100, 1000)]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] > 2.0 * sigmas[2]
