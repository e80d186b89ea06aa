"""How well neighbouring modules agree about the joint between them: shows modules worn wrong. Compiled.

Both neighbours feel the acceleration of their common joint: ``a + G r`` with ``a`` the mean of ``R f + g``
over a block and ``G`` the change of ``R [ω]×`` over it, r from module to joint. It is linear in r, so sums
of products of a and G over the last seconds tell how well any two modules would agree about any arms:
those that the rig says, and those of a module that is turned or has changed places with another one
(``mounting``). Nothing of the motion has to be kept for that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, IntArray, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite

BLOCK_S = 0.05
"""Accelerations are means over that."""
LONGEST_BLOCK_S = 0.25
"""What turns meanwhile is not seen: such a block is left out."""
MEMORY_S = 4.0
LEAST_ACCELERATION = 1.0
"""m/s² rms: less is mostly noise and tilt error."""
LEAST_WEIGHT_S = 1.5
LEAST_COMMON = 0.9
"""Share of a module's blocks that its neighbour must have too."""
SOUND = 1
"""Largest status of a segment that is taken: interpolated."""


class Joints(NamedTuple):
    """Constant, by segment."""

    parents: IntArray  # (n,) −1 where one side has no module
    is_worn: StatusArray  # (n,)
    from_child: FloatArray  # (n, 3) child's module to the joint, child's axes, m
    from_parent: FloatArray  # (n, 3) parent's module to the joint, parent's axes, m
    gravity: FloatArray  # (3,)


class AgreementState(NamedTuple):
    """Changed in place."""

    block_s: FloatArray  # (1,) so far
    is_whole: StatusArray  # (n,) since the block began
    is_known: StatusArray  # (n,) at the frame before
    force: FloatArray  # (n, 3) R f at the frame before
    forces: FloatArray  # (n, 3) its integral over the block
    swings: FloatArray  # (n, 3, 3) R [ω]× when the block began
    sums: FloatArray  # (n, n, 3, 4, 4) first segment >= second; (a, G) of both: level, level across, upright
    weights: FloatArray  # (n, n) s


def by_pair(state: AgreementState) -> AgreementState:
    """Return the same memory as ``watch_joints`` takes it: sums (n², 3, 4, 4), weights (n²,)."""
    return state._replace(sums=state.sums.reshape(-1, 3, 4, 4), weights=state.weights.reshape(-1))


def joints_of(suit: WornSuit) -> Joints:
    """The joints between segments that both carry modules."""
    parents, arms = suit.skeleton.parents.astype(np.int64), np.asarray(suit.lever_arms, np.float64)
    has_module = suit.module_of_segment >= 0
    joined = (parents >= 0) & has_module & has_module[parents]
    from_parent = np.where(joined[:, None], suit.skeleton.offsets - arms[parents], 0.0)
    return Joints(
        np.where(joined, parents, -1),
        has_module.astype(np.uint8),
        -arms,
        from_parent,
        np.array(suit.gravity, np.float64),
    )


def initial_agreement(n: int) -> AgreementState:
    """Of n segments."""
    none = np.zeros(n, np.uint8)
    return AgreementState(
        np.zeros(1), none.copy(), none.copy(), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3)),
        np.zeros((n, n, 3, 4, 4)), np.zeros((n, n)),
    )  # fmt: skip


@compiled
def watch_joints(
    joints: Joints,
    state: AgreementState,
    q_wb: FloatArray,
    force: FloatArray,
    rate: FloatArray,
    status: StatusArray,
    dt: float,
) -> None:
    """One frame. q_wb (n, 4); force, rate (n, 3) segment axes, NaN where a module is silent.

    state: with ``by_pair``."""
    for s in range(len(joints.parents)):
        if not joints.is_worn[s]:
            continue
        is_known = status[s] <= SOUND and is_finite(q_wb[s]) and is_finite(force[s]) and is_finite(rate[s])
        state.is_whole[s] &= is_known and state.is_known[s]
        if is_known:
            x, y, z = state.force[s, 0], state.force[s, 1], state.force[s, 2]
            quaternion.rotate_into(state.force[s], q_wb[s], force[s])
            state.forces[s, 0] += 0.5 * dt * (x + state.force[s, 0])
            state.forces[s, 1] += 0.5 * dt * (y + state.force[s, 1])
            state.forces[s, 2] += 0.5 * dt * (z + state.force[s, 2])
        state.is_known[s] = is_known
    state.block_s[0] += dt
    if state.block_s[0] >= BLOCK_S - 0.5 * dt:
        _end_block(joints, state, q_wb, rate)


@compiled
def _end_block(joints: Joints, state: AgreementState, q_wb: FloatArray, rate: FloatArray) -> None:
    n, lasted_s = len(joints.parents), state.block_s[0]
    felt = np.empty((n, 3, 4))  # a, G
    across, swing = np.empty((3, 3)), np.empty(3)
    for s in range(n):
        if not state.is_known[s]:
            continue
        for k in range(3):
            felt[s, k, 0] = joints.gravity[k] + state.forces[s, k] / lasted_s
        _columns_into(across, rate[s])
        for i in range(3):
            quaternion.rotate_into(swing, q_wb[s], across[i])
            for k in range(3):
                felt[s, k, 1 + i] = (swing[k] - state.swings[s, k, i]) / lasted_s
                state.swings[s, k, i] = swing[k]
    forget = math.exp(-lasted_s / MEMORY_S)
    for s in range(n):
        for o in range(s + 1):
            if joints.is_worn[s] and joints.is_worn[o]:
                is_whole = state.is_whole[s] and state.is_whole[o] and lasted_s < LONGEST_BLOCK_S
                weight, both = lasted_s if is_whole else 0.0, s * n + o
                state.weights[both] = forget * state.weights[both] + weight
                _add_products(state.sums[both], felt[s], felt[o], forget, weight)
    state.block_s[0] = 0.0
    for s in range(n):
        state.is_whole[s] = state.is_known[s]
        for k in range(3):
            state.forces[s, k] = 0.0


@compiled
def _columns_into(across: FloatArray, rate: FloatArray) -> None:
    """Rows of across (3, 3) ← rate × each axis, the columns of [ω]×."""
    for i in range(3):
        x, y, z = 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0
        across[i, 0] = rate[1] * z - rate[2] * y
        across[i, 1] = rate[2] * x - rate[0] * z
        across[i, 2] = rate[0] * y - rate[1] * x


@compiled
def _add_products(sums: FloatArray, a: FloatArray, b: FloatArray, forget: float, weight: float) -> None:
    for i in range(4):
        for k in range(4):
            for part in range(3):
                sums[part, i, k] *= forget
            if weight > 0.0:
                sums[0, i, k] += weight * (a[0, i] * b[0, k] + a[1, i] * b[1, k])
                sums[1, i, k] += weight * (a[0, i] * b[1, k] - a[1, i] * b[0, k])
                sums[2, i, k] += weight * a[2, i] * b[2, k]


class Pair(NamedTuple):
    """Two modules about one joint, mean squares in (m/s²)²."""

    difference: float
    turned: float
    """The same after the heading between the two that makes it least."""
    power: float
    """Mean of both accelerations'."""
    swing: float
    """Of both, for an arm of a metre: what arms that are off make of it."""


@compiled
def pair(sums: FloatArray, weights: FloatArray, s: int, arm: FloatArray, p: int, arm_p: FloatArray) -> Pair:
    """The modules of segments s and p about a joint that is ``arm`` (3,) from one, ``arm_p`` from the
    other."""
    level, across, upright = _products(sums, weights, s, arm, p, arm_p)
    own, swing = _square(sums[s, s], weights[s, s], arm)
    other, swing_p = _square(sums[p, p], weights[p, p], arm_p)
    both = own + other - 2.0 * upright
    turned = both - 2.0 * math.sqrt(level * level + across * across)
    return Pair(max(both - 2.0 * level, 0.0), max(turned, 0.0), 0.5 * (own + other), swing + swing_p)


@compiled
def _square(sums: FloatArray, weight: float, arm: FloatArray) -> tuple[float, float]:
    """Return the mean square of a joint's acceleration as one module has it, and that of its swing."""
    total, swing = 0.0, 0.0
    for i in range(4):
        left = 1.0 if i == 0 else arm[i - 1]
        for k in range(4):
            right = 1.0 if k == 0 else arm[k - 1]
            total += left * right * (sums[0, i, k] + sums[2, i, k])
        if i > 0:
            swing += sums[0, i, i] + sums[2, i, i]
    return total / weight, swing / weight


@compiled
def _products(
    sums: FloatArray, weights: FloatArray, s: int, arm: FloatArray, p: int, arm_p: FloatArray
) -> tuple[float, float, float]:
    """Return mean products of both accelerations: level, level across (but for its sign), upright."""
    if s < p:
        s, p, arm, arm_p = p, s, arm_p, arm
    products, weight = sums[s, p], weights[s, p]
    level, across, upright = 0.0, 0.0, 0.0
    for i in range(4):
        left = 1.0 if i == 0 else arm[i - 1]
        for k in range(4):
            both = left if k == 0 else left * arm_p[k - 1]
            level += both * products[0, i, k]
            across += both * products[1, i, k]
            upright += both * products[2, i, k]
    return level / weight, across / weight, upright / weight


@compiled
def is_common(weights: FloatArray, s: int, p: int) -> bool:
    """Whether two modules were heard together for long enough, and hardly ever one of them alone."""
    weight = weights[max(s, p), min(s, p)]
    return bool(
        weight > LEAST_WEIGHT_S
        and weight > LEAST_COMMON * weights[s, s]
        and weight > LEAST_COMMON * weights[p, p]
    )


@compiled
def pairs(joints: Joints, state: AgreementState) -> FloatArray:
    """(n, 4) ``Pair`` of each segment and its parent, with the arms that the rig says; NaN where there is no
    joint, or too little was heard of one of them."""
    found = np.full((len(joints.parents), 4), np.nan)
    for s in range(len(joints.parents)):
        p = joints.parents[s]
        if p >= 0 and is_common(state.weights, s, p):
            found[s] = pair(state.sums, state.weights, s, joints.from_child[s], p, joints.from_parent[s])
    return found


def joint_scores(joints: Joints, state: AgreementState) -> FloatArray:
    """(n,) of the joint to the parent: the rms difference over the rms acceleration of both; 0 when they
    agree, about 1 when they have nothing to do with each other. NaN where there is no joint, or not enough
    motion."""
    difference, _, power, _ = pairs(joints, state).T
    moved = power > LEAST_ACCELERATION**2
    return np.where(moved, np.sqrt(difference / np.where(moved, power, 1.0)), np.nan)


def segment_scores(joints: Joints, scores: FloatArray) -> FloatArray:
    """(n,) the best of each segment's joints: a module worn wrong agrees with none of its neighbours."""
    result = np.full(len(scores), np.nan)
    for s, p in enumerate(joints.parents):
        if p >= 0:
            for end in (s, p):
                result[end] = np.fmin(result[end], scores[s])
    return result
