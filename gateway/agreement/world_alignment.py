"""One heading between two worlds, one constant rotation between two axes of a segment.

Both worlds have Z up; where north lies is each source's own affair. Two sources need not put a segment's axes
alike, nor sit straight on it: that difference is constant, and told apart from what varies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.deferred import Rotation
from gateway.frames import FloatArray

ROUNDS = 20
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_PRODUCT = np.zeros((4, 4, 4))
"""Component c of a ⊗ b is ``_PRODUCT[c, i, j] a_i b_j``."""
for _i, _j, _c, _sign in (
    (0, 0, 0, 1), (1, 1, 0, -1), (2, 2, 0, -1), (3, 3, 0, -1),
    (0, 1, 1, 1), (1, 0, 1, 1), (2, 3, 1, 1), (3, 2, 1, -1),
    (0, 2, 2, 1), (2, 0, 2, 1), (3, 1, 2, 1), (1, 3, 2, -1),
    (0, 3, 3, 1), (3, 0, 3, 1), (1, 2, 3, 1), (2, 1, 3, -1),
):  # fmt: skip
    _PRODUCT[_c, _i, _j] = _sign
_TIMES_CONJUGATE = _PRODUCT * _CONJUGATE
"""Of a ⊗ b*."""
_CONJUGATE_TIMES = _PRODUCT * _CONJUGATE[:, None]
"""Of a* ⊗ b."""


class WorldAlignment(NamedTuple):
    """What takes the first's orientations to the second's: ``heading ⊗ q_wb ⊗ mounting``."""

    heading_rad: float
    """About the vertical, counter-clockwise seen from above."""
    mounting: FloatArray
    """(S, 4) the second's segment axes to the first's."""
    own_heading: FloatArray
    """(S,) rad, of each segment beside the common one; zeros where there is only that."""


def align_world(q: FloatArray, q_reference: FloatArray, with_mounting: bool = True) -> WorldAlignment:
    """Heading, common to all segments, and mounting of each, that bring ``q`` (T, S, 4) nearest to the other.

    Alternates between the two, each solved exactly. with_mounting: else all mountings are the identity.
    Instants at which either is NaN are left out; a segment that has no other keeps the identity.
    """
    n = q.shape[1]
    known = np.isfinite(q + q_reference).all(axis=2).reshape(-1, n)
    columns = [s for s in range(n) if known[:, s].any()]
    scatters = [_scatter(q[known[:, s], s], q_reference[known[:, s], s]) for s in columns]
    mountings = [_IDENTITY for _ in columns]
    heading = _IDENTITY
    for _ in range(ROUNDS if with_mounting else 1):
        heading = _best_heading(scatters, mountings)
        if with_mounting:
            mountings = [_best_mounting(scatter, heading) for scatter in scatters]
    mounting = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    for s, rotation in zip(columns, mountings, strict=True):
        mounting[s] = rotation if rotation[0] >= 0.0 else -rotation
    angle = 2.0 * math.atan2(heading[3], heading[0])
    return WorldAlignment(math.remainder(angle, math.tau), mounting, np.zeros(n))


def align_segments(q: FloatArray, q_reference: FloatArray, with_mounting: bool = True) -> WorldAlignment:
    """The same with a heading of its own for every segment: for modules in a field that is not homogeneous.

    The common heading is the mean of all.
    """
    n = q.shape[1]
    single = [align_world(q[:, [s]], q_reference[:, [s]], with_mounting) for s in range(n)]
    headings = np.array([each.heading_rad for each in single])
    common = float(np.angle(np.exp(1j * headings).mean()))
    own: FloatArray = np.angle(np.exp(1j * (headings - common)))
    return WorldAlignment(common, np.concatenate([each.mounting for each in single]), own)


def aligned(q: FloatArray, alignment: WorldAlignment) -> FloatArray:
    """``q`` (T, S, 4) in the other's world and axes; NaN stays."""
    result = np.full_like(q, np.nan)
    for s in range(q.shape[1]):
        heading = Rotation.from_rotvec([0.0, 0.0, alignment.heading_rad + alignment.own_heading[s]])
        known = np.isfinite(q[:, s]).all(axis=1)
        if known.any():
            mounting = Rotation.from_quat(alignment.mounting[s], scalar_first=True)
            own = Rotation.from_quat(q[known, s], scalar_first=True)
            result[known, s] = (heading * own * mounting).as_quat(scalar_first=True)
    return result


def _scatter(q: FloatArray, q_reference: FloatArray) -> FloatArray:
    """(16, 16) second moments of the products of components, estimate's by reference's: all that the rounds
    need."""
    products = (q[:, :, None] * q_reference[:, None, :]).reshape(-1, 16)
    result: FloatArray = products.T @ products
    return result


def _best_heading(scatters: list[FloatArray], mountings: list[FloatArray]) -> FloatArray:
    """(4,) the rotation about the vertical nearest to all of ``reference ⊗ (estimate ⊗ mounting)*``: the
    largest
    eigenvector of the w–z scatter."""
    total = np.zeros((2, 2))
    for scatter, m in zip(scatters, mountings, strict=True):
        # products of components (e, w) to w and z of w ⊗ m* ⊗ e*
        turn = np.einsum("cwr,rje,j->cew", _PRODUCT, _TIMES_CONJUGATE, _CONJUGATE * m).reshape(4, 16)[[0, 3]]
        total += turn @ scatter @ turn.T
    w, z = np.linalg.eigh(total)[1][:, -1]
    return np.array([w, 0.0, 0.0, z])


def _best_mounting(scatter: FloatArray, heading: FloatArray) -> FloatArray:
    """(4,) the rotation nearest to all of ``estimate* ⊗ heading* ⊗ reference``."""
    turn = np.einsum("cer,rhw,h->cew", _CONJUGATE_TIMES, _PRODUCT, _CONJUGATE * heading).reshape(4, 16)
    best: FloatArray = np.linalg.eigh(turn @ scatter @ turn.T)[1][:, -1]
    return best


def place_aligned(p: FloatArray, p_reference: FloatArray) -> FloatArray:
    """Points (T, S, 3) turned about the vertical and moved as a whole, as near as can be to the others."""
    known = np.isfinite(p).all(axis=2) & np.isfinite(p_reference).all(axis=2)
    if not known.any():
        return np.full_like(p, np.nan)
    a, b = p[known], p_reference[known]
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    x, y = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
    angle = np.arctan2(
        np.sum(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]), np.sum(x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1])
    )
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    moved: FloatArray = (p - mean_a) @ turn.T + mean_b
    return moved
