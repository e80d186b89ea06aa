"""Axes of movements and of hinges, against simulated truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gateway.calibration.axes import hinge_axes, movement_axis
from gateway.calibration.joint_centres import joint_equations, relative_heading, side

INTERVAL_S = 0.01


def _angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))


@pytest.mark.parametrize("seed", range(5))
def test_movement_axis_is_found_with_its_direction(seed):
    rng = np.random.default_rng(seed)
    axis = Rotation.random(random_state=rng).as_matrix()[0]
    t = np.arange(0.0, 5.0, INTERVAL_S)
    rate = np.pi * 0.5 * np.sin(2.0 * np.pi * t / 2.5)  # sets out positively, and comes back
    found = movement_axis(np.outer(rate, axis) + rng.normal(0.0, 0.02, (len(t), 3)), INTERVAL_S)
    assert found is not None
    assert _angle_deg(found.axis, axis) < 1.0
    assert np.degrees(found.range_rad) == pytest.approx(71.6, abs=2.0)
    assert np.degrees(found.spread_rad) < 2.0


def test_movement_axis_that_changes_is_told():
    t = np.arange(0.0, 5.0, INTERVAL_S)
    rate = np.outer(np.sin(2.0 * np.pi * t / 2.5), [1.0, 0.0, 0.0])
    rate[len(t) // 2 :] = rate[len(t) // 2 :] @ Rotation.from_euler("z", 20, degrees=True).as_matrix().T
    found = movement_axis(rate, INTERVAL_S)
    assert found is not None
    assert np.degrees(found.spread_rad) == pytest.approx(20.0, abs=0.5)


def test_who_begins_late_has_still_turned_about_one_axis():
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 5.0, INTERVAL_S)
    rate = np.outer(np.where(t > 3.0, np.sin(2.0 * np.pi * (t - 3.0) / 1.0), 0.0), [0.0, 1.0, 0.0])
    found = movement_axis(rate + rng.normal(0.0, 0.02, rate.shape), INTERVAL_S)
    assert found is not None
    assert np.degrees(found.spread_rad) < 2.0


def test_no_movement_has_no_axis():
    assert movement_axis(np.zeros((500, 3)), INTERVAL_S) is None


def _hinged(rng, n=2000):
    """Rates of two segments that tumble about, joined by a hinge, in both sensors' axes."""
    t = np.arange(n) * INTERVAL_S
    common = np.stack([np.sin(2 * np.pi * f * t + p) for f, p in rng.uniform(0.3, 1.0, (3, 2))], axis=1)
    bend, bend_rate = (
        0.8 * (1 - np.cos(2 * np.pi * 0.7 * t)),
        0.8 * 2 * np.pi * 0.7 * np.sin(2 * np.pi * 0.7 * t),
    )
    z = np.array([0.0, 0.0, 1.0])
    relative = Rotation.from_rotvec(np.outer(bend, z))
    second = relative.inv().apply(common) + np.outer(bend_rate, z)
    mounts = Rotation.random(2, random_state=rng)
    return (
        mounts[0].apply(common),
        mounts[1].apply(second),
        mounts[0].apply(z),
        mounts[1].apply(z),
    )


@pytest.mark.parametrize("seed", range(4))
def test_hinge_axes_are_found_whatever_both_segments_do(seed):
    rng = np.random.default_rng(seed)
    first, second, j1, j2 = _hinged(rng)
    noise = rng.normal(0.0, 0.01, (2, *first.shape))
    found = hinge_axes(first + noise[0], second + noise[1], INTERVAL_S)
    sign = np.sign(found.first @ j1)
    assert _angle_deg(sign * found.first, j1) < 1.5
    assert _angle_deg(sign * found.second, j2) < 1.5  # the two signs go together


def test_hinge_of_two_that_rest_is_refused():
    with pytest.raises(ValueError, match="hardly turned"):
        hinge_axes(np.zeros((500, 3)), np.zeros((500, 3)), INTERVAL_S)


def _joined(rng, heading):
    """Two bodies about a joint that is shaken: sides with true lever arms, the second's world turned."""
    n = 3000
    t = np.arange(n) * INTERVAL_S
    joint = np.stack([2.0 * np.sin(2 * np.pi * f * t + f) for f in (0.5, 0.7, 0.9)], axis=1)
    sides, arms = [], rng.uniform(-0.2, 0.2, (2, 3))
    for k, arm in enumerate(arms):
        angles = np.stack([0.8 * np.sin(2 * np.pi * f * t + k) for f in rng.uniform(0.3, 0.8, 3)], axis=1)
        R = Rotation.from_euler("ZXY", angles).as_matrix()
        rate = np.zeros((n, 3))
        step = np.swapaxes(R[:-2], 1, 2) @ R[2:]
        rate[1:-1] = Rotation.from_matrix(step).as_rotvec() / (2 * INTERVAL_S)
        rate[0], rate[-1] = rate[1], rate[-2]
        acceleration = np.gradient(rate, INTERVAL_S, axis=0)
        lever = np.cross(acceleration, arm) + np.cross(rate, np.cross(rate, arm))
        force = np.einsum("nij,ni->nj", R, joint + np.array([0, 0, 9.81])) + lever
        own = Rotation.from_rotvec([0, 0, -heading * k]).as_matrix()
        sides.append(side(force, rate, own @ R, INTERVAL_S))
    return sides, arms


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_relative_heading_comes_out_of_accelerations(heading):
    sides, _ = _joined(np.random.default_rng(3), heading)
    found = relative_heading(joint_equations(*sides))
    assert np.degrees(np.angle(np.exp(1j * (found - heading)))) == pytest.approx(0.0, abs=1.0)


def test_folded_equations_say_what_all_instants_say():
    sides, arms = _joined(np.random.default_rng(5), 0.4)
    equations = joint_equations(*sides)
    for rho_1, rho_2, turn in ((arms[0], arms[1], 0.4), (arms[1], arms[0], -1.0)):
        ours = np.einsum("nij,nj->ni", sides[0].R_es, sides[0].force - sides[0].gamma @ rho_1)
        theirs = np.einsum("nij,nj->ni", sides[1].R_es, sides[1].force - sides[1].gamma @ rho_2)
        theirs = Rotation.from_rotvec([0, 0, turn]).apply(theirs)
        direct = np.sqrt(np.mean(np.sum((ours - theirs) ** 2, axis=1)))
        assert equations.rms(rho_1, rho_2, turn) == pytest.approx(direct, rel=1e-6)
    assert equations.rms(arms[0], arms[1], 0.4) < 0.1 < equations.rms(arms[1], arms[0], 0.4)


def test_the_arms_follow_from_the_lengths_of_the_joint_acceleration_alone():
    """‖f₁ − Γ₁ ρ₁‖ = ‖f₂ − Γ₂ ρ₂‖ by Gauss–Newton, as published, without any orientation."""
    (first, second), arms = _joined(np.random.default_rng(7), 0.0)

    def residuals(arms):
        ours, theirs = first.force - first.gamma @ arms[:3], second.force - second.gamma @ arms[3:]
        return np.linalg.norm(ours, axis=1) - np.linalg.norm(theirs, axis=1)

    solved = least_squares(residuals, np.zeros(6), method="lm")
    np.testing.assert_allclose(solved.x.reshape(2, 3), arms, atol=0.01)
    assert np.sqrt(np.mean(solved.fun**2)) < 0.2
