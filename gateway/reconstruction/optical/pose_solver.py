"""One pose from one frame of markers: damped Gauss–Newton over the whole body, with weights that forgive.

Levenberg–Marquardt (Marquardt 1963) on ½ Σ ρ(|r_m| / σ_m) plus what the joints are allowed, by the normal
equations of ``kernels``. ρ is the Geman–McClure function (Black & Rangarajan 1996, Int. J. Comput. Vis.
19(1)):
a marker far from where the body can have it loses its weight, so that swapped and ghost markers do no harm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.joints import Decomposition
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm
from gateway.reconstruction.optical import kernels

FREE_SIGMA = np.radians(120.0)
"""How far angles that a joint has may be from their neutral ones before it counts, rad."""
FIXED_SIGMA = np.radians(12.0)
"""The same of angles that a joint does not really have (a knee's adduction), rad."""
HELD_SIGMA = np.radians(10.0)
"""How far a joint may be from where it is expected before that counts: decides what gaps leave open, rad."""
LIMIT_SIGMA = np.radians(8.0)
"""How far beyond its limits an angle may be before it counts, rad."""
_SMALLEST_STEP = 1e-6  # m and rad: under what any marker can tell
_SMALLEST_GAIN = 1e-5  # of the cost, relative: what is left are turns that no marker sees
_FIRST_DAMPING = 1e-6
_WORST_DAMPING = 1e6


class BodyModel(NamedTuple):
    """A body with markers as the kernels take it: S segments, M markers, J joints."""

    parents: IntArray  # (S,)
    offsets: FloatArray  # (S, 3) m
    segments: IntArray  # (M,)
    positions: FloatArray  # (M, 3) m
    sigmas: FloatArray  # (M,) m
    distals: IntArray  # (J,) segment that a joint turns against its parent
    axes: IntArray  # (J, 3)
    signs: FloatArray  # (J, 3)
    stiffness: FloatArray  # (J, 3) 1/rad²
    limits: FloatArray  # (J, 3, 2) rad
    limit_stiffness: float  # 1/rad²

    def joints_at(self, R: FloatArray, root: FloatArray) -> FloatArray:
        """Return the proximal joints (S, 3) of a pose R (S, 3, 3) segment to world, root (3,); world, m."""
        return kernels.places(self.parents, self.offsets, R, root)

    def markers_at(self, R: FloatArray, root: FloatArray) -> FloatArray:
        """Return where the body has its markers (M, 3) in a pose as of ``joints_at``; world, m."""
        return kernels.marker_places(self.segments, self.positions, R, self.joints_at(R, root))


class WeighedMarkers(NamedTuple):
    """One frame of markers."""

    observed: FloatArray  # (M, 3) m; NaN rows: not seen
    trust: FloatArray  # (M,) 0 leaves a marker out, 1 takes it
    scale: float  # m, distance at which a marker begins to lose its weight


_NOWHERE = np.zeros(3)


class Held(NamedTuple):
    """A pose to whose joints those of another are drawn, and its root if wanted."""

    R: FloatArray  # (S, 3, 3)
    stiffness: float = 0.0  # 1/rad²; 0: not drawn
    root: FloatArray = _NOWHERE  # (3,) m
    root_stiffness: float = 0.0  # 1/rad²; 0: not drawn
    place_stiffness: float = 0.0  # 1/m²; 0: not drawn


class Pose(NamedTuple):
    """A pose, and how well it explains the markers."""

    R: FloatArray  # (S, 3, 3) segment to world
    root: FloatArray  # (3,) m
    residuals: FloatArray  # (M,) m, distance of measured and virtual marker; NaN: not seen
    weights: FloatArray  # (M,) 0 … 1: robust weight of each marker
    factor: FloatArray  # (3 + 3 S, 3 + 3 S) lower Cholesky factor of the normal matrix


def body_model(skeleton: Skeleton, markers: BodyMarkers) -> BodyModel:
    """Return the arrays of a body. Joints between neighbours that have Cardan angles bring their limits
    along; all others are only drawn, weakly, to the neutral posture."""
    described = {
        joint.distal: joint
        for joint in skeleton.joints
        if joint.proximal == skeleton.parents[joint.distal]
        and joint.decomposition is Decomposition.CARDAN
        and len(set(joint.sequence)) == 3
    }
    distals = np.flatnonzero(skeleton.parents >= 0)
    n = len(distals)
    axes, signs = np.tile(np.array([2, 0, 1]), (n, 1)), np.ones((n, 3))
    stiffness = np.full((n, 3), FREE_SIGMA**-2)
    limits = np.tile([-np.inf, np.inf], (n, 3, 1))
    for row, segment in enumerate(distals.tolist()):
        joint = described.get(segment)
        if joint is None:
            continue
        for k, angle in enumerate(joint.angles):
            axes[row, k], signs[row, k], limits[row, k] = angle.axis_index, angle.sign, angle.limits
            if angle.name not in joint.free:
                stiffness[row, k] = FIXED_SIGMA**-2
    return BodyModel(
        parents=skeleton.parents,
        offsets=skeleton.offsets,
        segments=markers.segments,
        positions=markers.positions,
        sigmas=markers.sigmas,
        distals=distals,
        axes=axes,
        signs=signs,
        stiffness=stiffness,
        limits=limits,
        limit_stiffness=LIMIT_SIGMA**-2,
    )


def everyone(observed: FloatArray, scale: float) -> WeighedMarkers:
    """Return a frame of which all markers are trusted. scale: m."""
    return WeighedMarkers(observed, np.ones(len(observed)), scale)


@compiled
def _cost(
    model: BodyModel, observed: FloatArray, robust_weights: FloatArray, R: FloatArray, p: FloatArray
) -> float:
    """Return ½ Σ w r² of the markers, with the weights of the step before, plus the joints."""
    total = 0.0
    for m in range(len(observed)):
        if robust_weights[m] > 0.0:
            s = model.segments[m]
            r = observed[m] - p[s]
            for i in range(3):
                r[i] -= (
                    R[s, i, 0] * model.positions[m, 0]
                    + R[s, i, 1] * model.positions[m, 1]
                    + R[s, i, 2] * model.positions[m, 2]
                )
            total += 0.5 * robust_weights[m] * dot(r, r) / model.sigmas[m] ** 2
    return total


@compiled
def add_held(
    H: FloatArray, g: FloatArray, model: BodyModel, R: FloatArray, root: FloatArray, held: Held
) -> float:
    """Draw every joint to the rotation it has in the pose held, and the root to its own. Return the cost."""
    stiffness = held.stiffness
    turn = rm.rotate(R[0], rm.increment(held.R[0], R[0]))
    cost = 0.0
    for i in range(3):
        H[i, i] += held.place_stiffness
        g[i] -= held.place_stiffness * (root[i] - held.root[i])
        H[3 + i, 3 + i] += held.root_stiffness
        g[3 + i] -= held.root_stiffness * turn[i]
        cost += 0.5 * held.place_stiffness * (root[i] - held.root[i]) ** 2
        cost += 0.5 * held.root_stiffness * turn[i] ** 2
    for d in model.distals:
        parent = model.parents[d]
        turned = rm.multiply(R[parent], rm.multiply(held.R[parent].T.copy(), held.R[d]))
        apart = rm.rotate(R[d], rm.increment(turned, R[d]))
        for i in range(3):
            H[3 + 3 * d + i, 3 + 3 * d + i] += stiffness
            g[3 + 3 * d + i] -= stiffness * apart[i]
        cost += 0.5 * stiffness * dot(apart, apart)
    return cost


@compiled
def normal_equations(
    model: BodyModel, observed: FloatArray, robust_weights: FloatArray, R: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return H (upper triangle), g, and the cost of the joints."""
    n = 3 + 3 * len(model.parents)
    H, g = np.zeros((n, n)), np.zeros(n)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    for m in range(len(observed)):
        if robust_weights[m] > 0.0:
            weight = robust_weights[m] / model.sigmas[m] ** 2
            marker = kernels.MarkerRow(model.segments[m], y[m], observed[m] - y[m], weight)
            kernels.add_marker(H, g, model.parents, p, marker)
    cost = 0.0
    for j in range(len(model.distals)):
        d = model.distals[j]
        joint = kernels.JointRow(
            d, model.axes[j], model.signs[j], model.stiffness[j], model.limits[j], model.limit_stiffness
        )
        cost += kernels.add_joint(H, g, R[model.parents[d]], R[d], joint)
    return H, g, cost


@compiled
def marker_weights(model: BodyModel, seen: WeighedMarkers, y: FloatArray) -> FloatArray:
    """Return Geman–McClure weights (1 + (r / c)²)⁻², times the trust given; 0 where a marker was not seen.

    c: the scale, and four times a marker's own σ at the least.
    """
    observed = seen.observed
    robust_weights = np.zeros(len(observed))
    for m in range(len(observed)):
        if is_finite(observed[m]) and seen.trust[m] > 0.0:
            c = max(seen.scale, 4.0 * model.sigmas[m])
            r = norm(observed[m] - y[m]) / c
            robust_weights[m] = seen.trust[m] / (1.0 + r * r) ** 2
    return robust_weights


@compiled
def solve_pose(
    model: BodyModel, seen: WeighedMarkers, R: FloatArray, root: FloatArray, held: Held, longest: int
) -> Pose:
    """Return the pose that explains the markers best, near the one given.

    R (S, 3, 3), root (3,) m: where to begin. longest: most steps.
    """
    observed = seen.observed
    p = kernels.places(model.parents, model.offsets, R, root)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    robust_weights = marker_weights(model, seen, y)
    H, g, joints = normal_equations(model, observed, robust_weights, R, p)
    joints += add_held(H, g, model, R, root, held)
    damping = _FIRST_DAMPING
    for _ in range(longest):
        if damping >= _WORST_DAMPING:
            break
        L = H.copy()
        kernels.mirrored(L)
        for i in range(len(L)):
            L[i, i] += damping * L[i, i] + 1e-9
        if not kernels.cholesky(L):
            damping = max(10.0 * damping, 1e-4)
            continue
        delta = kernels.substituted(L, g)
        R_new, root_new = kernels.moved(model.parents, R, root, delta)
        p_new = kernels.places(model.parents, model.offsets, R_new, root_new)
        before = _cost(model, observed, robust_weights, R, p) + joints
        H_new, g_new, joints_new = normal_equations(model, observed, robust_weights, R_new, p_new)
        joints_new += add_held(H_new, g_new, model, R_new, root_new, held)
        after = _cost(model, observed, robust_weights, R_new, p_new) + joints_new
        if after > before * (1.0 + 1e-12):
            damping = max(10.0 * damping, 1e-4)
            continue
        R, root, p, joints = R_new, root_new, p_new, joints_new
        damping = max(_FIRST_DAMPING, 0.2 * damping)
        y = kernels.marker_places(model.segments, model.positions, R, p)
        robust_weights = marker_weights(model, seen, y)
        H, g, joints = normal_equations(model, observed, robust_weights, R, p)
        joints += add_held(H, g, model, R, root, held)
        if np.max(np.abs(delta)) < _SMALLEST_STEP or before - after < _SMALLEST_GAIN * before:
            break
    return Pose(R, root, _residuals(observed, y), robust_weights, _factor(H))


@compiled
def _residuals(observed: FloatArray, y: FloatArray) -> FloatArray:
    """Return the distances (M,) m of measured and virtual markers; NaN: not seen."""
    residuals = np.full(len(observed), np.nan)
    for m in range(len(observed)):
        if is_finite(observed[m]):
            residuals[m] = norm(observed[m] - y[m])
    return residuals


@compiled
def _factor(H: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of a normal matrix (upper triangle); NaN where it has none."""
    L = H.copy()
    kernels.mirrored(L)
    for i in range(len(L)):
        L[i, i] += 1e-9
    if not kernels.cholesky(L):
        L[:] = np.nan
    return L


@compiled
def orientation_sigmas(parents: IntArray, factor: FloatArray, variance: float) -> FloatArray:
    """Return (S,) rad: standard deviation of every segment's orientation, from the factor of the normal
    matrix.

    The turn of a segment is the sum of those of its chain, so its covariance is A H⁻¹ Aᵀ with A the rows of
    that sum. variance: of the markers' residuals in units of their σ².
    """
    n = len(factor)
    sigmas = np.empty(len(parents))
    for s in range(len(parents)):
        trace = 0.0
        for i in range(3):
            b = np.zeros(n)
            a = s
            while a >= 0:
                b[3 + 3 * a + i] = 1.0
                a = parents[a]
            # only L z = b is needed: b H⁻¹ b = z · z
            for k in range(n):
                for j in range(k):
                    b[k] -= factor[k, j] * b[j]
                b[k] /= factor[k, k]
                trace += b[k] * b[k]
        sigmas[s] = np.sqrt(variance * trace)
    return sigmas
