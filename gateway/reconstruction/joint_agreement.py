"""How well neighbouring modules agree about the joint between them: shows modules worn wrong. Compiled.

Both neighbours feel the acceleration of their common joint: ``R (f + [ω̇, ω] ⊳ r) + g``, r from module to
joint. A module worn the wrong way round, on the wrong segment or at the wrong place puts the joint
somewhere else and feels another acceleration there. The score of a joint is the rms difference over the rms
acceleration of both: 0 when they agree, about 1 when they have nothing to do with each other. It needs
motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, dot, is_finite

SMOOTHING_S = 0.05
"""Low-pass of both sides. It differentiates ``R (ω × r)`` too, so no rate is differenced."""
MEMORY_S = 10.0
LEAST_ACCELERATION = 1.0
"""m/s² rms: less is mostly noise and tilt error."""


class Joints(NamedTuple):
    """Constant, by segment."""

    parents: IntArray  # (n,) −1 where one side has no module
    from_child: FloatArray  # (n, 3) child's module to the joint, child's axes, m
    from_parent: FloatArray  # (n, 3) parent's module to the joint, parent's axes, m
    gravity: FloatArray  # (3,)


class AgreementState(NamedTuple):
    """By joint, changed in place."""

    averages: FloatArray  # (n, 2, 2, 3) child, parent; R f, R (ω × r)
    fresh_s: FloatArray  # (n,) since the averages were begun; 0: not
    sums: FloatArray  # (n, 3) weight, squared difference, squared accelerations


def joints_of(suit: WornSuit) -> Joints:
    """The joints between segments that both carry modules."""
    parents, arms = suit.skeleton.parents.astype(np.int64), np.asarray(suit.lever_arms, np.float64)
    has_module = suit.module_of_segment >= 0
    joined = (parents >= 0) & has_module & has_module[parents]
    from_parent = np.where(joined[:, None], suit.skeleton.offsets - arms[parents], 0.0)
    return Joints(np.where(joined, parents, -1), -arms, from_parent, np.array(suit.gravity, np.float64))


def initial_agreement(n: int) -> AgreementState:
    """Of n segments."""
    return AgreementState(np.zeros((n, 2, 2, 3)), np.zeros(n), np.zeros((n, 3)))


@compiled
def watch_joints(
    joints: Joints, state: AgreementState, q_wb: FloatArray, force: FloatArray, rate: FloatArray, dt: float
) -> None:
    """One frame. q_wb (n, 4); force, rate (n, 3) segment axes, NaN where a module is silent."""
    gain, forget = 1.0 - math.exp(-dt / SMOOTHING_S), math.exp(-dt / MEMORY_S)
    u = np.empty((2, 3))
    for s in range(len(joints.parents)):
        p = joints.parents[s]
        if p < 0:
            continue
        if not (_is_known(q_wb, force, rate, s) and _is_known(q_wb, force, rate, p)):
            state.fresh_s[s] = 0.0
            continue
        for side in range(2):
            i, arm = (s, joints.from_child[s]) if side == 0 else (p, joints.from_parent[s])
            f_w = quaternion.rotate(q_wb[i], force[i])
            v_w = quaternion.rotate(q_wb[i], cross(rate[i], arm))
            average = state.averages[s, side]
            if state.fresh_s[s] == 0.0:
                average[0], average[1] = f_w, v_w
            u[side] = joints.gravity + average[0] + gain * (f_w - average[0])
            u[side] += gain / dt * (v_w - average[1])
            average[0] += gain * (f_w - average[0])
            average[1] += gain * (v_w - average[1])
        state.fresh_s[s] += dt
        if state.fresh_s[s] > 3.0 * SMOOTHING_S:
            difference = u[0] - u[1]
            sums = state.sums[s]
            sums[0] = forget * sums[0] + dt
            sums[1] = forget * sums[1] + dt * dot(difference, difference)
            sums[2] = forget * sums[2] + dt * 0.5 * (dot(u[0], u[0]) + dot(u[1], u[1]))


@compiled
def _is_known(q_wb: FloatArray, force: FloatArray, rate: FloatArray, s: int) -> bool:
    return is_finite(q_wb[s]) and is_finite(force[s]) and is_finite(rate[s])


def joint_scores(joints: Joints, state: AgreementState) -> FloatArray:
    """(n,) of the joint to the parent; NaN where there is none, or not enough motion yet."""
    weight, difference, power = state.sums.T
    moved = (joints.parents >= 0) & (weight > 0.3 * MEMORY_S) & (power > weight * LEAST_ACCELERATION**2)
    return np.where(moved, np.sqrt(difference / np.where(moved, power, 1.0)), np.nan)


def segment_scores(joints: Joints, scores: FloatArray) -> FloatArray:
    """(n,) the best of each segment's joints: a module worn wrong agrees with none of its neighbours."""
    result = np.full(len(scores), np.nan)
    for s, p in enumerate(joints.parents):
        if p >= 0:
            for end in (s, p):
                result[end] = np.fmin(result[end], scores[s])
    return result
