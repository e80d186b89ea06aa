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

HEADINGS = 64
"""Tried all round before the best is looked at more closely."""
ZOOMS = 8
NARROWER = 8.0
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


class WorldAlignment(NamedTuple):
    """What takes the first's orientations to the second's: ``heading ⊗ q_wb ⊗ mounting``."""

    heading_rad: float
    """About the vertical, counter-clockwise seen from above."""
    mounting: FloatArray
    """(S, 4) the second's segment axes to the first's."""
    own_heading: FloatArray
    """(S,) rad, of each segment beside the common one; zeros where there is only that."""


def align_world(q: FloatArray, q_reference: FloatArray, with_mounting: bool = True) -> WorldAlignment:
    """Return the heading, common to all segments, and mounting of each, that bring ``q`` (T, S, 4) nearest to
    the other.

    For every heading the best mountings are known in closed form; of the headings the best is searched for,
    all round. with_mounting: else all mountings are the identity. Instants at which either is NaN are left
    out; a segment that has no other keeps the identity.
    """
    n = q.shape[1]
    known = np.isfinite(q + q_reference).all(axis=2).reshape(-1, n)
    columns = [s for s in range(n) if known[:, s].any()]
    scatters = [_scatter(q[known[:, s], s], q_reference[known[:, s], s]) for s in columns]
    if with_mounting:
        angle, mountings = _best_heading_and_mountings(scatters)
    else:
        angle, mountings = _best_heading(scatters), [_IDENTITY for _ in columns]
    mounting = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    for s, rotation in zip(columns, mountings, strict=True):
        mounting[s] = rotation if rotation[0] >= 0.0 else -rotation
    return WorldAlignment(math.remainder(angle, math.tau), mounting, np.zeros(n))


def align_segments(q: FloatArray, q_reference: FloatArray, with_mounting: bool = True) -> WorldAlignment:
    """Return the same with a heading of its own for every segment: for modules in a field that is not
    homogeneous.

    The common heading is the mean of all.
    """
    n = q.shape[1]
    single = [align_world(q[:, [s]], q_reference[:, [s]], with_mounting) for s in range(n)]
    headings = np.array([each.heading_rad for each in single])
    # The mean of directions, as 359° and 1° are 2° apart.
    common = float(np.angle(np.exp(1j * headings).mean()))
    own: FloatArray = np.angle(np.exp(1j * (headings - common)))
    return WorldAlignment(common, np.concatenate([each.mounting for each in single]), own)


def aligned(q: FloatArray, alignment: WorldAlignment) -> FloatArray:
    """Return ``q`` (T, S, 4) in the other's world and axes; NaN stays."""
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
    """Return (16, 16) second moments of the products of components, estimate's by reference's: all that the
    rounds need."""
    products = (q[:, :, None] * q_reference[:, None, :]).reshape(-1, 16)
    result: FloatArray = products.T @ products
    return result


def _best_heading(scatters: list[FloatArray]) -> float:
    """Return the rotation about the vertical nearest to all of ``reference ⊗ estimate*``, rad.

    It is the largest eigenvector of the w–z scatter.
    """
    turn = np.einsum("cwe->cew", _PRODUCT * _CONJUGATE).reshape(4, 16)[[0, 3]]
    total = sum((turn @ scatter @ turn.T for scatter in scatters), np.zeros((2, 2)))
    w, z = np.linalg.eigh(total)[1][:, -1]
    return 2.0 * math.atan2(z, w)


def _best_heading_and_mountings(scatters: list[FloatArray]) -> tuple[float, list[FloatArray]]:
    """Return rad and (4,) each: the heading for which the mountings nearest to ``estimate* ⊗ heading* ⊗
    reference`` are nearest in all."""
    if not scatters:
        return 0.0, []
    moments = np.stack([_by_heading(scatter) for scatter in scatters])
    # The whole circle first, then ever closer around the best.
    best, reach = 0.0, math.pi
    for zoom in range(ZOOMS + 1):
        tried = best + reach * np.linspace(-1.0, 1.0, HEADINGS if zoom == 0 else 2 * int(NARROWER) + 1)
        nearness = np.linalg.eigvalsh(_at(moments, tried))[..., -1].sum(axis=0)
        best, reach = float(tried[np.argmax(nearness)]), 2.0 * (tried[1] - tried[0])
    vectors = np.linalg.eigh(_at(moments, np.array([best]))[:, 0])[1][..., -1]
    return best, list(vectors)


def _by_heading(scatter: FloatArray) -> FloatArray:
    """Return (3, 4, 4) factors of cos², cos sin and sin² of half the heading in the scatter of the
    mountings."""
    turn = np.einsum("cer,rhw->hcew", _PRODUCT * _CONJUGATE[:, None], _PRODUCT * _CONJUGATE[:, None])
    level, upright = turn[0].reshape(4, 16), turn[3].reshape(4, 16)
    crossed = level @ scatter @ upright.T
    return np.stack([level @ scatter @ level.T, crossed + crossed.T, upright @ scatter @ upright.T])


def _at(moments: FloatArray, headings: FloatArray) -> FloatArray:
    """Return (S, H, 4, 4) scatters of the mountings (S, 3, 4, 4) for headings (H,) rad."""
    c, s = np.cos(0.5 * headings), np.sin(0.5 * headings)
    result: FloatArray = np.einsum("kh,skij->shij", np.stack([c * c, c * s, s * s]), moments)
    return result


def place_aligned(p: FloatArray, p_reference: FloatArray) -> FloatArray:
    """Return points (T, S, 3) turned about the vertical and moved as a whole, as near as can be to the
    others."""
    known = np.isfinite(p).all(axis=2) & np.isfinite(p_reference).all(axis=2)
    if not known.any():
        return np.full_like(p, np.nan)
    a, b = p[known], p_reference[known]
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    x, y = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
    # The turn that brings one set of points nearest to another has this closed form in the plane.
    angle = np.arctan2(
        np.sum(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]), np.sum(x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1])
    )
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    moved: FloatArray = (p - mean_a) @ turn.T + mean_b
    return moved
