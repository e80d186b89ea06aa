"""Learn errors of lever arms, as far as the motion shows them. Compiled.

The two sides of a joint's row are ``force + K r`` with the filtered lever-arm matrix
``K = R ([ω̇]× + [ω]×²)``. Arms that are off by ``e`` leave ``u − u_p = … − K e + K_p e_p``: linear in e with
coefficients that the motion changes all the time, so errors of orientation and of arms can be separated. Each
joint has a small Kalman filter of its own for its six components; the orientation error enters it as noise
that stays for a while, and what the arms are still uncertain of enters the orientation's rows. Directions
that never show stay as measured. Where a segment has a local device, the place of that on it is found in the
same way, and the constant error ``b`` of the accelerometer shows too, as ``R b`` averaged as the row is;
between two modules it does not show well enough to be of use.

A joint's rows are correlated over the low-pass, so constants are learnt from them only every ``learn_s``.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.tree.state import (
    Device,
    Joint,
    Learning,
    Segment,
    SegmentWork,
    SharedWork,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three, times_vector_into

Symmetric = tuple[float, float, float, float, float, float]
"""xx, yy, zz, yz, xz, xy of a (3, 3) matrix: numbers, for which no array has to be made."""


@compiled
def own_covariance(segment: Segment) -> Symmetric:
    """Return D of (16) for a known vector: covariance of a segment's orientation error, world axes, rad²."""
    P = segment.P
    return P[0, 0], P[1, 1], P[2, 2], P[1, 2], P[0, 2], P[0, 1]


@compiled
def relative_covariance(child: Segment, parent: Segment) -> Symmetric:
    """Return D of (16): covariance of a segment's orientation error less its parent's, world axes, rad²."""
    P, P_p, C = child.P, parent.P, child.C
    return (
        P[0, 0] + P_p[0, 0] - C[0, 0] - C[0, 0],
        P[1, 1] + P_p[1, 1] - C[1, 1] - C[1, 1],
        P[2, 2] + P_p[2, 2] - C[2, 2] - C[2, 2],
        P[1, 2] + P_p[1, 2] - C[1, 2] - C[2, 1],
        P[0, 2] + P_p[0, 2] - C[0, 2] - C[2, 0],
        P[0, 1] + P_p[0, 1] - C[0, 1] - C[1, 0],
    )


@compiled
def spread(x: float, y: float, z: float, D: Symmetric) -> Three:
    """Return the diagonal of S of (16), ``[v]× D [v]×ᵀ`` with v = (x, y, z).

    It is the variance that an orientation of covariance D gives to the components of a vector.
    """
    xx, yy, zz, yz, xz, xy = D
    return (
        z * z * yy - 2.0 * y * z * yz + y * y * zz,
        z * z * xx - 2.0 * x * z * xz + x * x * zz,
        y * y * xx - 2.0 * x * y * xy + x * x * yy,
    )


@compiled
def is_due(child: Segment, tuning: Tuning, dt: float) -> bool:
    """Return whether the lever arms between a segment and its parent are to be learnt now.

    Counts the time since they last were; the limit leaves room for frames that jitter.
    """
    child.arms.since_s += dt
    return bool(not child.arms.since_s < 0.9 * tuning.learn_s)  # frames jitter


@compiled
def learn_joint_arms(joint: Joint, learning: Learning, tuning: Tuning, dt: float) -> None:
    """Correct the joint's ``arms`` and its sides ``u`` and ``u_parent``; (41) to (43), (46).

    Called where ``is_due``. ``arms.row_variance`` is set to what the arms' uncertainty adds to a component of
    a single row, whose own variance is ``learning.at_once``.
    """
    link, child, parent, now, above = joint
    arms, u, u_p, K, K_p = child.arms, now.u, now.u_parent, now.K, above.K
    interval_s = min(arms.since_s, tuning.row_memory_s)
    # at first joints are staggered, so that no frame has the work of all
    arms.since_s = 0.0 if math.isfinite(arms.since_s) else -dt * link.phase
    for i in range(3):
        for j in range(3):
            # (41) A = [−K_s  K_p]
            learning.rows[i, j], learning.rows[i, 3 + j] = -K[i, j], K_p[i, j]
    x, y, z = 0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2])
    D = relative_covariance(child, parent)
    off = spread(x, y, z, D)
    for i in range(3):
        learning.residual[i], learning.off[i] = u[i] - u_p[i], off[i]
    # (42) D_33 once more, for longer: arms would take a wrong heading for their own error
    lasting = D[2] * tuning.tilt_memory_s / tuning.row_memory_s
    learning.off[0] += lasting * y * y
    learning.off[1] += lasting * x * x
    learning.variance = learning.at_once * tuning.row_memory_s / interval_s
    learning.memory = tuning.row_memory_s / interval_s
    arms.row_variance = learn_rows(arms.covariance, learning, tuning.huber)
    change = learning.change
    for i in range(6):
        arms.error[i] += change[i]
    for i in range(3):
        u[i] += K[i, 0] * change[0] + K[i, 1] * change[1] + K[i, 2] * change[2]
        u_p[i] += K_p[i, 0] * change[3] + K_p[i, 1] * change[4] + K_p[i, 2] * change[5]


@compiled
def learn_fixed_point(
    device: Device, segment: Segment, now: SegmentWork, shared: SharedWork, tuning: Tuning, dt: float
) -> float:
    """Correct ``device.shift`` of a fixed point and ``segment.force_bias``, equation (44).

    ``pair.u`` must equal the known ``pair.y`` there, and is corrected in place. Returned is what the
    uncertainty of both adds to the row's variance, (m/s²)².
    """
    rows = shared.learning.rows
    for i in range(3):
        for j in range(3):
            rows[i, j] = -now.K[i, j]
            rows[i, 3 + j] = _averaged_turn(segment, tuning, i, j)
    return _learn_point(device, segment, shared, tuning, dt)


@compiled
def learn_device(
    device: Device, segment: Segment, shared: SharedWork, tuning: Tuning, interval_s: float
) -> float:
    """Correct ``device.shift`` and ``segment.force_bias`` by a moving point, equation (44).

    interval_s: time between its rows. Returns what the uncertainty of both adds to the row's variance,
    (m/s²)². The frames kept for the next fits are corrected by the accelerometer's error as well.
    """
    rows, pair = shared.learning.rows, shared.pair
    for i in range(3):
        for j in range(3):
            rows[i, j], rows[i, 3 + j] = -pair.arm[i, j], pair.turn[i, j]
    added = _learn_point(device, segment, shared, tuning, interval_s)
    change = shared.learning.change
    for k in range(len(device.history)):
        frame = device.history[k]
        if frame.time_s == -np.inf:
            continue
        for i in range(3):
            for j in range(3):
                frame.force[i] -= frame.R[i, j] * change[3 + j]
    return added


@compiled
def _averaged_turn(segment: Segment, tuning: Tuning, i: int, j: int) -> float:
    """Return an element of R̄ of (44), R through the low-pass of the lever-arm matrix."""
    return float(segment.R[i, j] - tuning.smoothing_s * segment.averages.lever_arm_matrix[i, j])


@compiled
def _learn_point(
    device: Device, segment: Segment, shared: SharedWork, tuning: Tuning, interval_s: float
) -> float:
    """Correct shift and accelerometer by ``learning.rows``, equations (43) to (45).

    Columns: the arm, the accelerometer's error. Returns what their uncertainty adds to the row's variance,
    (m/s²)².
    """
    learning, u, y = shared.learning, shared.pair.u, shared.pair.y
    change, averages = learning.change, segment.averages
    off = spread(y[0], y[1], y[2], own_covariance(segment))
    for i in range(3):
        learning.residual[i], learning.off[i] = u[i] - y[i], off[i]
    learning.memory = max(1.0, tuning.point_memory_s / interval_s)
    added = learn_rows(device.covariance, learning, tuning.huber)
    for i in range(3):
        device.shift[i] += change[i]
        segment.force_bias[i] += change[3 + i]
        for j in range(6):
            u[i] -= learning.rows[i, j] * change[j]
        for j in range(3):  # the averages as if the accelerometer's error had always been known so
            # (45)
            averages.force[i] -= _averaged_turn(segment, tuning, i, j) * change[3 + j]
            averages.last_force[i] -= segment.R[i, j] * change[3 + j]
    return added


@compiled
def learn_rows(P: FloatArray, learning: Learning, huber: float) -> float:
    """Set ``learning.change`` by three scalar updates, equations (42) and (43); P (6, 6) changes in place.

    Returns the mean variance that P gave to a component of the row beforehand, (46). P itself is changed
    once, by all three rows: a row's gain is that by the first P less its shares in the gains of the rows
    before it.
    """
    rows, gains, scaled, found = learning.rows, learning.gains, learning.scaled, learning.found
    added, variance, at_once, memory = 0.0, learning.variance, learning.at_once, learning.memory
    for i in range(3):
        times_vector_into(gains[i], P, rows[i])
        # (46) Σ a_i P_e a_iᵀ
        added += _dot_six(rows[i], gains[i])
    for i in range(3):
        innovation, off = learning.residual[i], learning.off[i]
        for k in range(i):
            share = _dot_six(rows[i], scaled[k])
            innovation -= share * found[k]
            for a in range(6):
                gains[i, a] -= share * gains[k, a]
        uncertain = _dot_six(rows[i], gains[i])
        # (42) v_i and its outliers
        white, plausible = variance + off * memory, huber * huber * (at_once + off + uncertain)
        if innovation * innovation > plausible:
            white *= math.sqrt(innovation * innovation / plausible)
        weight = 1.0 / (uncertain + white)
        found[i] = innovation
        for a in range(6):
            scaled[i, a] = gains[i, a] * weight
    for a in range(6):
        x, y, z = scaled[0, a], scaled[1, a], scaled[2, a]
        learning.change[a] = x * found[0] + y * found[1] + z * found[2]
        for b in range(a + 1):
            # (43) P_e ← P_e − k_i a_i P_e, all three at once
            P[a, b] -= x * gains[0, b] + y * gains[1, b] + z * gains[2, b]
            P[b, a] = P[a, b]
    return added / 3.0


@compiled
def _dot_six(a: FloatArray, b: FloatArray) -> float:
    """Return a · b; shapes (6,), (6,)."""
    product: float = (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3]) + (a[4] * b[4] + a[5] * b[5])
    return product
