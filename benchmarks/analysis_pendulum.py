"""Torques of a double pendulum: ours against Lagrange's equations."""

from __future__ import annotations

import numpy as np

from gateway.analysis.inverse_dynamics import inverse_dynamics
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.inertia import BodyInertia
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray

_MASS, _CENTRE, _INERTIA = np.array([1.7, 0.9]), np.array([0.2, 0.31]), np.array([0.04, 0.02])
_LENGTH, _G = 0.45, 9.81
_EDGE = 20
"""Frames at both ends that are left out: a spline knows less there."""


def double_pendulum_error() -> float:
    """Largest difference over two seconds at 500 Hz, N m."""
    time_s = np.arange(0.0, 2.0, 0.002)
    a, a1, a2 = _swing(0.8, 2.1, 0.3, time_s)
    r, r1, r2 = _swing(0.5, 3.3, 1.6, time_s)
    b, b1, b2 = a + r, a1 + r1, a2 + r2  # both against the vertical
    body = Skeleton(
        "pendulum", ("first", "second"), np.array([-1, 0]), np.array([[0, 0, 0], [0, 0, -_LENGTH]]),
        np.array([[0, 0, -_LENGTH], [0, 0, -0.5]]),
    )  # fmt: skip
    centres = np.stack([np.zeros(2), np.zeros(2), -_CENTRE], axis=1)
    inertia = BodyInertia(_MASS, centres, np.stack([np.eye(3) * i for i in _INERTIA]), float(_MASS.sum()))
    turns = np.stack([_about_y(a), _about_y(b)], axis=1)
    motion = smooth_motion(body, time_s, turns, np.zeros((len(time_s), 3)), None)
    found = inverse_dynamics(motion, inertia, np.array([0.0, 0.0, -_G]))
    coupling = _MASS[1] * _LENGTH * _CENTRE[1]
    second = (
        (_INERTIA[1] + _MASS[1] * _CENTRE[1] ** 2) * b2
        + coupling * (np.cos(a - b) * a2 - np.sin(a - b) * a1**2)
        + _MASS[1] * _G * _CENTRE[1] * np.sin(b)
    )
    first = second + (
        (_INERTIA[0] + _MASS[0] * _CENTRE[0] ** 2 + _MASS[1] * _LENGTH**2) * a2
        + coupling * (np.cos(a - b) * b2 + np.sin(a - b) * b1**2)
        + (_MASS[0] * _CENTRE[0] + _MASS[1] * _LENGTH) * _G * np.sin(a)
    )
    wrong = found.moment[:, :, 1] - np.stack([first, second], axis=1)
    return float(np.abs(wrong[_EDGE:-_EDGE]).max())


def _swing(
    size: float, rate: float, phase: float, time_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle and its derivatives."""
    at = rate * time_s + phase
    return size * np.sin(at), size * rate * np.cos(at), -size * rate**2 * np.sin(at)


def _about_y(angle: FloatArray) -> FloatArray:
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, np.sin(angle / 2), zero], axis=-1)
