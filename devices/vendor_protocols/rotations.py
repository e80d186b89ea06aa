"""Turns as makers of suits write them, to quaternions (w first) and back; plain numbers, a few a message."""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the turn b followed, in its own axes seen from outside, by a: ``q_ac = q_ab q_bc``."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def about(axis: str, angle: float) -> Quaternion:
    """Return the turn about x, y or z by an angle, rad."""
    c, s = math.cos(angle / 2), math.sin(angle / 2)
    return c, s * (axis == "x"), s * (axis == "y"), s * (axis == "z")


def in_turn(*turns: tuple[str, float]) -> Quaternion:
    """Return turns one after another, each about the axes as turned so far: (axis, angle in rad)."""
    q: Quaternion = (1.0, 0.0, 0.0, 0.0)
    for axis, angle in turns:
        q = multiply(q, about(axis, angle))
    return q


def zxy_angles(q: Quaternion) -> tuple[float, float, float]:
    """Return the angles about x, y and z, rad, of which ``in_turn`` about z, x, y makes q; x within ± 90°."""
    w, x, y, z = q
    about_x = math.asin(min(max(2 * (y * z + w * x), -1.0), 1.0))
    about_y = math.atan2(2 * (w * y - x * z), w * w - x * x - y * y + z * z)
    about_z = math.atan2(2 * (w * z - x * y), w * w - x * x + y * y - z * z)
    return about_x, about_y, about_z
