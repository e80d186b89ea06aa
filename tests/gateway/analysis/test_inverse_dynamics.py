"""Torques against the closed form of pendulums, and standing still against a person's weight."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.analysis.floor import FloorForces
from gateway.analysis.inverse_dynamics import inverse_dynamics
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.body_file import load_body
from gateway.body.inertia import BodyInertia, body_inertia
from gateway.body.skeleton import Skeleton

pytest.importorskip("mujoco")
GRAVITY = np.array([0.0, 0.0, -9.81])
M1, M2, L1, C1, C2 = 1.7, 0.9, 0.45, 0.2, 0.31
I1, I2 = 0.04, 0.02


def about_y(angle):
    """(F, 4) rotations about world y."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, np.sin(angle / 2), zero], axis=-1)


def pendulum(n):
    names = ("first", "second")[:n]
    offsets = np.array([[0, 0, 0], [0, 0, -L1]], float)[:n]
    tips = np.array([[0, 0, -L1], [0, 0, -0.5]], float)[:n]
    body = Skeleton("pendulum", names, np.array([-1, 0])[:n], offsets, tips)
    inertia = BodyInertia(
        np.array([M1, M2])[:n],
        np.array([[0, 0, -C1], [0, 0, -C2]])[:n],
        np.stack([np.diag([I1] * 3), np.diag([I2] * 3)])[:n],
        M1 + M2,
    )
    return body, inertia


TIME = np.arange(0, 2, 0.002)
A = 0.8 * np.sin(2.1 * TIME + 0.3)
A1 = 0.8 * 2.1 * np.cos(2.1 * TIME + 0.3)
A2 = -0.8 * 2.1**2 * np.sin(2.1 * TIME + 0.3)
B = 0.5 * np.cos(3.3 * TIME)
B1 = -0.5 * 3.3 * np.sin(3.3 * TIME)
B2 = -0.5 * 3.3**2 * np.cos(3.3 * TIME)


def test_pendulum_torque_is_that_of_the_closed_form():
    body, inertia = pendulum(1)
    motion = smooth_motion(body, TIME, about_y(A)[:, None], np.zeros((len(TIME), 3)), None)
    found = inverse_dynamics(motion, inertia, GRAVITY)
    closed = (I1 + M1 * C1**2) * A2 + M1 * 9.81 * C1 * np.sin(A)
    inner = slice(20, -20)
    assert np.abs(found.moment[inner, 0, 1] - closed[inner]).max() < 1e-6


def test_double_pendulum_torques_are_those_of_lagrange():
    """Absolute angles a, b against the vertical; b = a + relative."""
    body, inertia = pendulum(2)
    b, b1, b2 = A + B, A1 + B1, A2 + B2
    q_wb = np.stack([about_y(A), about_y(b)], axis=1)
    motion = smooth_motion(body, TIME, q_wb, np.zeros((len(TIME), 3)), None)
    found = inverse_dynamics(motion, inertia, GRAVITY)
    coupling = M2 * L1 * C2
    second = (
        (I2 + M2 * C2**2) * b2
        + coupling * (np.cos(A - b) * A2 - np.sin(A - b) * A1**2)
        + M2 * 9.81 * C2 * np.sin(b)
    )
    first = (
        (I1 + M1 * C1**2 + M2 * L1**2) * A2
        + coupling * (np.cos(A - b) * b2 + np.sin(A - b) * b1**2)
        + (M1 * C1 + M2 * L1) * 9.81 * np.sin(A)
        + second
    )
    inner = slice(20, -20)
    assert np.abs(found.moment[inner, 1, 1] - second[inner]).max() < 1e-6
    assert np.abs(found.moment[inner, 0, 1] - first[inner]).max() < 1e-6


def standing(name, frames=50):
    body = load_body(name)
    q_wb = np.tile(body.neutral, (frames, body.n_segments, 1))
    root = np.tile([0.0, 0.0, 0.926], (frames, 1))
    return body, smooth_motion(body, np.arange(frames) / 60, q_wb, root, None)


@pytest.mark.parametrize("name", ["human_17", "human_23"])
def test_standing_still_takes_the_weight(name):
    body, motion = standing(name)
    inertia = body_inertia(body, 70.0, "male")
    found = inverse_dynamics(motion, inertia, GRAVITY)
    assert inertia.share == pytest.approx(1.0, abs=2e-3)
    assert found.residual_force[:, 2] == pytest.approx(inertia.mass.sum() * 9.81, rel=1e-9)
    assert np.abs(found.residual_force[:, :2]).max() < 1e-9


LEG = ("left_thigh", "left_shank", "left_foot")


def held_up_by_one_foot(hip_shift_m=0.0):
    """A person who stands still, a floor force of three components under the left foot, off its middle; hip,
    leg and inertia, and the dynamics."""
    body, motion = standing("human_17")
    shifted = body.offsets.copy()
    shifted[body.index("left_thigh"), 0] += hip_shift_m
    body = replace(body, offsets=shifted)
    motion = replace(motion, skeleton=body)
    inertia = body_inertia(body, 70.0, "male")
    force, at = np.array([60.0, -25.0, 650.0]), np.array([0.11, 0.13, 0.0])
    foot = np.array([body.index("left_foot")])
    shape = (len(motion.time_s), 1, 3)
    floor = FloorForces(
        foot, np.broadcast_to(force, shape), np.broadcast_to(np.cross(at, force), shape),
        np.ones(shape[:2], np.uint8), np.zeros(shape[:2]),
    )  # fmt: skip
    return body, inertia, force, at, inverse_dynamics(motion, inertia, GRAVITY, floor)


@pytest.mark.parametrize("hip_shift_m", [0.0, 0.02])
def test_hip_moment_over_a_floor_force_is_that_of_statics(hip_shift_m):
    """By hand: what holds the leg at the hip against its weight and the floor's force."""
    body, inertia, force, at, found = held_up_by_one_foot(hip_shift_m)
    hip = found.p_w[0, body.index("left_thigh")]
    by_hand = np.cross(at - hip, force)
    for name in LEG:
        s = body.index(name)
        centre = found.p_w[0, s] + found.rotation_wb[0, s] @ inertia.centre[s]
        by_hand += np.cross(centre - hip, inertia.mass[s] * GRAVITY)
    assert found.moment[0, body.index("left_thigh")] == pytest.approx(-by_hand, abs=1e-9)


def test_a_hip_two_centimetres_elsewhere_changes_its_moment_by_force_times_distance():
    """So two models that agree on everything but the hip's centre differ by a good part of a walk's peak."""
    body, _, force, _, here = held_up_by_one_foot()
    *_, there = held_up_by_one_foot(0.02)
    hip = body.index("left_thigh")
    moved = there.p_w[0, hip] - here.p_w[0, hip]
    assert np.linalg.norm(moved) == pytest.approx(0.02)
    # the leg moves with its hip, so that its own weight has the same lever
    assert there.moment[0, hip] - here.moment[0, hip] == pytest.approx(np.cross(moved, force), abs=1e-9)
    assert 12.0 < np.linalg.norm(np.cross(moved, force)) < 14.0
