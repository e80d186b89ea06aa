"""What a segment of ``rate_free_filter`` says of its points. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, skew
from gateway.reconstruction.inertial.rate_free_filter import ARM, PLACE, RATE, SPIN, VELOCITY, SegmentState


@compiled
def point(state: SegmentState, arm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where a point at ``arm`` (3,) from the module is, world, and the covariance (3, 3) of that."""
    r = rotation_matrix.rotate(state.R, arm)
    J, K = np.zeros((3, 6)), skew(r)
    C = np.zeros((6, 6))
    for i in range(3):
        J[i, 3 + i] = 1.0
        for j in range(3):
            J[i, j] = -K[i, j]
            C[i, j], C[i, 3 + j] = state.P[i, j], state.P[i, PLACE + j]
            C[3 + i, j], C[3 + i, 3 + j] = state.P[PLACE + i, j], state.P[PLACE + i, PLACE + j]
    covariance = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for a in range(6):
                covariance[i, j] += J[i, a] * _dot_row(C, a, J, j)
    return state.values[PLACE:ARM] + r, covariance


@compiled
def at_joint(state: SegmentState, U: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Angular rate (3,), segment axes; acceleration (3,) of the joint, world; sigma of the orientation, rad.

    U (3,) joint to module, segment axes; g (3,) gravity."""
    w, arm = state.values[RATE:SPIN], rotation_matrix.rotate(state.R, -U)
    at_module = rotation_matrix.rotate(state.R, state.before) + g
    around = cross(state.values[SPIN:VELOCITY], arm) + cross(w, cross(w, arm))
    sigma = math.sqrt(state.P[0, 0] + state.P[1, 1] + state.P[2, 2])
    return rotation_matrix.rotate_inverse(state.R, w), at_module + around, sigma


@compiled
def _dot_row(C: FloatArray, a: int, J: FloatArray, j: int) -> float:
    """Row a of C (6, 6) times row j of J (3, 6)."""
    total = 0.0
    for b in range(6):
        total += C[a, b] * J[j, b]
    return total
