"""How well neighbouring modules agree about the joint between them: shows modules worn wrong. Compiled.

Both neighbours feel the acceleration of their common joint: ``a + G r`` with ``a`` the mean of ``R f + g``
over a block and ``G`` the change of ``R [ω]×`` over it, r from module to joint. It is linear in r, so sums
of products of a and G over the last seconds show how well any two modules would agree about any arms:
those of the rig, and those of a module that is turned or has changed places with another one
(``mounting``). Nothing of the motion has to be kept for that.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Matrix, Record, Records, Vector, records
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


class JointSide(Record):
    """A segment and its joint to the parent; constant."""

    parent: int  # −1 where one side has no module
    is_worn: int
    from_child: Vector  # child's module to the joint, child's axes, m
    from_parent: Vector  # parent's module to the joint, parent's axes, m


class Joints(NamedTuple):
    """The joints between modules; constant."""

    sides: Records[JointSide]
    gravity: FloatArray  # (3,)


class Felt(Record):
    """What a segment's module has measured in a block."""

    is_whole: int  # since the block began
    is_known: int  # at the frame before
    force: Vector  # R f at the frame before
    forces: Vector  # its integral over the block
    swing: Matrix  # R [ω]× when the block began, by columns


class Products(Record):
    """Products of two segments' (a, G), summed over the last seconds."""

    sums: Annotated[FloatArray, 3, 4, 4]  # level, level across, upright
    weight: float  # s


class Block(Record):
    """What all segments share."""

    lasted_s: float


class AgreementState(NamedTuple):
    """The sums over the last seconds; changed in place."""

    block: Records[Block]  # one
    segments: Records[Felt]
    pairs: Records[Products]  # (n²,) of s and o at s n + o, s >= o


def joints_of(suit: WornSuit) -> Joints:
    """Return the joints between segments that both carry modules."""
    parents, arms = suit.skeleton.parents.astype(np.int64), np.asarray(suit.lever_arms, np.float64)
    has_module = suit.module_of_segment >= 0
    joined = (parents >= 0) & has_module & has_module[parents]
    sides = records(JointSide, len(parents))
    sides["parent"], sides["is_worn"] = np.where(joined, parents, -1), has_module
    sides["from_child"] = -arms
    sides["from_parent"] = np.where(joined[:, None], suit.skeleton.offsets - arms[parents], 0.0)
    return Joints(sides, np.array(suit.gravity, np.float64))


def initial_agreement(n: int) -> AgreementState:
    """Return the state of n segments before the first frame."""
    return AgreementState(records(Block, 1), records(Felt, n), records(Products, n * n))


class FramePose(NamedTuple):
    """The pose of one frame."""

    q_wb: FloatArray  # (n, 4)
    force: FloatArray  # (n, 3) segment axes, m/s²; NaN where a module is silent
    rate: FloatArray  # (n, 3) segment axes, rad/s
    status: StatusArray  # (n,)


@compiled
def watch_joints(joints: Joints, state: AgreementState, pose: FramePose, dt: float) -> None:
    """Update the sums by one frame, dt (s) after the one before."""
    q_wb, force, rate, block = pose.q_wb, pose.force, pose.rate, state.block[0]
    for s in range(len(joints.sides)):
        if not joints.sides[s].is_worn:
            continue
        segment, is_known = state.segments[s], pose.status[s] <= SOUND
        is_known = is_known and is_finite(q_wb[s]) and is_finite(force[s]) and is_finite(rate[s])
        if not (is_known and segment.is_known):
            segment.is_whole = 0
        if is_known:
            x, y, z = segment.force[0], segment.force[1], segment.force[2]
            quaternion.rotate_into(segment.force, q_wb[s], force[s])
            segment.forces[0] += 0.5 * dt * (x + segment.force[0])
            segment.forces[1] += 0.5 * dt * (y + segment.force[1])
            segment.forces[2] += 0.5 * dt * (z + segment.force[2])
        segment.is_known = int(is_known)
    block.lasted_s += dt
    if block.lasted_s >= BLOCK_S - 0.5 * dt:
        _end_block(joints, state, q_wb, rate)


@compiled
def _end_block(joints: Joints, state: AgreementState, q_wb: FloatArray, rate: FloatArray) -> None:
    sides, segments, block = joints.sides, state.segments, state.block[0]
    n, lasted_s = len(sides), block.lasted_s
    felt = np.empty((n, 3, 4))  # a, G
    across, swing = np.empty((3, 3)), np.empty(3)

    # a and G of each segment over the block
    for s in range(n):
        segment = segments[s]
        if not segment.is_known:
            continue
        for k in range(3):
            felt[s, k, 0] = joints.gravity[k] + segment.forces[k] / lasted_s
        _columns_into(across, rate[s])
        for i in range(3):
            quaternion.rotate_into(swing, q_wb[s], across[i])
            for k in range(3):
                felt[s, k, 1 + i] = (swing[k] - segment.swing[k, i]) / lasted_s
                segment.swing[k, i] = swing[k]

    # their products, of all pairs: any two modules may have changed places
    forget = math.exp(-lasted_s / MEMORY_S)
    for s in range(n):
        for o in range(s + 1):
            if sides[s].is_worn and sides[o].is_worn:
                is_whole = segments[s].is_whole and segments[o].is_whole and lasted_s < LONGEST_BLOCK_S
                weight, both = lasted_s if is_whole else 0.0, state.pairs[s * n + o]
                both.weight = forget * both.weight + weight
                _add_products(both.sums, felt[s], felt[o], forget, weight)

    block.lasted_s = 0.0
    for s in range(n):
        segments[s].is_whole = segments[s].is_known
        for k in range(3):
            segments[s].forces[k] = 0.0


@compiled
def _columns_into(across: FloatArray, rate: FloatArray) -> None:
    """Set the rows of across (3, 3) to rate × each axis: the columns of [ω]×."""
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
def pair(pairs: Records[Products], s: int, arm: FloatArray, p: int, arm_p: FloatArray) -> Pair:
    """Return how the modules of segments s and p agree about a joint.

    arm, arm_p: (3,) from module to joint, m, axes of s and of p.
    """
    n = round(math.sqrt(len(pairs)))
    both = pairs[max(s, p) * n + min(s, p)]
    if s < p:
        level, across, upright = _mean_products(both, arm_p, arm)
    else:
        level, across, upright = _mean_products(both, arm, arm_p)
    own, swing = _square(pairs[s * n + s], arm)
    other, swing_p = _square(pairs[p * n + p], arm_p)
    square = own + other - 2.0 * upright
    turned = square - 2.0 * math.sqrt(level * level + across * across)
    return Pair(max(square - 2.0 * level, 0.0), max(turned, 0.0), 0.5 * (own + other), swing + swing_p)


@compiled
def _square(products: Products, arm: FloatArray) -> tuple[float, float]:
    """Return the mean square of a joint's acceleration as one module has it, and that of its swing."""
    sums, total, swing = products.sums, 0.0, 0.0
    for i in range(4):
        left = 1.0 if i == 0 else arm[i - 1]
        for k in range(4):
            right = 1.0 if k == 0 else arm[k - 1]
            total += left * right * (sums[0, i, k] + sums[2, i, k])
        if i > 0:
            swing += sums[0, i, i] + sums[2, i, i]
    return total / products.weight, swing / products.weight


@compiled
def _mean_products(products: Products, arm: FloatArray, arm_p: FloatArray) -> tuple[float, float, float]:
    """Return mean products of both accelerations: level, level across (but for its sign), upright."""
    sums, weight = products.sums, products.weight
    level, across, upright = 0.0, 0.0, 0.0
    for i in range(4):
        left = 1.0 if i == 0 else arm[i - 1]
        for k in range(4):
            both = left if k == 0 else left * arm_p[k - 1]
            level += both * sums[0, i, k]
            across += both * sums[1, i, k]
            upright += both * sums[2, i, k]
    return level / weight, across / weight, upright / weight


@compiled
def is_common(pairs: Records[Products], s: int, p: int) -> bool:
    """Return whether two modules have sent together for long enough, and hardly ever one of them alone."""
    n = round(math.sqrt(len(pairs)))
    weight = pairs[max(s, p) * n + min(s, p)].weight
    return bool(
        weight > LEAST_WEIGHT_S
        and weight > LEAST_COMMON * pairs[s * n + s].weight
        and weight > LEAST_COMMON * pairs[p * n + p].weight
    )


@compiled
def pairs_of(sides: Records[JointSide], pairs: Records[Products]) -> FloatArray:
    """Return the ``Pair`` of each segment and its parent, (n, 4), with the arms that the rig gives.

    NaN where there is no joint, or too few samples of one of the two.
    """
    found = np.full((len(sides), 4), np.nan)
    for s in range(len(sides)):
        p = sides[s].parent
        if p >= 0 and is_common(pairs, s, p):
            found[s] = pair(pairs, s, sides[s].from_child, p, sides[s].from_parent)
    return found


def joint_scores(joints: Joints, state: AgreementState) -> FloatArray:
    """Return, (n,), how badly each segment and its parent agree about their joint.

    It is their rms difference over the rms acceleration of both. 0 when they agree, about 1 when they have
    nothing to do with each other. NaN where there is no joint, or not enough motion.
    """
    difference, _, power, _ = pairs_of(joints.sides, state.pairs).T
    moved = power > LEAST_ACCELERATION**2
    return np.where(moved, np.sqrt(difference / np.where(moved, power, 1.0)), np.nan)


def segment_scores(joints: Joints, scores: FloatArray) -> FloatArray:
    """Return the best score of each segment's joints, (n,).

    A module that is worn wrong agrees with no neighbour.
    """
    result = np.full(len(scores), np.nan)
    for s, p in enumerate(joints.sides["parent"]):
        if p >= 0:
            for end in (s, p):
                result[end] = np.fmin(result[end], scores[s])
    return result
