"""The pose that brings the body's keypoints to the candidates: damped Gauss–Newton in 40 unknowns. Compiled.

Step 5 of JP2020-042476A: minimise ½ Σ W_n |P̂_n − P_n(Q)|² over the degrees of freedom Q, W_n the summed PCM
at candidate P̂_n, by Levenberg–Marquardt (Marquardt 1963) with the analytic Jacobian of ``optical.kernels``
put through ``freedom.turn_matrix``. Limits of balls are walls of springs, those of hinges are kept exactly;
the floor is a wall of springs under heels, toes and whatever else carries the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import BodyModel, Held, add_held, body_model, normal_equations
from gateway.reconstruction.video.freedom import DEGREES, Freedom, freedom_of, kept_free, turn_matrix

FLOOR_SIGMA = 0.003
"""How far below the floor a contact may be before it counts as much as a keypoint, m."""
_SMALLEST_GAIN = 1e-4
_FIRST_DAMPING = 1e-6
_WORST_DAMPING = 1e4


class VideoBody(NamedTuple):
    """A body with keypoints, and what of it may move."""

    model: BodyModel
    freedom: Freedom
    contact_segments: IntArray  # (n_contacts,)
    contacts: FloatArray  # (n_contacts, 3) m, own axes


class Goal(NamedTuple):
    """What a pose is to bring about."""

    targets: FloatArray  # (n_keypoints, 3) m
    weights: FloatArray  # (n_keypoints,) W_n; 0 leaves a keypoint out
    held: Held
    """The pose that joints are drawn to: what no keypoint tells stays."""
    floor: float  # m, its height; -inf: none


class VideoBodyPose(NamedTuple):
    """A pose with the 40 degrees of freedom alone."""

    R: FloatArray  # (S, 3, 3) segment to world
    root: FloatArray  # (3,) m
    steps: int


def video_body(skeleton: Skeleton, markers: BodyMarkers) -> VideoBody:
    """Return the arrays of a body. Raises ``SettingsError`` when it lacks segments."""
    points = [point for _, point in skeleton.contacts]
    return VideoBody(
        body_model(skeleton, markers),
        freedom_of(skeleton),
        np.array([segment for segment, _ in skeleton.contacts], dtype=np.int64),
        np.array(points, dtype=np.float64).reshape(-1, 3),
    )


@compiled
def solve(body: VideoBody, goal: Goal, R: FloatArray, root: FloatArray, longest: int) -> VideoBodyPose:
    """Return the pose near (R, root) that brings keypoints to their targets. longest: most steps."""
    H, g, cost = _equations(body, goal, R, root)
    damping, steps = _FIRST_DAMPING, 0
    while steps < longest and damping < _WORST_DAMPING:
        steps += 1
        T = turn_matrix(body.freedom, body.model.parents, R)
        L = T.T @ (H @ T)
        for i in range(len(L)):
            L[i, i] += damping * L[i, i] + 1e-9
        if not kernels.cholesky(L):
            damping = max(10.0 * damping, 1e-4)
            continue
        delta = T @ kernels.substituted(L, T.T @ g)
        R_new, root_new = kernels.moved(body.model.parents, R, root, delta)
        R_new = kept_free(body.freedom, body.model.parents, R_new)
        H_new, g_new, cost_new = _equations(body, goal, R_new, root_new)
        if cost_new > cost:
            damping = max(10.0 * damping, 1e-4)
            continue
        gain = cost - cost_new
        R, root, H, g, cost = R_new, root_new, H_new, g_new, cost_new
        damping = max(_FIRST_DAMPING, 0.2 * damping)
        if gain < _SMALLEST_GAIN * cost:
            break
    return VideoBodyPose(R, root, steps)


@compiled
def orientation_sigmas(
    body: VideoBody, candidates: FloatArray, weights: FloatArray, pose: VideoBodyPose, stiffness: float
) -> FloatArray:
    """Return (S,) rad: standard deviation of every segment's orientation, about all axes together.

    The inverse of the normal equations at the pose, in the 40 degrees of freedom, with the spread of the
    candidates (n_keypoints, 3) m about the body where it is more than ``markers.sigmas`` promise. weights:
    (n_keypoints,), 0: not seen; stiffness: as of ``solve``, all that is known of what is not seen.
    """
    model = body.model
    joints = kernels.places(model.parents, model.offsets, pose.R, pose.root)
    places = kernels.marker_places(model.segments, model.positions, pose.R, joints)
    goal = Goal(places, weights, Held(pose.R, stiffness, pose.root, 0.0, 0.0), -np.inf)
    H, _, _ = _equations(body, goal, pose.R, pose.root)
    T = turn_matrix(body.freedom, model.parents, pose.R)
    A = T.T @ (H @ T)
    for i in range(len(A)):
        A[i, i] += 1e-9
    covariance = _variance(model, candidates, weights, places) * np.linalg.inv(A)
    sigmas = np.empty(len(model.parents))
    turns = np.zeros((len(model.parents), 3, T.shape[1]))
    for s in range(len(model.parents)):
        turns[s] = T[3 + 3 * s : 6 + 3 * s]
        if model.parents[s] >= 0:
            turns[s] += turns[model.parents[s]]
        sigmas[s] = np.sqrt(np.trace(turns[s] @ covariance @ turns[s].T))
    return sigmas


@compiled
def _variance(model: BodyModel, candidates: FloatArray, weights: FloatArray, places: FloatArray) -> float:
    """Return how much farther candidates are from the body than they should be, squared; 1 at the least."""
    total, n = 0.0, 0
    for m in range(len(candidates)):
        if weights[m] > 0.0 and np.isfinite(candidates[m, 0]):
            off = candidates[m] - places[m]
            total += weights[m] * dot(off, off) / model.sigmas[m] ** 2
            n += 3
    return max(1.0, total / max(1, n - DEGREES))


@compiled
def _equations(
    body: VideoBody, goal: Goal, R: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return H (whole), g and the cost of a pose, in the changes of ``optical.kernels``."""
    model, targets, weights = body.model, goal.targets, goal.weights
    p = kernels.places(model.parents, model.offsets, R, root)
    H, g, cost = normal_equations(model, targets, weights, R, p)
    cost += add_held(H, g, model, R, root, goal.held)
    for m in range(len(targets)):
        if weights[m] > 0.0:
            s = model.segments[m]
            r = targets[m] - p[s] - rm.rotate(R[s], model.positions[m])
            cost += 0.5 * weights[m] * dot(r, r) / model.sigmas[m] ** 2
    for c in range(len(body.contacts)):
        s = body.contact_segments[c]
        y = p[s] + rm.rotate(R[s], body.contacts[c])
        below = goal.floor - y[2]
        if below > 0.0:
            up = np.zeros(3)
            up[2] = below
            marker = kernels.MarkerRow(s, y, up, FLOOR_SIGMA**-2)
            kernels.add_marker(H, g, model.parents, p, marker)
            cost += 0.5 * (below / FLOOR_SIGMA) ** 2
    kernels.mirrored(H)
    return H, g, cost
