"""From frame to frame: where to begin, and which marker is which."""

from __future__ import annotations

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.landmarks import AXES_UP, to_world
from gateway.reconstruction.optical.pose_solver import (
    LIMIT_SIGMA,
    BodyModel,
    Held,
    Pose,
    body_model,
    everyone,
    normal_equations,
    solve_pose,
)

NEAR = 0.03
"""Distance at which a marker begins to lose its say once the pose is known, m."""
_SCALES = (2.0, 0.3, 0.1, NEAR)
"""The same while a pose is sought from nowhere: all markers speak at first."""
ACCEPTED = 0.25
"""Say from which a marker counts as used."""
_ENOUGH = 3
"""Markers that show how a segment lies."""
_CLOSE = 0.015
"""How far one or two markers may be off as they lie to their joint, m."""
_LONGEST = 60
LEAST_UPRIGHT = 0.9
"""Cosine between a body and an axis along which it stands, or lies."""
_LOOKS = 5
"""Frames that tell how a body stands."""
_HOPELESS = 0.1  # m: a marker this far off says no more about a pose


@compiled
def rigid(here: FloatArray, there: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R, t with there ≈ R here + t over the rows known in both (n, 3): Kabsch 1976 (Acta Cryst. A32:
    922)."""
    n = 0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(here)):
        if is_finite(there[i]) and is_finite(here[i]):
            a += here[i]
            b += there[i]
            n += 1
    a /= n
    b /= n
    C = np.zeros((3, 3))
    for i in range(len(here)):
        if is_finite(there[i]) and is_finite(here[i]):
            for j in range(3):
                for k in range(3):
                    C[j, k] += (there[i, j] - b[j]) * (here[i, k] - a[k])
    u, _, vt = np.linalg.svd(C)
    d = np.eye(3)
    d[2, 2] = np.sign(np.linalg.det(u @ vt))
    R = u @ d @ vt
    return R, b - rm.rotate(R, a)


@compiled
def turned_on(before: FloatArray, now: FloatArray, fraction: float) -> FloatArray:
    """Return orientations (S, 3, 3) turned on by a fraction of the turn between two poses."""
    ahead = np.empty_like(now)
    for s in range(len(now)):
        ahead[s] = rm.multiply(now[s], rm.from_rotation_vector(fraction * rm.increment(before[s], now[s])))
    return ahead


def start_pose(model: BodyModel, observed: FloatArray, neutral: FloatArray) -> Pose | None:
    """Return the pose of markers (M, 3) from nothing but them; None with fewer than three markers.

    neutral: (3, 3) of every segment in the neutral posture. The body is laid over the markers as if it were
    rigid and then let loose, once from the neutral posture and once with all joints in the middle of their
    limits: an arm with few markers may else end up bent the wrong way. The cheaper pose counts, and each of
    its segments that bears a joint bent beyond its limits is tried the other way round.
    """
    if np.isfinite(observed).all(axis=1).sum() < 3:
        return None
    observed = np.ascontiguousarray(observed)  # of another layout, the kernels are compiled once more
    straight = np.tile(neutral, (len(model.parents), 1, 1))
    poses = [_settled(model, observed, R) for R in (straight, _middle_posture(model, neutral))]
    return _untwisted(model, observed, min(poses, key=lambda pose: _price(model, observed, pose)))


def stands_along(model: BodyModel, observed: FloatArray, neutral: FloatArray) -> FloatArray | None:
    """Return (3,) the direction from the feet to the head of markers (F, M, 3) in the world, mean over some
    frames, of a length up to 1; None where no frame shows it.

    neutral: (3, 3) of every segment in the neutral posture, which tells how high each segment is.
    """
    n = len(model.parents)
    heights = model.joints_at(np.tile(neutral, (n, 1, 1)), np.zeros(3))[:, 2]
    found = []
    for f in np.linspace(0, len(observed) - 1, min(len(observed), _LOOKS)).astype(np.int64).tolist():
        pose = start_pose(model, observed[f], neutral)
        if pose is not None:
            along = (heights - heights.mean()) @ model.joints_at(pose.R, pose.root)
            found.append(along / np.linalg.norm(along))
    return np.mean(found, axis=0) if found else None


def upright_axis(skeleton: Skeleton, markers: BodyMarkers, places: FloatArray) -> str | None:
    """Return the axis of a file along which the body stands, or lies, throughout its markers (F, M, 3), m, as
    the file has them; None where it does so along none."""
    along = stands_along(
        body_model(skeleton, markers),
        to_world(places, markers.vertical),
        quaternion.to_matrix(skeleton.neutral),
    )
    if along is None:
        return None
    unit = {axis: np.eye(3)["xyz".index(axis[-1])] * (-1.0 if "-" in axis else 1.0) for axis in AXES_UP}
    cosines = {axis: float(to_world(unit[axis], markers.vertical) @ along) for axis in AXES_UP}
    axis = max(cosines, key=cosines.__getitem__)
    return axis if cosines[axis] > LEAST_UPRIGHT else None


def laid_anew(model: BodyModel, observed: FloatArray, pose: Pose) -> Pose | None:
    """Return a cheaper pose, with segments laid over markers of their own that the pose misses; None without
    one.

    After a gap a segment may have turned so far that half of its markers or more count as ghosts: a minimum
    of its own as well. Where three or more lie to each other as they should, none of them is one; nor where
    one or two lie so to the joint in which the segment hangs, though neither is where it was expected.

    observed: (M, 3) m, under the names that they came with.
    """
    observed = np.ascontiguousarray(observed)
    seen = np.isfinite(observed).all(axis=1)
    n = len(model.parents)
    own_seen = np.bincount(model.segments[seen], minlength=n)
    missed = np.bincount(model.segments[seen & (pose.weights <= ACCEPTED)], minlength=n)
    strays = (own_seen > 0) & (2 * missed >= np.where(own_seen < _ENOUGH, 2, 1) * own_seen)
    if not strays.any():
        return None
    R, root = pose.R.copy(), pose.root
    is_laid = False
    for s in np.flatnonzero(strays).tolist():
        joint = model.joints_at(R, root)[s]
        turn, shift, rest = _laid(model, observed, s, joint, R[s])
        if rest < (NEAR if own_seen[s] >= _ENOUGH else _CLOSE):
            is_laid = True
            root = shift if model.parents[s] < 0 else root
            R[s] = turn
    if not is_laid:
        return None
    other = solve_pose(model, everyone(observed, NEAR), R, root, Held(R), _LONGEST)
    return other if _price(model, observed, other) < _price(model, observed, pose) else None


def _laid(
    model: BodyModel, observed: FloatArray, s: int, joint: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return R (3, 3) and place (3,) m that lay a segment over its own markers, from an orientation ``R``,
    and how far the worst is then off, m. With fewer than three of them its joint (3,) is one more point."""
    own = np.flatnonzero((model.segments == s) & np.isfinite(observed).all(axis=1))
    here, there = model.positions[own], observed[own]
    if len(own) >= _ENOUGH:
        turn, shift = rigid(here, there)
    elif model.parents[s] < 0:
        return R, joint, np.inf
    elif len(own) == 1:
        turn, shift = rm.from_rotation_vector(_shortest_turn(R @ here[0], there[0] - joint)) @ R, joint
    else:
        here, there = np.vstack([here, np.zeros(3)]), np.vstack([there, joint])
        turn, shift = rigid(here, there)
    rest = np.linalg.norm(there - here @ turn.T - shift, axis=1)
    return turn, shift, float(rest.max())


def _shortest_turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) rad that turns the direction of ``a`` into that of ``b``."""
    across = np.cross(a, b)
    sine = float(np.linalg.norm(across))
    turn: FloatArray = across * (np.arctan2(sine, float(a @ b)) / sine) if sine > 0.0 else np.zeros(3)
    return turn


def _untwisted(model: BodyModel, observed: FloatArray, pose: Pose) -> Pose:
    """Return the pose, or a cheaper one with segments turned half round about their length.

    An elbow seen by one marker can be met with the upper arm turned round and the elbow bent backwards: a
    minimum of its own, that no small step leads out of.
    """
    price = _price(model, observed, pose)
    for row, distal in enumerate(model.distals.tolist()):
        segment = int(model.parents[distal])
        length = float(np.linalg.norm(model.offsets[distal]))
        if model.parents[segment] < 0 or length == 0.0 or not _is_bent(model, row, pose):
            continue
        R, root = pose.R.copy(), pose.root
        R[segment] = R[segment] @ rm.from_rotation_vector(np.pi / length * model.offsets[distal])
        for scale in _SCALES[2:]:
            other = solve_pose(model, everyone(observed, scale), R, root, Held(R), _LONGEST)
            R, root = other.R, other.root
        cheaper = _price(model, observed, other)
        if cheaper < price:
            pose, price = other, cheaper
    return pose


def _is_bent(model: BodyModel, row: int, pose: Pose) -> bool:
    """Return whether an angle of a joint is beyond its limits by more than ``LIMIT_SIGMA``."""
    distal = model.distals[row]
    angles, _, is_regular = kernels.cardan(pose.R[model.parents[distal]], pose.R[distal], model.axes[row])
    angles = angles * model.signs[row]
    beyond = np.maximum(model.limits[row, :, 0] - angles, angles - model.limits[row, :, 1])
    return is_regular and bool((beyond > LIMIT_SIGMA).any())


def _settled(model: BodyModel, observed: FloatArray, R: FloatArray) -> Pose:
    """Return the pose from orientations (S, 3, 3), laid over the markers (M, 3) m and then let loose."""
    turn, shift = rigid(model.markers_at(R, np.zeros(3)), observed)
    R, root = turn @ R, shift
    for scale in _SCALES:
        pose = solve_pose(model, everyone(observed, scale), R, root, Held(R), _LONGEST)
        R, root = pose.R, pose.root
    return pose


def _middle_posture(model: BodyModel, neutral: FloatArray) -> FloatArray:
    """Return (S, 3, 3) with every joint in the middle of its limits, where it has any."""
    R = np.tile(neutral, (len(model.parents), 1, 1))
    for row, distal in enumerate(model.distals.tolist()):
        limits = np.where(np.isfinite(model.limits[row]), model.limits[row], 0.0)
        angles = limits.mean(axis=1) * model.signs[row]
        turn = np.eye(3)
        for axis, angle in zip(model.axes[row], angles, strict=True):
            turn = turn @ rm.from_rotation_vector(angle * np.eye(3)[axis])
        R[distal] = R[model.parents[distal]] @ turn
    return R


def _price(model: BodyModel, observed: FloatArray, pose: Pose) -> float:
    """Return half the squared distances of all markers, none worse than ``_HOPELESS``, and what the joints
    cost."""
    p = model.joints_at(pose.R, pose.root)
    joints = normal_equations(model, observed, np.zeros(len(observed)), pose.R, p)[2]
    residuals = np.nan_to_num(np.linalg.norm(observed - model.markers_at(pose.R, pose.root), axis=1))
    apart = np.minimum(residuals, _HOPELESS) / model.sigmas
    return float(0.5 * (apart**2).sum() + joints)
